"""Exciters on the simulated plate: answers of a table as they are played, and contacts."""

import math

import numpy as np
import pytest

from model.answer.plan import query
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import Fingertip, FingertipLoad, footprints_of
from model.table.table_file import build_table
from model.transients.base_motion import raised_cosine
from plates import exciter_rig, lock_in
from sim.plant.excited_plate import play
from sim.plant.plant import Plant, SampledPlant

RATE = 10_000.0
AT = np.array([[0.11, 0.09]])


def plant_of(rig: Rig) -> Plant:
    """Its plate at rest."""
    places = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(rig.plate, rig.mesh, places, frequency_max=500.0)
    return Plant(reduced, rig.eras, loads=rig.masses)


def settled(plant: Plant, until: float, frequency: float) -> complex:
    """Amplitude at a point in the last fifth of a second up to a time."""
    plant.skip(until - 0.2)
    shapes = plant.reduced.at(AT)
    times, felt = plant.advance(until, sample_rate=RATE, shapes=shapes)
    return complex(lock_in(times, felt, frequency)[0])


def test_a_finger_that_comes_while_exciters_play() -> None:
    """Displacements go on, of magnets too; it settles as if the finger had been there from rest."""
    rig, omega = exciter_rig("type: DAEX25FHE-4"), 2 * math.pi * 95.0
    finger = {"a": FingertipLoad(0.11, 0.09, Fingertip())}
    plant, before = plant_of(rig), plant_of(rig)
    before.set_contacts(finger)
    for each in (plant, before):
        for number in range(4):
            each.set_input(number, raised_cosine(0.0, 0.02, omega, 0j, 1.0 + 0.5j * number))
    plant.skip(0.0317)
    was = np.concatenate(plant.state)
    plant.set_contacts(finger)
    x, v = plant.state
    carried = np.concatenate([x[:-1], v[:-1]])  # without the phalanx, which is at rest
    assert len(x) == len(plant.reduced.omega) + 4 + 1
    magnets = x[-5:-1]
    assert magnets == pytest.approx(was[len(was) // 2 - 4 : len(was) // 2])
    assert np.abs(magnets).min() > 1e-6
    assert len(carried) == 2 * (len(x) - 1)
    assert [x[-1], v[-1]] == pytest.approx([0, 0], abs=1e-12)
    there, from_rest = settled(plant, 1.5, 95.0), settled(before, 1.5, 95.0)
    assert there == pytest.approx(from_rest, rel=1e-3)


def test_samples_of_a_waveform_drive_as_tones_do() -> None:
    """Amplifiers that make waveforms: a sine by samples settles at the amplitude of the tone."""
    rig, frequency = exciter_rig(), 120.0
    by_tones, by_samples = plant_of(rig), SampledPlant(plant_of(rig), rate=48_000.0)
    by_tones.set_input(1, raised_cosine(0.0, 0.0, 2 * math.pi * frequency, 1j, 1.0))
    times = np.arange(48_000) / 48_000.0
    volts: FloatArray = np.zeros((len(times), 4))
    volts[:, 1] = np.sin(2 * math.pi * frequency * times)
    felt = by_samples.advance(volts, shapes=by_tones.reduced.at(AT))
    last = times > 0.8
    sampled = complex(lock_in(times[last] - 0.5 / 48_000.0, felt[last], frequency)[0])
    assert sampled == pytest.approx(settled(by_tones, 1.0, frequency), rel=2e-3)


def test_answers_are_felt_on_the_exact_board() -> None:
    """What a table of exciters says nominally of two fingers is played: to 0.3 dB."""
    rig = exciter_rig(frequency="[60, 300]")
    table = build_table(rig, frequencies=np.arange(70.0, 300.0, 20.0), drive_mode="phased")
    targets, quiet = ((0.06, 0.05),), ((0.22, 0.17),)
    answer = query(table, Placement(targets, quiet), 20.0)
    fingers = [Finger(targets[0], stimulus=Stimulus()), Finger(quiet[0])]
    found = play(rig, plant_of(rig).reduced, answer.layers, fingers, duration=None)
    assert found.fingers[0].level_db_sl == pytest.approx(answer.fingers[0].level_db_sl, abs=0.3)
    assert found.contrast_db == pytest.approx(answer.fingers[0].contrast_db, abs=0.5)
