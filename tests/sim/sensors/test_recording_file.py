"""Files of recordings."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from model.errors import InputError
from sim.sensors.formats.wav_file import sidecar
from sim.sensors.recording import Recording
from sim.sensors.recording_file import read_recording, write_recording


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
    """All values are restored within the resolution of the format."""
    path = tmp_path / f"run.{ending}"
    write_recording(path, recorded)
    back = read_recording(path)
    assert back.names == recorded.names
    np.testing.assert_allclose(back.points, recorded.points, rtol=1e-12)
    assert (back.sample_rate, back.start) == (5000.0, 12.25)
    largest = np.abs(recorded.samples).max()
    np.testing.assert_allclose(back.samples, recorded.samples, rtol=0, atol=step * largest)


def test_wav_has_float_channels_within_full_scale(recorded: Recording, tmp_path: Path) -> None:
    """Other tools can play it."""
    write_recording(tmp_path / "run.wav", recorded)
    rate, samples = wavfile.read(tmp_path / "run.wav")
    assert (rate, samples.dtype, samples.shape) == (5000, np.float32, (500, 2))
    assert 0.5 <= np.abs(samples).max() <= 1


def replaced(path: Path, before: bytes, after: bytes) -> None:
    """Damage a file."""
    content = path.read_bytes()
    assert before in content
    path.write_bytes(content.replace(before, after, 1))


@pytest.mark.parametrize(
    ("before", "after", "place"),
    [
        (b"P1_m_s2", b"P1_g", r"run.csv:1: .*P1_g"),
        (b"time_s", b"frequency_hz", r"run.csv:1: .*time_s"),
        (b"\ny_m", b"\nz_m", r"run.csv:3: .*y_m"),
        (b"\n12.2504,", b"\n12.2504x,", r"run.csv:6: time_s.*12.2504x"),
        (b"\n12.2504,", b"\n12.2504,1,", r"run.csv:6: .*3 .*4"),
        (b"\n12.2504,", b"\n12.2505,", r"run.csv:6: time_s"),
        (b"\n12.2504,", b"\n\xff,", "run.csv: "),
    ],
)
def test_csv_refuses_a_damaged_file(
    recorded: Recording, tmp_path: Path, before: bytes, after: bytes, place: str
) -> None:
    """The error names file and line."""
    write_recording(tmp_path / "run.csv", recorded)
    replaced(tmp_path / "run.csv", before, after)
    with pytest.raises(InputError, match=place):
        read_recording(tmp_path / "run.csv")


@pytest.mark.parametrize(
    ("before", "after", "place"),
    [
        (b"m/s^2", b"g    ", r"run.uff:\d+: .*m/s"),
        (
            b"         1                  SI",
            b"         7                  SI",
            r"run.uff:\d+: .*7",
        ),
        (b"       500 ", b"       501 ", r"run.uff:\d+: .*501"),
        (b" -3.33", b" -3.x3", r"run.uff:\d+: "),
        (b"\n    -1\n", b"\n    -2\n", r"run.uff:\d+: "),
    ],
)
def test_uff_refuses_a_damaged_file(
    recorded: Recording, tmp_path: Path, before: bytes, after: bytes, place: str
) -> None:
    """The error names file and line of the record."""
    write_recording(tmp_path / "run.uff", recorded)
    replaced(tmp_path / "run.uff", before, after)
    with pytest.raises(InputError, match=place):
        read_recording(tmp_path / "run.uff")


def test_wav_refuses_a_damaged_file_or_sidecar(recorded: Recording, tmp_path: Path) -> None:
    """The error names the file that is wrong."""
    path = tmp_path / "run.wav"
    write_recording(path, recorded)
    whole = path.read_bytes()
    for content in (whole[:-7], whole[:-80], b"RIFFxxxx", b"\x00" * 100):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"run.wav: "):
            read_recording(path)
    wavfile.write(path, 5000, np.zeros((10, 2), dtype=np.int16))
    with pytest.raises(InputError, match="int16"):
        read_recording(path)
    wavfile.write(path, 8000, np.zeros((10, 2), dtype=np.float32))
    with pytest.raises(InputError, match=r"run.wav: .*8000"):
        read_recording(path)
    sidecar(path).write_text('{"format":\n nonsense}')
    with pytest.raises(InputError, match=r"run.wav.json: "):
        read_recording(path)
    sidecar(path).write_text('{"format": "other"}')
    with pytest.raises(InputError, match=r"run.wav.json: format"):
        read_recording(path)
    sidecar(path).unlink()
    with pytest.raises(InputError, match=r"run.wav.json"):
        read_recording(path)


@pytest.mark.parametrize("ending", ["csv", "wav", "uff"])
def test_read_recording_refuses_missing_empty_and_foreign_files(
    tmp_path: Path, ending: str
) -> None:
    """Every reader names the file."""
    path = tmp_path / f"run.{ending}"
    with pytest.raises(InputError, match=path.name):
        read_recording(path)
    path.write_bytes(b"\n")
    with pytest.raises(InputError, match=path.name):
        read_recording(path)
    path.write_text("dear diary\n")
    with pytest.raises(InputError, match=path.name):
        read_recording(path)


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
