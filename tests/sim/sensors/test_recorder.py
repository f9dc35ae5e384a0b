"""The recorder of a bench."""

from pathlib import Path

import numpy as np
import pytest

from bench_driving import play
from drivers.contents import Tone
from full_disk import full_disk
from model.errors import InputError
from model.rig.rig import Rig
from recordings import read_recording
from sim.bench.bench import Bench
from sim.plant.accelerometer import Accelerometer
from sim.sensors.recorder import Recorder

HALF_STROKE = Tone(0, 110.0, 0.5)


@pytest.mark.parametrize("ending", ["csv", "wav", "uff"])
def test_recorder_records_sensors_and_fingers_without_gaps(
    coarse_rig: Rig, tmp_path: Path, ending: str
) -> None:
    """A sensor at the centre of a finger reads what the finger feels."""
    bench = Bench(coarse_rig, now=3.0, sample_rate=4000.0)
    bench.place_fingers({"7": (0.1, 0.08)}, now=3.0)
    path = tmp_path / f"run.{ending}"
    recorder = Recorder(bench, path, sensors=[Accelerometer("P1", 0.1, 0.08)], fingers=["7"])
    play(bench, HALF_STROKE, now=3.01, watchdog=2.0)
    for now in (3.0101, 3.11, 3.5):
        bench.advance(now)
    recorder.stop()
    bench.advance(4.0)
    recorder.finish()
    found = read_recording(path)
    assert found.names == ("P1", "finger_7")
    assert found.sample_rate == 4000.0
    assert found.samples.shape == (2000, 2)
    assert found.start == pytest.approx(3.00025, abs=1e-5)
    np.testing.assert_allclose(found.points, [[0.1, 0.08]] * 2)
    np.testing.assert_allclose(found.samples[:, 0], found.samples[:, 1], atol=1e-4)
    assert not found.samples[:39].any()
    assert np.abs(found.samples[200:]).max() > 1
    assert [file.name for file in tmp_path.iterdir() if not file.name.endswith("json")] == [
        path.name
    ]


def test_recorder_follows_moved_fingers_and_zeroes_lifted_ones(
    coarse_rig: Rig, tmp_path: Path
) -> None:
    """The columns are those of the start."""
    bench = Bench(coarse_rig, now=0.0)
    bench.place_fingers({"a": (0.1, 0.08), "b": (0.2, 0.1)}, now=0.0)
    path = tmp_path / "run.csv"
    recorder = Recorder(bench, path, sensors=[], fingers=["a", "b"])
    play(bench, HALF_STROKE, now=0.0, watchdog=2.0)
    bench.advance(0.1)
    bench.place_fingers({"b": (0.02, 0.02)}, now=0.1)
    bench.advance(0.2)
    recorder.stop()
    recorder.finish()
    late = read_recording(path).during(0.101, 0.2)
    assert not late.samples[:, 0].any()
    assert np.abs(late.samples[:, 1]).max() > 1


def test_recorder_stops_at_its_maximum_size(
    coarse_rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Further samples are dropped, and is_full is set."""
    monkeypatch.setattr("sim.sensors.recorder.max_values", lambda path: 1000)
    bench = Bench(coarse_rig, now=0.0)
    sensors = [Accelerometer("P1", 0.1, 0.08), Accelerometer("P2", 0.1, 0.1)]
    recorder = Recorder(bench, tmp_path / "run.csv", sensors=sensors, fingers=[])
    bench.advance(0.049)
    assert not recorder.is_full
    bench.advance(0.3)
    assert recorder.is_full
    recorder.stop()
    recorder.finish()
    assert len(read_recording(tmp_path / "run.csv").samples) == 500


def test_recorder_refuses_an_unusable_file_at_the_start(coarse_rig: Rig, tmp_path: Path) -> None:
    """No channels, an unrelated file, a missing folder, and a name too long for the format."""
    bench = Bench(coarse_rig, now=0.0)
    sensor = Accelerometer("a very long name", 0.1, 0.1)
    letter = tmp_path / "letter.csv"
    letter.write_text("Dear Sir")
    for path, sensors in (
        (tmp_path / "run.csv", []),
        (letter, [sensor]),
        (tmp_path / "none" / "run.csv", [sensor]),
        (tmp_path / "run.uff", [sensor]),
    ):
        with pytest.raises(InputError, match=path.name):
            Recorder(bench, path, sensors=sensors, fingers=[])
    assert letter.read_text() == "Dear Sir"
    assert bench.probes == []


def test_recorder_survives_a_full_disk(coarse_rig: Rig, tmp_path: Path) -> None:
    """The bench continues; the error states the recorded time, and no file is left."""
    path = tmp_path / "run.csv"
    path.write_text("time_s,old")
    bench = Bench(coarse_rig, now=0.0, sample_rate=4000.0)
    recorder = Recorder(bench, path, sensors=[Accelerometer("P1", 0.1, 0.1)], fingers=[])
    bench.advance(0.5)
    with full_disk(at=32_000):  # bytes, those of one second
        for moment in np.arange(0.51, 2.0, 0.01):
            bench.advance(moment)
        recorder.stop()
        with pytest.raises(InputError, match="after 1 s"):
            recorder.finish()
    assert path.read_text() == "time_s,old"
    assert list(tmp_path.iterdir()) == [path]


def test_recorder_keeps_the_old_file_without_samples(coarse_rig: Rig, tmp_path: Path) -> None:
    """A file is replaced only by a complete one."""
    path = tmp_path / "run.csv"
    path.write_text("time_s,old")
    bench = Bench(coarse_rig, now=0.0)
    recorder = Recorder(bench, path, sensors=[Accelerometer("P1", 0.1, 0.1)], fingers=[])
    recorder.stop()
    with pytest.raises(InputError, match=path.name):
        recorder.finish()
    assert path.read_text() == "time_s,old"
    assert list(tmp_path.iterdir()) == [path]
