"""Files of recordings."""

from pathlib import Path

import numpy as np
import pytest

from model.errors import InputError
from recordings import read_recording
from sim.sensors.recording import Recording, write_recording


@pytest.fixture
def recorded() -> Recording:
    """Two sensors, awkward numbers, begun late."""
    samples = np.random.default_rng(3).standard_normal((500, 2)) * [40.0, 1e-4] - 1 / 3
    points = np.array([[0.1, 0.2], [1 / 30, 0.05]])
    return Recording(("P1", "left edge"), points, 5000.0, 12.25, samples)


# Relative to the largest value: every digit, 24 bits, 12 digits.
@pytest.mark.parametrize(("ending", "step"), [("csv", 0.0), ("wav", 6e-8), ("uff", 1e-11)])
def test_recording_round_trip(
    recorded: Recording, tmp_path: Path, ending: str, step: float
) -> None:
    """Other tools read all values within the resolution of the format; WAV within full scale."""
    path = tmp_path / f"run.{ending}"
    write_recording(path, recorded)
    back = read_recording(path)
    assert back.names == recorded.names
    np.testing.assert_allclose(back.points, recorded.points, rtol=1e-12)
    assert (back.sample_rate, back.start) == (5000.0, 12.25)
    largest = np.abs(recorded.samples).max()
    np.testing.assert_allclose(back.samples, recorded.samples, rtol=0, atol=step * largest)


def test_write_recording_refuses_what_a_format_cannot_hold(
    recorded: Recording, tmp_path: Path
) -> None:
    """Unknown suffix, values that are not finite, fractional rates in WAV, long names in UFF."""
    with pytest.raises(InputError, match=r"run.txt: .*csv"):
        write_recording(tmp_path / "run.txt", recorded)
    bad = Recording(recorded.names, recorded.points, 5000.0, 0.0, recorded.samples * np.nan)
    with pytest.raises(InputError, match="finite"):
        write_recording(tmp_path / "run.csv", bad)
    slow = Recording(recorded.names, recorded.points, 4999.5, 0.0, recorded.samples)
    with pytest.raises(InputError, match=r"4999.5"):
        write_recording(tmp_path / "run.wav", slow)
    named = Recording(("P1", "a long name"), recorded.points, 5000.0, 0.0, recorded.samples)
    with pytest.raises(InputError, match="a long name"):
        write_recording(tmp_path / "run.uff", named)
    assert not list(tmp_path.iterdir())
