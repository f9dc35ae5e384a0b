"""Virtual sensors on the vibrating plate, against what the model says of the same plate."""

import math

import numpy as np
import pytest

from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.point_load import footprints_of
from model.transients.base_motion import Term
from model.transients.time_response import plate_in_time
from sim.plant.plant import Plant
from sim.sensors.accelerometer import Accelerometer, positions, read_sensors
from sim.sensors.recording import Recording
from sim.sensors.signal_measures import (
    reverberation_time,
    steady_contrast_db,
    transient_contrast_db,
)

RATE = 5000.0
TARGET = Accelerometer("target", 0.08, 0.06, noise_density=1e-3, reach=500.0, resolution=1e-3)
QUIET = Accelerometer("quiet", 0.21, 0.17, noise_density=1e-3, reach=500.0, resolution=1e-3)


@pytest.fixture(scope="module")
def reduced(coarse_rig: Rig) -> ReducedPlate:
    """The plate in few coordinates."""
    return reduce_plate(coarse_rig.plate, coarse_rig.mesh, footprints_of(coarse_rig.eras))


def record(
    rig: Rig, reduced: ReducedPlate, frequency: float, *, stop: float, end: float
) -> Recording:
    """One ERA at full stroke from 0 until stop [s], recorded until end [s]."""
    plant = Plant(reduced, rig.eras)
    plant.set_input(0, [Term(0.0, stop, 2 * math.pi * frequency, rig.eras[0].stroke + 0j)])
    sensors = [TARGET, QUIET]
    times, truth = plant.advance(end, sample_rate=RATE, shapes=reduced.at(positions(sensors)))
    return read_sensors(
        sensors, truth, sample_rate=RATE, start=float(times[0]), rng=np.random.default_rng(0)
    )


def test_steady_contrast_agrees_with_the_model(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """From signals alone, once settled, as the steady state in frequency within 0.2 dB.

    In the first 100 ms it is another one, since the plate's own modes ring.
    """
    recording = record(coarse_rig, reduced, 130.0, stop=3.0, end=3.0)
    names = {"target": ["target"], "quiet": ["quiet"]}
    measured = steady_contrast_db(recording.during(2.5, 3.0), [130.0], **names)
    free = solve_free_plate(coarse_rig.plate, coarse_rig.mesh)
    points = positions([TARGET, QUIET])
    steady = np.abs(free.acceleration(coarse_rig.eras, np.array([130.0]), points)[0, 0])
    assert measured == pytest.approx(20 * math.log10(steady[0] / steady[1]), abs=0.2)
    assert abs(transient_contrast_db(recording, onset=0.0, **names) - measured) > 1


def test_reverberation_time_is_that_of_the_ringing_mode(
    coarse_rig: Rig, reduced: ReducedPlate
) -> None:
    """Driven at a resonance and let go: ln(1000) over the decay rate of that eigenvalue."""
    eigenvalues = plate_in_time(reduced, coarse_rig.eras).eigenvalues
    bending = eigenvalues[
        (eigenvalues.imag > 2 * np.pi * 90) & (eigenvalues.imag < 2 * np.pi * 400)
    ]
    mode = bending[np.argmax(bending.real)]  # the one that rings longest is left in the end
    recording = record(coarse_rig, reduced, mode.imag / (2 * np.pi), stop=2.0, end=4.0)
    measured = reverberation_time(recording, end=2.0)
    assert measured == pytest.approx(-math.log(1000) / mode.real, rel=0.05)
