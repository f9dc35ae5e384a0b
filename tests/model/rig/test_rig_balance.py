"""How a plate rests on its supports: loads, centers of mass and tipping, by levers and moments."""

from dataclasses import replace

import numpy as np
import pytest

from kit.plates import make_paper_rig
from model.rig.rig_balance import RigBalance
from model.structure.attachments import PointLoad
from model.structure.statics import GRAVITY

RIG = make_paper_rig(12, 9)
LENGTH = RIG.plate.length
WIDTH = RIG.plate.width
WEIGHT = GRAVITY * RIG.plate.mass


def foot(x: float, y: float, stiffness: float = 2e3) -> PointLoad:
    """A foot at a position [m], of a stiffness [N/m]."""
    return PointLoad(x, y, stiffness=stiffness, is_foot=True)


def pair_of_feet(x: float, stiffness: float = 2e3) -> list[PointLoad]:
    """Feet at both long edges, at a distance x [m] from the left edge."""
    return [foot(x, 0, stiffness), foot(x, WIDTH, stiffness)]


def balance_on(feet: list[PointLoad], *masses: PointLoad) -> RigBalance:
    """The balance of the paper's plate on feet, without ERAs."""
    return RigBalance(replace(RIG, eras=(), wiring={}, masses=(*masses, *feet), supports=()))


def test_loads_on_three_feet_follow_from_levers() -> None:
    """Two feet at one end and one at the other, of any stiffness, with a mass above the last."""
    feet = [foot(0, 0, 1e3), foot(0, WIDTH, 7e3), foot(LENGTH, WIDTH / 2, 3e3)]
    mass_weight = GRAVITY * 0.2

    balance = balance_on(feet, PointLoad(LENGTH, WIDTH / 2, mass=0.2))
    report = balance.as_json()

    expected = [WEIGHT / 4, WEIGHT / 4, WEIGHT / 2 + mass_weight]
    assert [*balance.loads.values()] == pytest.approx(expected, rel=1e-6)
    total = WEIGHT + mass_weight
    x = (WEIGHT * LENGTH / 2 + mass_weight * LENGTH) / total
    assert report["centre_of_mass_m"] == pytest.approx([x, WIDTH / 2])
    assert report["weight_n"] == pytest.approx(total)
    assert [*balance.notes()] == []


@pytest.mark.parametrize(
    ("share", "tips_over", "note"),
    [
        (0.45, True, "is 15.2 mm outside the supports"),
        (0.52, False, "is only 6.1 mm within the supports"),
    ],
)
def test_center_of_mass_near_the_edge_of_the_feet_is_reported(
    share: float, tips_over: bool, note: str
) -> None:
    """Feet at one end and at a share of the length, 304.8 mm: the center is at half of it."""
    balance = balance_on(pair_of_feet(0) + pair_of_feet(share * LENGTH))

    assert balance.tips_over == tips_over
    assert note in " ".join(balance.notes())


def test_center_of_mass_well_within_the_feet_is_not_reported() -> None:
    """Feet at one end and at 70 % of the length."""
    balance = balance_on(pair_of_feet(0) + pair_of_feet(0.7 * LENGTH))

    assert not balance.tips_over
    assert "the supports" not in " ".join(balance.notes())


@pytest.mark.parametrize("force", [0.9, 1.1])
def test_finger_that_tips_the_plate_is_reported(force: float) -> None:
    """Feet at a distance d from the ends: a corner tips with W (L/2 - d) / d newtons."""
    distance = WEIGHT * LENGTH / 2 / (WEIGHT + force)

    balance = balance_on(pair_of_feet(distance) + pair_of_feet(LENGTH - distance))

    assert balance.as_json()["tipping_force_n"] == pytest.approx(force)
    assert ("tips the plate over" in " ".join(balance.notes())) == (force < 1)


def test_plate_that_is_bolted_to_eras_does_not_tip() -> None:
    """ERAs hold it down, wherever they are."""
    eras = tuple(replace(era, x=abs(era.x - 0.1)) for era in RIG.eras)

    assert RigBalance(replace(RIG, eras=eras)).as_json()["tipping_force_n"] is None


def test_lifted_foot_is_named() -> None:
    """A beam on equal springs at 0, 0.1 and 1 of its length, with most of its mass at one end.

    Each carries W / 3 + W (c - m) (x - m) / S, with the mean m and the sum of squares S of the
    positions and the center c: of three pairs of feet the pair at the far end is pulled.
    """
    mass = PointLoad(0.0, WIDTH / 2, mass=24 * RIG.plate.mass)
    feet = pair_of_feet(0) + pair_of_feet(0.1 * LENGTH) + pair_of_feet(LENGTH)

    balance = balance_on(feet, mass)

    positions = np.array([0.0, 0.1, 1.0])
    deviations = positions - positions.mean()
    tilt = (0.02 - positions.mean()) / (deviations @ deviations)
    shares = 1 / 3 + tilt * deviations
    pair_loads = 25 * WEIGHT * shares
    assert pair_loads[-1] == pytest.approx(-0.0284 * 25 * WEIGHT, rel=0.02)
    assert [*balance.loads.values()] == pytest.approx(np.repeat(pair_loads / 2, 2), rel=1e-6)
    assert not balance.tips_over
    lifted = [note.partition(":")[0] for note in balance.notes() if "lifts off" in note]
    assert lifted == ["supports.support 5", "supports.support 6"]
