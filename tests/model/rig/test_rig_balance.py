"""How a plate rests on its supports: loads, centers of mass and tipping, by levers and moments."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kit.plates import make_paper_rig
from model.rig.rig import Rig
from model.rig.rig_balance import RigBalance
from model.structure.attachments import PointLoad
from model.structure.statics import GRAVITY

RIG = make_paper_rig(12, 9)
LENGTH, WIDTH = RIG.plate.length, RIG.plate.width
WEIGHT = GRAVITY * RIG.plate.mass


def foot(x: float, y: float, stiffness: float = 2e3) -> PointLoad:
    """A foot at a position [m], of a stiffness [N/m]."""
    return PointLoad(x, y, stiffness=stiffness, is_foot=True)


def on_feet(*feet: PointLoad, masses: tuple[PointLoad, ...] = ()) -> Rig:
    """The paper's plate on feet, without ERAs."""
    return replace(RIG, eras=(), wiring={}, masses=(*masses, *feet), supports=())


def test_loads_on_three_feet_follow_from_levers() -> None:
    """Two feet at one end and one at the other, of any stiffness, with a mass above the one."""
    mass = 0.2
    rig = on_feet(
        foot(0, 0, 1e3),
        foot(0, WIDTH, 7e3),
        foot(LENGTH, WIDTH / 2, 3e3),
        masses=(PointLoad(LENGTH, WIDTH / 2, mass=mass),),
    )
    balance = RigBalance(rig)
    loads = [*balance.loads.values()]
    assert loads == pytest.approx([WEIGHT / 4, WEIGHT / 4, WEIGHT / 2 + GRAVITY * mass], rel=1e-6)
    x = (WEIGHT * LENGTH / 2 + GRAVITY * mass * LENGTH) / (WEIGHT + GRAVITY * mass)
    found = balance.as_json()
    assert found["centre_of_mass_m"] == pytest.approx([x, WIDTH / 2])
    assert found["weight_n"] == pytest.approx(WEIGHT + GRAVITY * mass)
    assert [*balance.notes()] == []


def test_stiff_feet_carry_more_than_soft_ones() -> None:
    """A symmetric board on springs: four of 1 kN/m at its ends, four of 3 kN/m between them."""
    ends = [foot(0, 0, 1e3), foot(0, WIDTH, 1e3), foot(LENGTH, 0, 1e3), foot(LENGTH, WIDTH, 1e3)]
    inner = [foot(x * LENGTH, y, 3e3) for x in (0.25, 0.75) for y in (0, WIDTH)]
    loads = [*RigBalance(on_feet(*ends, *inner)).loads.values()]
    assert loads == pytest.approx([WEIGHT / 16] * 4 + [3 * WEIGHT / 16] * 4, rel=1e-6)


@pytest.mark.parametrize(("share", "is_outside", "is_near"), [
    (0.45, True, False), (0.52, False, True), (0.7, False, False),
])  # fmt: skip
def test_center_of_mass_near_the_edge_of_the_feet_is_reported(
    share: float, is_outside: bool, is_near: bool
) -> None:
    """Feet at one end and at a share of the length: the center is at half of it."""
    rig = on_feet(*(foot(x * LENGTH, y) for x in (0, share) for y in (0, WIDTH)))
    balance = RigBalance(rig)
    assert balance.tips_over == is_outside
    distance = 1e3 * LENGTH * abs(share - 0.5)
    text = " ".join(balance.notes())
    assert (f"is {distance:.3g} mm outside the supports" in text) == is_outside
    assert (f"is only {distance:.2g} mm within the supports" in text) == is_near


@pytest.mark.parametrize("force", [0.9, 1.1])
def test_finger_that_tips_the_plate_is_reported(force: float) -> None:
    """Feet at a distance d from the ends: a corner tips with W (L/2 - d) / d newtons."""
    distance = WEIGHT * LENGTH / 2 / (WEIGHT + force)
    feet = [foot(x, y) for x in (distance, LENGTH - distance) for y in (0, WIDTH)]
    balance = RigBalance(on_feet(*feet))
    assert balance.as_json()["tipping_force_n"] == pytest.approx(force)
    assert ("tips the plate over" in " ".join(balance.notes())) == (force < 1)
    on_eras = replace(RIG, eras=tuple(replace(e, x=abs(e.x - distance)) for e in RIG.eras))
    assert RigBalance(on_eras).as_json()["tipping_force_n"] is None  # bolted to the plate


def test_foot_that_is_lifted_is_named() -> None:
    """A beam on equal springs at 0, 0.1 and 1 of its length, with most of its mass at one end.

    Each carries W / 3 + W (c - m) (x - m) / S, with the mean m and the sum of squares S of the
    positions and the center c: of three pairs of feet the one at the far end is pulled.
    """
    positions = np.array([0.0, 0.1, 1.0])
    feet = [foot(x * LENGTH, y) for x in positions for y in (0, WIDTH)]
    mass = PointLoad(0.0, WIDTH / 2, mass=24 * RIG.plate.mass)
    balance = RigBalance(on_feet(*feet, masses=(mass,)))
    deviations = positions - positions.mean()
    shares = 1 / 3 + (0.02 - positions.mean()) * deviations / (deviations @ deviations)
    loads = [*balance.loads.values()]
    assert loads == pytest.approx(np.repeat(25 * WEIGHT * shares / 2, 2), rel=1e-6)
    assert not balance.tips_over
    lifted = [note for note in balance.notes() if "lifts off" in note]
    assert [note.partition(":")[0] for note in lifted] == [
        "supports.support 5",
        "supports.support 6",
    ]
    assert math.isclose(min(loads), -0.0284 * 25 * WEIGHT / 2, rel_tol=0.02)
