"""Fingers that load the plate while it vibrates: nothing jumps, nothing is gained or lost."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from driven_bases import FINGERTIP, faded_base, resting, shaped_base
from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.finger.perception import felt_part
from model.reduction.reduced_plate import ReducedPlate, modal_matrices
from model.rig.rig import Rig
from model.structure.attachments import FingertipLoad
from model.transients.base_motion import Term
from sim.plant.plant import Plant
from sim.plant.sampled import SampledPlant

STROKE = 1e-4
BASES = (
    faded_base(STROKE, 110.0, 0.3, rise=(0.0, 0.02), fall=(0.07, 0.08)),
    faded_base(0.7 * STROKE, 250.0, -1.0, rise=(0.01, 0.03), fall=(0.09, 0.1)),
    shaped_base(STROKE, 171.0, start=0.002, step=0.005, knots=(0, 0.5, 0.8j, -0.3, 0)),
)
PLACES = ((0.11, 0.07), (0.25, 0.15), (0.3048, 0.1))
ONE, THREE = resting(PLACES[0]), resting(*PLACES)


def vibrating(reduced: ReducedPlate, rig: Rig, *, until: float = 0.05) -> Plant:
    """A plate that three bases move, at a moment [s]."""
    plant = Plant(reduced, rig.eras)
    for number, base in enumerate(BASES):
        plant.set_input(number, base.terms)
    plant.skip(until)
    return plant


def on_the_mesh(plant: Plant) -> tuple[FloatArray, FloatArray]:
    """Displacement and velocity at all nodes."""
    plate = plant.reduced.plate
    shapes = plant.reduced.at(Mesh(12, 9, plate.length, plate.width).nodes)
    q, v = (part[: shapes.shape[1]] for part in plant.state)
    return shapes @ q, shapes @ v


def phalanges(plant: Plant) -> dict[str, FloatArray]:
    """Displacement and velocity of each contact's phalanx."""
    last = np.transpose(plant.state)[len(plant.reduced.omega) :]
    return dict(zip(plant.contacts, last, strict=True))


def stored(plant: Plant, rig: Rig) -> float:
    """Energy [J] of the plate on springs at rest: its motion, its bending, and its springs."""
    r = len(plant.reduced.omega)
    q, v = (part[:r] for part in plant.state)
    M, _, K = modal_matrices(plant.reduced, rig.eras)
    return float(q @ K @ q + v @ M @ v) / 2


def test_contacts_keep_displacement_and_velocity_continuous(
    coarse_rig: Rig, reduced: ReducedPlate
) -> None:
    """Fingers come, press harder, move and go: the whole plate goes on from where it is.

    So do the phalanges of fingers that stay; those of new fingers are at rest.
    """
    plant = vibrating(reduced, coarse_rig)
    harder = replace(FINGERTIP, stiffness=3000.0, damping=5.0, contact_mass=0.001)
    pressed = resting(PLACES[0], fingertip=harder)
    elsewhere = {"b": FingertipLoad(0.2, 0.2, FINGERTIP)}
    changes: list[Mapping[str, FingertipLoad]] = [
        ONE, THREE, THREE | pressed, pressed | elsewhere, elsewhere, {}
    ]  # fmt: skip
    for contacts in changes:
        plant.skip(plant.time + 0.0031)
        before, energy = on_the_mesh(plant), stored(plant, coarse_rig)
        resting_before = phalanges(plant)
        plant.set_contacts(contacts)
        assert plant.contacts == contacts
        for id, found in phalanges(plant).items():
            assert_allclose(found, resting_before.get(id, (0.0, 0.0)), rtol=1e-9, atol=1e-12)
        for old, new in zip(before, on_the_mesh(plant), strict=True):
            assert_allclose(new, old, rtol=0, atol=1e-9 * np.abs(old).max())
        assert stored(plant, coarse_rig) == pytest.approx(energy, rel=1e-9)


def test_contacts_drop_vectors_of_lifted_fingers(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Half a second later the plate is as small as before, and nothing of it has jumped."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_input(0, [Term(0.0, np.inf, 2 * np.pi * 207.0, STROKE)])
    plant.set_contacts(THREE)
    plant.skip(0.1)
    size = len(plant.reduced.omega)
    assert size == len(reduced.omega) + 9
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == size
    plant.skip(0.6)
    before = on_the_mesh(plant)
    plant.set_contacts({})
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == len(reduced.omega) + 3
    for old, new in zip(before, on_the_mesh(plant), strict=True):
        assert_allclose(new, old, rtol=0, atol=1e-4 * np.abs(old).max())


POINTS = np.array([[0.11, 0.07], [0.03, 0.2], [0.3, 0.02]])


def test_contacts_are_solved_once(
    coarse_rig: Rig, reduced: ReducedPlate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finger that taps on one spot again and again costs one solve, not one a tap."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_contacts(ONE)
    plant.set_contacts({})
    monkeypatch.setattr("sim.plant.loaded_plates.plate_in_time", None)
    for _ in range(5):
        plant.skip(plant.time + 0.05)
        plant.set_contacts(ONE)
        plant.skip(plant.time + 0.05)
        plant.set_contacts({})


def test_plant_sampling_rate_may_change(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Every tenth sample at 10 kHz is the sample at 1 kHz, also right after the other rate."""
    quick, mixed = (vibrating(reduced, coarse_rig) for _ in range(2))
    shapes = reduced.at(POINTS)
    _, expected = quick.advance(0.12, sample_rate=10_000.0, shapes=shapes)
    mixed.advance(0.07, sample_rate=10_000.0, shapes=shapes)
    times, found = mixed.advance(0.12, sample_rate=1000.0, shapes=shapes)
    assert len(times) == 50
    rows = np.round((times - 0.05) * 10_000).astype(int) - 1
    assert_allclose(found, expected[rows], rtol=0, atol=1e-9 * np.abs(expected).max())


def test_bases_given_as_samples_move_the_plate_as_their_formulas(
    coarse_rig: Rig, reduced: ReducedPlate
) -> None:
    """At 48 kHz, with fingers that come and go: of what skin can feel within 1 %."""
    rate = 48_000
    exact, followed = vibrating(reduced, coarse_rig, until=0.0), Plant(reduced, coarse_rig.eras)
    made = SampledPlant(followed, rate=rate)
    pieces = []
    for number, contacts in enumerate(({}, THREE, ONE)):
        for plant in (exact, followed):
            plant.set_contacts(contacts)
        made.follow()
        times = (np.arange(2400) + 1 + 2400 * number) / rate
        bases = np.zeros((len(times), len(coarse_rig.eras)))
        bases[:, :3] = [[base.motion(time)[0] for base in BASES] for time in times]
        shapes = exact.reduced.at(POINTS)
        samples = made.advance(bases, shapes=shapes)
        _, halfway = exact.advance(times[-1], sample_rate=2 * rate, shapes=shapes)
        pieces.append((samples, halfway[::2]))
    found, expected = (felt_part(np.concatenate(each), rate) for each in zip(*pieces, strict=True))
    assert_allclose(found, expected, rtol=0, atol=0.01 * np.abs(expected).max())
