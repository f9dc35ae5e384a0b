"""Virtual accelerometers, and measures of their signals."""

import math

import numpy as np
import pytest

from model.errors import InputError
from model.rig.rig import Rig
from sim.sensors.accelerometer import Accelerometer, read_sensors, scanning_grid
from sim.sensors.recording import Recording
from sim.sensors.signal_measures import (
    reverberation_time,
    spectrum,
    steady_contrast_db,
    tone_phasors,
    transient_contrast_db,
)

RATE = 5000.0


def recording(samples: np.ndarray, *, start: float = 0.0) -> Recording:
    """A recording of sensors P1, P2, ... somewhere."""
    names = tuple(f"P{n + 1}" for n in range(samples.shape[1]))
    return Recording(names, np.zeros((samples.shape[1], 2)), RATE, start, samples)


def test_accelerometer_noise_is_white_and_has_its_density() -> None:
    """White noise of 0.002 m/s²/sqrt(Hz) over 2500 Hz is 0.1 m/s² rms, and flat."""
    sensor = Accelerometer("P1", 0, 0, noise_density=0.002)
    read = read_sensors(
        [sensor],
        np.zeros((200_000, 1)),
        sample_rate=RATE,
        start=0.0,
        rng=np.random.default_rng(1),
    )
    assert read.samples.std() == pytest.approx(0.002 * math.sqrt(2500), rel=0.01)
    power = np.abs(np.fft.rfft(read.samples[:, 0])) ** 2
    low, high = power[1:50_000].mean(), power[50_000:].mean()
    assert low == pytest.approx(high, rel=0.03)


def test_accelerometer_applies_scale_range_and_resolution() -> None:
    """A reading is scaled, clipped and rounded."""
    sensor = Accelerometer("P1", 0, 0, reach=5.0, resolution=0.25, scale=2.0)
    truth = np.array([[0.1], [0.2], [1.06], [40.0], [-40.0]])
    read = read_sensors([sensor], truth, sample_rate=RATE, start=0.0, rng=np.random.default_rng(0))
    assert read.samples[:, 0].tolist() == [0.25, 0.5, 2.0, 5.0, -5.0]


def test_scanning_grid_covers_the_plate(coarse_rig: Rig) -> None:
    """Sensors are in the centres of cells, numbered along x."""
    grid = scanning_grid(coarse_rig.plate, 3, 2, like=Accelerometer("", 0, 0, resolution=0.5))
    assert [sensor.name for sensor in grid] == ["P1", "P2", "P3", "P4", "P5", "P6"]
    assert (grid[1].x, grid[1].y) == pytest.approx((0.1524, 0.05715))
    assert (grid[5].x, grid[5].y) == pytest.approx((0.254, 0.17145))
    assert {sensor.resolution for sensor in grid} == {0.5}


def test_tone_phasors_separate_tones_with_their_phases() -> None:
    """Two tones 10 Hz apart and an offset, at a late time."""
    t = 4321.7 + np.arange(1000) / RATE
    signal = 2 * np.sin(2 * np.pi * 110 * t + 0.7) + 0.3 * np.sin(2 * np.pi * 120 * t - 2) + 5
    found = tone_phasors(recording(signal[:, None], start=4321.7), [110.0, 120.0])
    np.testing.assert_allclose(found[:, 0], [2 * np.exp(0.7j), 0.3 * np.exp(-2j)], atol=1e-6)
    with pytest.raises(InputError, match="4"):
        tone_phasors(recording(signal[:4, None]), [110.0, 120.0])


def test_spectrum_shows_the_amplitude_of_a_tone() -> None:
    """A tone on a bin shows as its peak amplitude there."""
    t = np.arange(5000) / RATE
    lines = spectrum(recording(3 * np.sin(2 * np.pi * 250 * t + 1)[:, None]))
    assert lines.frequencies[lines.amplitude[:, 0].argmax()] == pytest.approx(250)
    assert lines.amplitude.max() == pytest.approx(3.0, rel=1e-3)


def test_contrasts_of_a_synthetic_signal() -> None:
    """Steady: 20 log10 of summed amplitudes 3 and 0.1; transient: of the peaks before that."""
    t = np.arange(5000) / RATE
    target = 2 * np.sin(2 * np.pi * 110 * t) + np.sin(2 * np.pi * 200 * t)
    burst = np.where((t > 0.05) & (t < 0.08), 0.5 * np.sin(2 * np.pi * 300 * t), 0)
    quiet = 0.1 * np.sin(2 * np.pi * 110 * t) + burst
    both = recording(np.column_stack([target, quiet]))
    steady = steady_contrast_db(both.during(0.2, 1.0), [110, 200], target=["P1"], quiet=["P2"])
    assert steady == pytest.approx(20 * math.log10(3 / 0.1), abs=0.01)
    early = transient_contrast_db(both, onset=0.0, target=["P1"], quiet=["P2"])
    assert early == pytest.approx(20 * math.log10(np.abs(target).max() / 0.6), abs=0.5)
    with pytest.raises(InputError, match="P9"):
        transient_contrast_db(both, onset=0.0, target=["P9"], quiet=["P2"])


@pytest.mark.parametrize("wanted", [0.08, 0.5])
def test_reverberation_time_of_known_decays(wanted: float) -> None:
    """Two beating modes of one decay over noise 50 dB below: T60 by hand, within 5 %."""
    t = np.arange(int(1.5 * RATE)) / RATE
    decay = np.exp(-t * math.log(1000) / wanted)
    modes = np.sin(2 * np.pi * 142 * t) + 0.8 * np.sin(2 * np.pi * 201 * t)
    noise = 0.003 * np.random.default_rng(2).standard_normal((len(t), 2))
    signals = np.column_stack([decay * modes, 0.5 * decay * modes]) + noise
    assert reverberation_time(recording(signals), end=0.0) == pytest.approx(wanted, rel=0.05)


def test_reverberation_time_refuses_a_signal_without_decay() -> None:
    """A lasting tone and silence have none."""
    t = np.arange(5000) / RATE
    with pytest.raises(InputError, match="dB"):
        reverberation_time(recording(np.sin(2 * np.pi * 110 * t)[:, None]), end=0.0)
    with pytest.raises(InputError, match="dB"):
        reverberation_time(recording(np.zeros((500, 1))), end=0.0)


def test_sensors_and_recordings_refuse_invalid_values() -> None:
    """Negative noise, NaN positions, mismatched shapes and empty windows."""
    with pytest.raises(InputError, match="noise density"):
        Accelerometer("P1", 0, 0, noise_density=-1.0)
    with pytest.raises(InputError, match="x must be finite"):
        Accelerometer("P1", math.nan, 0)
    with pytest.raises(InputError, match="shapes"):
        Recording(("P1", "P2"), np.zeros((2, 2)), RATE, 0.0, np.zeros((5, 3)))
    with pytest.raises(InputError, match="7 to 8"):
        recording(np.zeros((5, 1))).during(7.0, 8.0)
