"""The plate in time against the unreduced finite-element plate: transients and steady states."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from benchmarks.direct_plate import direct_acceleration
from driven_bases import BASES, STROKE, Base, resting
from model.arrays import ComplexArray, FloatArray
from model.fem.plate import assemble
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import Era, FingertipLoad, footprints_of
from model.transients.base_motion import Term
from paper_plate import make_paper_rig
from plate_in_time import apart, lock_in
from sim.plant.plant import Plant
from whole_plate import WholePlate, whole_plate

RATE = 100_000.0
FIRST, SECOND, MOVED = (0.11, 0.07), (0.25, 0.15), (0.19, 0.12)
COMING_AND_GOING: list[tuple[float, Mapping[str, FingertipLoad]]] = [
    (0.0312, resting(FIRST)),
    (0.05, resting(FIRST, SECOND)),
    (0.06, resting(MOVED, SECOND)),
    (0.085, resting(MOVED)),
    (0.1, {}),
]


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate on a mesh for a stepping solver; no two ERAs damp alike."""
    coarse = make_paper_rig(8, 6)
    unlike = zip(coarse.eras, (0.5, 3.5, 10.0, 20.0), (0.0, 0.005, 0.01, 0.02), strict=True)
    return replace(coarse, eras=tuple(replace(era, damping=c, bolt_mass=m) for era, c, m in unlike))


@pytest.fixture(scope="module")
def whole(rig: Rig) -> WholePlate:
    """All its degrees of freedom."""
    return whole_plate(rig.plate, rig.mesh, rig.eras)


@pytest.fixture(scope="module")
def reduced(rig: Rig) -> ReducedPlate:
    """A few dozen coordinates of it, as the bench takes them."""
    return reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))


def set_bases(plant: Plant, bases: Sequence[Base]) -> None:
    """Let all bases move as they do."""
    for number, base in enumerate(bases):
        plant.set_input(number, base.terms)


def felt(samples: FloatArray) -> FloatArray:
    """What lies below 1 kHz, all that a finger can feel and more, without delay."""
    return np.asarray(sosfiltfilt(butter(6, 1000.0, fs=RATE, output="sos"), samples, axis=0))


def test_plant_with_changing_contacts_agrees_with_newmark(
    rig: Rig, whole: WholePlate, reduced: ReducedPlate
) -> None:
    """Ramps, an envelope and two fingers: displacement, velocity and what can be felt within 1 %.

    Over the plate, and under the fingers, in every stretch between two changes.
    """
    plant = Plant(reduced, rig.eras)
    set_bases(plant, BASES)
    points = np.vstack([rig.mesh.nodes, [FIRST, SECOND, MOVED]])
    pieces, states = [], []
    for until, contacts in [*COMING_AND_GOING, (0.12, None)]:
        shapes = plant.reduced.at(points)
        pieces.append(plant.advance(until, sample_rate=RATE, shapes=shapes)[1])
        states.append([shapes @ part[: shapes.shape[1]] for part in plant.state])
        if contacts is not None:
            plant.set_contacts(contacts)
    motions = [base.motion for base in BASES]
    stepped = whole.stepped(motions, COMING_AND_GOING, until=0.12, step=1e-5, every=1)
    touch = whole.matrices.deflection_at(points)
    u, v, a = ((touch @ part.T).T for part in stepped)
    found, expected = felt(np.vstack(pieces)), felt(a)
    for begin, end in [(0, 3100), (3200, 5000), (5000, 6000), (6000, 8500), (8500, 12000)]:
        assert apart(found[begin:end], expected[begin:end]) < 0.005
    for finger in (-3, -2, -1):
        assert apart(found[:, finger], expected[:, finger]) < 0.01
    for (until, _), state in zip([*COMING_AND_GOING, (0.12, None)], states, strict=True):
        row = round(until * RATE) - 1
        assert apart(state[0], u[row]) < 0.01
        assert apart(state[1], v[row]) < 0.01


def phasors(
    plant: Plant, points: FloatArray, driven: int, frequency: float, since: float
) -> ComplexArray:
    """Accelerations per base amplitude [1/s²] at points, of one ERA that has been driven long."""
    times, samples = plant.advance(
        since + 0.2, sample_rate=10_000.0, shapes=plant.reduced.at(points)
    )
    return lock_in(times, samples, frequency) / STROKE


def test_plant_viscous_equivalent_agrees_with_the_loss_factor() -> None:
    """Against the hysteretic direct solve: magnitudes over the plate, 0.1 % in the median.

    No causal law of damping can have the same loss at all frequencies; this is what is left.
    """
    fine = make_paper_rig(24, 18)
    eras: Sequence[Era] = fine.eras
    reduced = reduce_plate(fine.plate, fine.mesh, footprints_of(eras))
    frequencies = np.arange(40.0, 501.0, 46.0)
    direct = direct_acceleration(
        assemble(fine.plate, fine.mesh), eras, frequencies, fine.mesh.nodes
    )
    plant = Plant(reduced, eras)
    off = []
    for row, frequency in enumerate(frequencies):
        begin = plant.time
        plant.set_input(0, [Term(begin, np.inf, 2 * np.pi * frequency, STROKE)])
        plant.skip(begin + 20.0)
        found = phasors(plant, fine.mesh.nodes, 0, float(frequency), begin + 20.0)
        off.append(apart(np.abs(found), np.abs(direct[row, 0]) / eras[0].stroke))
    assert np.median(off) < 0.001
    assert max(off) < 0.002
