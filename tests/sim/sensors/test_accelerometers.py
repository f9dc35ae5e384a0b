"""Virtual accelerometers and their tones, by hand and against the model of the same plate."""

import math

import numpy as np
import pytest

from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.base_motion import Term
from sim.plant.accelerometer import Accelerometer, positions, readings
from sim.plant.plant import Plant
from sim.sensors.recording import Recording

RATE = 5000.0


def recording(samples: np.ndarray, *, start: float = 0.0) -> Recording:
    """A recording of sensors P1, P2, ... somewhere."""
    names = tuple(f"P{n + 1}" for n in range(samples.shape[1]))
    return Recording(names, np.zeros((samples.shape[1], 2)), RATE, start, samples)


def test_accelerometer_noise_is_white_and_has_its_density() -> None:
    """White noise of 0.002 m/s²/sqrt(Hz) over 2500 Hz is 0.1 m/s² rms, and flat."""
    sensor = Accelerometer("P1", 0, 0, noise_density=0.002)
    rng = np.random.default_rng(1)
    read = readings([sensor], np.zeros((200_000, 1)), sample_rate=RATE, rng=rng)
    assert read.std() == pytest.approx(0.002 * math.sqrt(2500), rel=0.01)
    power = np.abs(np.fft.rfft(read[:, 0])) ** 2
    low, high = power[1:50_000].mean(), power[50_000:].mean()
    assert low == pytest.approx(high, rel=0.03)


def test_accelerometer_applies_scale_range_and_resolution() -> None:
    """A reading is scaled, clipped and rounded."""
    sensor = Accelerometer("P1", 0, 0, reach=5.0, resolution=0.25, scale=2.0)
    truth = np.array([[0.1], [0.2], [1.06], [40.0], [-40.0]])
    read = readings([sensor], truth, sample_rate=RATE, rng=np.random.default_rng(0))
    assert read[:, 0].tolist() == [0.25, 0.5, 2.0, 5.0, -5.0]


def test_tones_are_told_apart_with_their_phases() -> None:
    """Two tones 10 Hz apart and an offset, at a late time."""
    t = 4321.7 + np.arange(1000) / RATE
    signal = 2 * np.sin(2 * np.pi * 110 * t + 0.7) + 0.3 * np.sin(2 * np.pi * 120 * t - 2) + 5
    found = recording(signal[:, None], start=4321.7).tones([110.0, 120.0])
    np.testing.assert_allclose(found[:, 0], [2 * np.exp(0.7j), 0.3 * np.exp(-2j)], atol=1e-6)
    with pytest.raises(InputError, match="4"):
        recording(signal[:4, None]).tones([110.0, 120.0])


def test_tones_on_the_plate_are_those_of_the_model(coarse_rig: Rig) -> None:
    """From noisy readings, once settled, as the steady state in frequency within 1 %."""
    rig, at = coarse_rig, ((0.08, 0.06), (0.21, 0.17))
    sensors = [
        Accelerometer("", *each, noise_density=1e-3, reach=500.0, resolution=1e-3) for each in at
    ]
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))
    plant = Plant(reduced, rig.eras)
    plant.set_input(0, [Term(0.0, math.inf, 2 * math.pi * 130.0, rig.eras[0].stroke + 0j)])
    plant.skip(2.5)
    times, truth = plant.advance(3.0, sample_rate=RATE, shapes=reduced.at(positions(sensors)))
    read = readings(sensors, truth, sample_rate=RATE, rng=np.random.default_rng(0))
    found = recording(read, start=float(times[0])).tones([130.0])[0]
    free = solve_free_plate(rig.plate, rig.mesh)
    expected = free.acceleration(rig.eras, np.array([130.0]), np.array(at))[0, 0]
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=0.01)


def test_sensors_and_recordings_refuse_invalid_values() -> None:
    """Negative noise, NaN positions and empty windows."""
    with pytest.raises(InputError, match="noise density"):
        Accelerometer("P1", 0, 0, noise_density=-1.0)
    with pytest.raises(InputError, match="x must be finite"):
        Accelerometer("P1", math.nan, 0)
    with pytest.raises(InputError, match="7 to 8"):
        recording(np.zeros((5, 1))).during(7.0, 8.0)
