"""Exciters on a board in time, settled: what the frequency domain says at each frequency."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate, supported_modes
from model.rig.rig import Rig
from model.structure.attachments import (
    Fingertip,
    FingertipLoad,
    footprints_of,
    rigid_body_frequencies,
)
from model.transients.knots import steady_states
from model.transients.time_response import PlateInTime, enveloped_accelerations, plate_in_time
from plates import exciter_rig

POINTS = np.array([[0.05, 0.05], [0.15, 0.12], [0.28, 0.2]])
FINGER = FingertipLoad(0.11, 0.09, Fingertip())


def in_time(rig: Rig, *contacts: FingertipLoad) -> PlateInTime:
    """Its plate, reduced for all that acts on it."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses, [FINGER]))
    return plate_in_time(reduced, rig.eras, loads=rig.masses, contacts=contacts)


def lossless(keys: str) -> Rig:
    """A board that itself hardly loses, as losses of a plate differ in time off resonance."""
    rig = exciter_rig(keys, frequency="[40, 500]")
    gains = ((40.0, 1.0, 0.0), (500.0, 0.7, -0.5))
    eras = tuple(replace(era, gains=gains) for era in rig.eras)
    return replace(rig, plate=replace(rig.plate, loss_factor=1e-4), eras=eras)


@pytest.mark.parametrize(
    "keys", ["type: DAEX25FHE-4", "type: DAEX13-4SM", "type: DAEX25FHE-4, magnet: held"]
)
def test_settled_vibration_is_that_of_the_frequency_domain(keys: str) -> None:
    """Of each exciter alone, under a finger: within (omega L / R)² of the current, 0.6 %."""
    rig = lossless(keys)
    plate = in_time(rig, FINGER)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    frequencies = np.array([40.0, 62.0, 90.0, 170.0, 330.0, 500.0])
    expected = free.acceleration(rig.eras, frequencies, POINTS, loads=(*rig.masses, FINGER))
    for frequency, fields in zip(frequencies, expected, strict=True):
        omega = 2 * math.pi * frequency
        states = steady_states(plate, omega)
        found = -(omega**2) * states @ (plate.shapes_at(POINTS) @ plate.displacement).T
        apart = np.linalg.norm(found - fields, axis=1) / np.linalg.norm(fields, axis=1)
        assert apart.max() < 6e-3


def test_envelopes_lead_to_the_settled_vibration() -> None:
    """A finger held by its forces on the plate without it: the last row, all exciters at once."""
    rig = lossless("type: DAEX25CT-4")
    plate, weights = in_time(rig), np.array([1.0, 0.3j, -0.5, 0.8])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    fields = free.acceleration(rig.eras, np.array([90.0]), POINTS, loads=(*rig.masses, FINGER))
    found = enveloped_accelerations(
        plate,
        weights * [era.full_level for era in rig.eras],
        90.0,
        points=plate.reduced.at(POINTS),
        fingers=[(plate.reduced.at(np.array([[0.11, 0.09]]))[0], FINGER.fingertip)],
        envelope=np.hanning(60),
        step=0.002,
    )
    assert found[-1] == pytest.approx(weights @ fields[0], rel=5e-3)


def test_lowest_modes_are_those_of_a_board_and_magnets_worked_out() -> None:
    """A stiff board and four magnets that heave: two masses on two springs, by their determinant.

    Statically a free magnet is a weight, and holds nothing.
    """
    rig = exciter_rig("type: DAEX25FHE-4, coil_mass: 0, resonance: 27.2, resonance_is: mounted")
    stiff = replace(rig.plate, material=replace(rig.plate.material, E=1e13))
    board, magnets, foam = stiff.mass, 4 * 0.10929, 4 * 2000.0
    k = magnets * (2 * math.pi * 27.2) ** 2
    a, b, c = board * magnets, -(k * (board + magnets) + foam * magnets), k * foam
    heaves = np.sqrt(np.roots([a, b, c])) / (2 * math.pi)
    modes = supported_modes(
        in_time(replace(rig, plate=stiff)).reduced, rig.eras, loads=rig.masses, frequency_max=100.0
    )
    centre = np.abs(modes.at(np.array([[0.15, 0.115]]))[0])
    found = modes.natural_frequencies[centre > 0.3 * centre.max()]
    assert found[[0, -1]] == pytest.approx(sorted(heaves.real), rel=0.02)
    rigid = rigid_body_frequencies(stiff, rig.eras, loads=rig.masses)
    assert rigid[0] == pytest.approx(math.sqrt(foam / (board + magnets)) / (2 * math.pi), rel=0.02)
