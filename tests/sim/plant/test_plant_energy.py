"""The energy of the plant: what the bases put in is stored or lost."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import simpson

from driven_bases import BASES
from finger_energy import held_by_fingers, power_lost_in_fingers
from model.reduction.reduced_plate import modal_matrices, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import FingertipLoad, footprints_of
from paper_plate import make_paper_rig
from resting_fingers import resting
from sim.plant.plant import Plant

KNOTS_APART = 0.005  # s
STEP = 1e-5  # s; the fastest motion of the reduced plate has some twenty of them in a period
FIRST, SECOND, MOVED = (0.11, 0.07), (0.25, 0.15), (0.3048, 0.1)
PERIODS: list[tuple[float, Mapping[str, FingertipLoad]]] = [
    (0.03, {}),
    (0.05, resting(FIRST)),
    (0.075, resting(FIRST, SECOND)),
    (0.09, resting(MOVED, SECOND)),
    (0.13, {}),
]
"""Until when which fingers rest on the plate."""


@dataclass(frozen=True, eq=False)
class Books:
    """Energies [J] of a stretch of time: put in by the bases, lost; stored at its start and end."""

    put_in: float
    lost: float
    begin: float
    end: float


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate; no two ERAs damp alike, one hardly at all."""
    paper = make_paper_rig(12, 9)
    unlike = zip(paper.eras, (0.1, 3.5, 10.0, 20.0), (0.0, 0.005, 0.01, 0.02), strict=True)
    return replace(paper, eras=tuple(replace(era, damping=c, bolt_mass=m) for era, c, m in unlike))


def kept_for(plant: Plant, rig: Rig, until: float) -> Books:
    """Go on until a moment [s] and keep books, from displacements, velocities and spring laws."""
    _, structural, _ = modal_matrices(plant.reduced, rig.eras)
    at_eras = plant.reduced.at(footprints_of(rig.eras))
    structural = structural - (at_eras.T * [era.damping for era in rig.eras]) @ at_eras
    k = np.array([era.stiffness for era in rig.eras])
    c = np.array([era.damping for era in rig.eras])
    bolts = np.array([era.bolt_mass for era in rig.eras])
    count = 2 * round((until - plant.time) / STEP / 2)
    times = np.linspace(plant.time, until, count + 1)
    power, loss, stored = np.empty(count + 1), np.empty(count + 1), np.empty(count + 1)
    for row, time in enumerate(times):
        plant.skip(float(time))
        q, v = plant.state
        # Bases turn sharply at the knots of an envelope: the last moment is still before one.
        y, dy = np.array([base.motion(min(time, until - 1e-12)) for base in BASES]).T
        stretch, speed = y - at_eras @ q, dy - at_eras @ v
        power[row] = (k * stretch + c * speed) @ dy
        loss[row] = c @ speed**2 + v @ structural @ v + power_lost_in_fingers(plant)
        stored[row] = (
            v @ v
            + (plant.reduced.omega * q) @ (plant.reduced.omega * q)
            + k @ stretch**2
            + bolts @ (at_eras @ v) ** 2
        ) / 2 + held_by_fingers(plant)
    put_in, lost = simpson([power, loss], times)
    return Books(float(put_in), float(lost), float(stored[0]), float(stored[-1]))


@pytest.mark.long
def test_plant_energy_balance(rig: Rig) -> None:
    """From knot to knot the books balance to 1e-5 of what went through them, for ramps as well.

    When a finger comes, moves or goes, what is stored changes by what it holds and nothing else.
    """
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))
    plant = Plant(reduced, rig.eras)
    for number, base in enumerate(BASES):
        plant.set_input(number, base.terms)
    expected = 0.0  # what is stored when a period begins
    for until, contacts in PERIODS:
        gone = held_by_fingers(plant)
        plant.set_contacts(contacts)
        expected += held_by_fingers(plant) - gone
        for knot in range(round(plant.time / KNOTS_APART) + 1, round(until / KNOTS_APART) + 1):
            books = kept_for(plant, rig, knot * KNOTS_APART)
            assert books.begin == pytest.approx(expected, rel=1e-9, abs=1e-15)
            moved = books.lost + abs(books.put_in) + books.begin
            assert moved > 1e-8
            left = books.begin + books.put_in - books.lost
            assert books.end == pytest.approx(left, abs=1e-5 * moved)
            expected = books.end
