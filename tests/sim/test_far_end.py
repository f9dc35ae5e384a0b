"""Parts of a far end: terminals, delays of lines, programs of the firmware, recordings.

Delays are by the numbers of their standards and data sheets; recordings of accelerometers and of
fingers are written to files and read back.
"""

import math
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.playing import AmplifierTone
from model.errors import InputError
from model.rig.rig import Rig
from processes.firmware_machine import play
from processes.interrupted import full_disk
from processes.sound_cards import read_recording
from registry import threads
from sim import simulation
from sim.bench.bench import Bench
from sim.plant.fingers import Accelerometer, readings
from sim.sensors import Recorder, Recording, write_recording
from sim.transport.far_end import linked_urls, links_by_amplifier
from sim.transport.simulated_line import LINE_KINDS, Latency, LineKind

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


HALF_STROKE = AmplifierTone(0, 110.0, 0.5)


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
    coarse_rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The columns are those of the start. At its maximum size further samples are dropped."""
    monkeypatch.setattr("sim.sensors.max_values", lambda path: 3000)
    bench = Bench(coarse_rig, now=0.0)
    bench.place_fingers({"a": (0.1, 0.08), "b": (0.2, 0.1)}, now=0.0)
    path = tmp_path / "run.csv"
    recorder = Recorder(bench, path, sensors=[], fingers=["a", "b"])
    play(bench, HALF_STROKE, now=0.0, watchdog=2.0)
    bench.advance(0.1)
    bench.place_fingers({"b": (0.02, 0.02)}, now=0.1)
    bench.advance(0.149)
    assert not recorder.is_full
    bench.advance(0.2)
    assert recorder.is_full
    recorder.stop()
    recorder.finish()
    found = read_recording(path)
    assert len(found.samples) == 1500
    late = found.during(0.101, 0.2)
    assert not late.samples[:, 0].any()
    assert np.abs(late.samples[:, 1]).max() > 1


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


@pytest.mark.parametrize(
    ("ending", "changes", "text"),
    [
        ("txt", {}, r"run.txt: .*csv"),
        ("csv", {"samples": np.full((500, 2), np.nan)}, "finite"),
        ("wav", {"sample_rate": 4999.5}, r"4999.5"),
        ("uff", {"names": ("P1", "a long name")}, "a long name"),
    ],
)
def test_write_recording_refuses_what_a_format_cannot_hold(
    recorded: Recording, tmp_path: Path, ending: str, changes: dict[str, Any], text: str
) -> None:
    """Unknown suffix, values that are not finite, fractional rates in WAV, long names in UFF."""
    with pytest.raises(InputError, match=text):
        write_recording(tmp_path / f"run.{ending}", replace(recorded, **changes))
    assert not list(tmp_path.iterdir())


PROMPT = Latency()
FRAME_ERROR = 50e-6  # of a frame's length, relative


def test_usb_moves_bytes_in_the_next_frame() -> None:
    """Either way 0 to 1 ms later, 0.5 ms on average, at whole frames from each other.

    1 500 bytes at 12 Mbit/s take 1 ms.
    """
    delays = LineKind(PROMPT, PROMPT, frame=1e-3).delays(1)
    times = [number * 1.3717e-3 for number in range(2000)]
    for shift in (delays.leave, delays.arrive):
        moved = [shift(time, 10) for time in times]
        late = [after - before for after, before in zip(moved, times, strict=True)]
        assert min(late) >= 0
        assert max(late) <= 1e-3 * (1 + FRAME_ERROR)
        assert statistics.mean(late) == pytest.approx(0.5e-3, rel=0.05)
        frames = [(time - moved[0]) / 1e-3 for time in moved]
        assert all(abs(frame - round(frame)) <= FRAME_ERROR * frame + 1e-6 for frame in frames)
    delays = LineKind(PROMPT, PROMPT, usb_byte=8 / 12e6).delays(1)
    assert [delays.leave(2.0, 1500), delays.arrive(3.0, 1500)] == pytest.approx([2.001, 3.001])


def test_ftdi_holds_small_replies_until_its_timer_has_run() -> None:
    """10 bytes wait for 8 ms on average, at most 16; 62 go at once, and the timer begins anew."""
    delays = LineKind(PROMPT, PROMPT, latency_timer=16e-3).delays(1)
    times = [0.1 + number * 0.0371 for number in range(2000)]
    late = [delays.arrive(time, 10) - time for time in times]
    assert 0 < min(late) <= max(late) <= 16e-3
    assert statistics.mean(late) == pytest.approx(8e-3, rel=0.05)
    assert delays.arrive(100.0, 62) == 100.0
    assert delays.arrive(100.001, 10) == pytest.approx(100.016)
    assert delays.arrive(100.002, 10) == pytest.approx(100.016)  # in the same packet
    assert delays.arrive(200.0, 100) == pytest.approx(200.016)  # all but the first 62


def test_latency_has_its_least_and_median_and_stalls() -> None:
    """Half of 20 000 draws lie below 10 + 20 us; 2 % have 1 ms more on average."""
    rng = LINE_KINDS["native"].delays(1)._rng
    drawn = [Latency(10e-6, 20e-6, 0.5).draw(rng) for _ in range(20_000)]
    assert min(drawn) > 10e-6
    assert statistics.median(drawn) == pytest.approx(30e-6, rel=0.03)
    stalled = [Latency(stalls=0.02, stall=1e-3).draw(rng) for _ in range(50_000)]
    assert sum(each > 0 for each in stalled) / 50_000 == pytest.approx(0.02, rel=0.1)
    assert statistics.mean(each for each in stalled if each) == pytest.approx(1e-3, rel=0.1)
    assert max(stalled) <= 5e-3


@pytest.mark.parametrize("name", LINE_KINDS)
def test_delays_keep_the_order_and_are_those_of_their_seed(name: str) -> None:
    """What is written first leaves first, each way, none too late; another seed, other delays."""

    def drawn(seed: object) -> list[float]:
        delays = LINE_KINDS[name].delays(seed)
        return [delays.leave(n * 1e-4, 30) for n in range(300)] + [
            delays.arrive(n * 1e-4, 30) for n in range(300)
        ]

    times = drawn(("line", 1))
    spent = [time - n % 300 * 1e-4 for n, time in enumerate(times)]
    assert max(spent[:300]) + max(spent[300:]) <= LINE_KINDS[name].max_delay + 1e-3
    assert times[:300] == sorted(times[:300])
    assert times[300:] == sorted(times[300:])
    assert times == drawn(("line", 1)) != drawn(("line", 2))


@pytest.fixture
def terminal() -> Iterator[str]:
    """The path of a pseudo-terminal."""
    near, far = os.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_amplifiers_of_one_line_share_its_link(tmp_path: Path, terminal: str) -> None:
    """The rest of each URL stays; the link leads to the terminal, and goes at the end."""
    link = tmp_path / "line"
    urls = {
        "a": f"serial://{terminal}?address=1",
        "b": f"serial://{terminal}?address=2",
        "c": "modbus+tcp://127.0.0.1:502/1",
    }
    with linked_urls(urls, links_by_amplifier([str(link)], amplifiers=list(urls))) as moved:
        assert moved == {
            "a": f"serial://{link}?address=1",
            "b": f"serial://{link}?address=2",
            "c": "modbus+tcp://127.0.0.1:502/1",
        }
        assert str(link.readlink()) == terminal
    assert not link.is_symlink()


@pytest.mark.parametrize("options", [["d=/tmp/x"], ["a="], ["a=/tmp/x", "/tmp/y"]])
def test_options_that_name_no_line_are_refused(options: list[str]) -> None:
    """An unknown amplifier, no path, and two paths for one amplifier."""
    with pytest.raises(InputError, match="--link"):
        links_by_amplifier(options, amplifiers=["a", "b"])


@pytest.mark.parametrize(
    ("urls", "text"),
    [
        (["serial://{}?address=1", "serial://{}?address=2"], "one per line"),
        (["modbus+tcp://127.0.0.1:502/1"], "pseudo-terminal"),
    ],
)
def test_a_line_has_one_link_and_a_network_none(
    urls: list[str], text: str, tmp_path: Path, terminal: str
) -> None:
    """Nothing is linked then."""
    named = {name: url.format(terminal) for name, url in zip("ab", urls, strict=False)}
    links = {name: tmp_path / name for name in named}
    with pytest.raises(InputError, match=text), linked_urls(named, links):
        pass
    assert not any(path.is_symlink() for path in tmp_path.iterdir())


def test_missing_firmware_is_told_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a checkout the command that builds it, elsewhere that a checkout is needed."""
    monkeypatch.setattr(simulation, "FIRMWARE_FOLDER", tmp_path / "out" / "firmware")
    with pytest.raises(InputError, match="checkout"):
        simulation.find_firmware()
    (tmp_path / "firmware").mkdir()
    with pytest.raises(InputError, match="make firmware"):
        simulation.find_firmware()


PARENT = """
import asyncio, pathlib, sys
from sim.simulation import running_firmware
async def main():
    async with running_firmware(pathlib.Path(sys.argv[1]), "main") as url:
        print(url, flush=True)
        await asyncio.sleep(60)
asyncio.run(main())
"""
PROGRAM = """#!/bin/sh
echo serial:///dev/pts/7
cat
echo ended >&3
"""


def test_firmware_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    """Its standard input is at its end then; its URL is the line that it has printed."""
    program, notes = tmp_path / "era-firmware", tmp_path / "notes"
    program.write_text(PROGRAM.replace("&3", str(notes)))
    program.chmod(0o755)
    with subprocess.Popen([sys.executable, "-c", PARENT, program], stdout=-1) as parent:
        assert parent.stdout.readline() == b"serial:///dev/pts/7\n"
        parent.send_signal(signal.SIGKILL)
    until = threads.now() + 10
    while not notes.exists() and threads.now() < until:
        time.sleep(0.02)
    assert notes.exists()
