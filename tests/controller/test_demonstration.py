"""Rows, measures and choice of touches of the demonstration, and what fails in it."""

import asyncio
import re
import shutil
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import AsyncMock

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.demo import demo_pictures, demonstration
from controller.demo import simulated_plate as far_end
from controller.demo.demo_pictures import Pictures
from controller.demo.demonstration import (
    DemoRun,
    Scene,
    example_scenes,
    run_demo,
)
from controller.demo.recorder import TouchRecorder
from controller.demo.simulated_plate import FingerVibration, SimulatedPlate, simulated_plate
from controller.demo.touch_rows import FingerRow, TouchRow, steady_contrast_db
from controller.play.reports import Observers
from controller.sources.touch import Change, Contact, ContactKey, TouchFrame
from controller.sources.tuio import TuioSource
from drivers.errors import LinkError
from era_haptics.command import run_era as run_command
from kit.clock import in_virtual_time, run_virtual
from kit.plates import small_table
from model.finger import detection_threshold
from model.rig.rig_file import example_rig_path, load_rig
from model.table import table_file
from model.table.table_file import build_table
from processes.daemons import ENABLED, ready_daemon, until_state
from registry import threads
from registry.virtual_time import VirtualTimeLoop
from sim.faults import FaultWindow

KEYS = {
    "time_s",
    "until_s",
    "targets_m",
    "quiet_m",
    "reason",
    "drive",
    "mode",
    "latency_ms",
    "played_s",
    "steady",
    "predicted_contrast_db",
    "predicted_level_db_sl",
    "promised_contrast_db",
    "measured_contrast_db",
    "measured_level_db_sl",
}
FINGER = FingerRow(
    at_m=(0.1, 0.1),
    frequency_hz=90.0,
    verdict="own",
    promised_contrast_db=12.0,
    measured_contrast_db=14.0,
    measured_level_db_sl=20.0,
)
FINGER_KEYS = {
    "at_m",
    "frequency_hz",
    "verdict",
    "promised_contrast_db",
    "measured_contrast_db",
    "measured_level_db_sl",
}


def vibration(amplitudes: Any, frequencies: tuple[float, ...] = (100.0, 250.0)) -> FingerVibration:
    """A finger with amplitudes (f, p) at its points."""
    at_points = np.array(amplitudes, dtype=float).reshape(len(frequencies), -1)
    count = at_points.shape[1]
    weights = np.full(count, 1 / count)
    return FingerVibration(np.array(frequencies), at_points, weights)


def row(time: float, *, contrast: float | None, quiet_fingers: int) -> TouchRow:
    """A measured touch with other fingers on the plate."""
    return TouchRow(
        target_id="t",
        time_s=time,
        until_s=time + 1,
        targets_m=[(0.05, 0.05), (0.2, 0.1)],
        quiet={f"q{n}": (0.1, 0.01 * n) for n in range(quiet_fingers)},
        measured_level_db_sl=19.0,
        measured_contrast_db=contrast,
    )


def test_contents_are_told_apart_by_their_frequencies() -> None:
    """By hand: 10 times threshold of its own, 0.3 and 0.4 of others: 26 dB above their power."""
    thresholds = detection_threshold(np.array([90.0, 170.0, 260.0]))
    felt = vibration(np.diag(thresholds) @ [[10.0], [0.3], [0.4]], (90.0, 170.02, 260.0))

    content, foreign = felt.parted(90.0)
    silence, remainder = felt.parted(500.0)

    assert content.level_db_sl == pytest.approx(20.0)
    assert steady_contrast_db(content, [foreign]) == pytest.approx(20 + 6.02, abs=0.01)
    assert silence.level_db_sl == -np.inf
    assert remainder.level_db_sl == pytest.approx(felt.level_db_sl)


def test_promise_is_kept_by_at_least_the_promised_contrast() -> None:
    """Only steady touches with a promise and a measurement count."""
    promised = replace(
        row(1.0, contrast=12.0, quiet_fingers=1), steady=True, promised_contrast_db=12.0
    )
    assert promised.keeps_promise
    assert replace(promised, measured_contrast_db=11.9).keeps_promise is False
    assert replace(promised, steady=False).keeps_promise is None
    assert replace(promised, promised_contrast_db=None).keeps_promise is None
    assert replace(promised, measured_contrast_db=None).keeps_promise is None


def test_json_has_the_documented_keys_of_every_touch() -> None:
    """Also of one that was not driven: without figures, but with the reason."""
    silent = replace(row(1.0, contrast=None, quiet_fingers=1), reason="too close")
    shared = replace(silent, fingers=[FINGER])

    values = silent.as_json()
    values_of_shared = shared.as_json()

    assert values.keys() == KEYS
    assert values["quiet_m"] == [(0.1, 0.0)]
    assert values_of_shared.keys() == KEYS | {"fingers"}
    (finger,) = values_of_shared["fingers"]
    assert finger.keys() == FINGER_KEYS


ROWS = (
    replace(row(0.26, contrast=None, quiet_fingers=0), targets_m=[(0.198, 0.0594)], steady=True),
    replace(row(1.0, contrast=14.0, quiet_fingers=2), promised_contrast_db=12.25, steady=True),
    replace(row(1.5, contrast=11.0, quiet_fingers=1), promised_contrast_db=12.0, steady=True),
    replace(row(2.0, contrast=None, quiet_fingers=1), reason="too close"),
    replace(row(3.0, contrast=None, quiet_fingers=1), measured_level_db_sl=None, played_s=0.214),
    replace(row(4.0, contrast=9.0, quiet_fingers=1), promised_contrast_db=8.0),
    replace(
        row(12.0, contrast=14.0, quiet_fingers=0),
        targets_m=[(0.1, 0.1)],
        fingers=[FINGER, replace(FINGER, at_m=(0.2, 0.1), verdict="mixed")],
        contents=(None, None),
        promised_contrast_db=12.0,
        steady=True,
    ),
)
DRIVEN = {"SW": {"frequency_hz": 50.0}, "SE": {"frequency_hz": 50.0}, "NE": {"frequency_hz": 120.0}}
SCALE = (
    "levels above the thresholds of vibrotactile-probe; "
    "contrasts are the lowest over all threshold sets\n"
)
LINES = """\
  0.3   19.8,  5.9       0  SW SE 50 Hz, NE 120 Hz      -      -    20.0   19.0     9.6
  1.0    5.0,  5.0       2  SW SE 50 Hz, NE 120 Hz   12.2   14.0    20.0   19.0     9.6
  1.5    5.0,  5.0       1  SW SE 50 Hz, NE 120 Hz   12.0   11.0    20.0   19.0     9.6
  2.0    5.0,  5.0       1  silent: too close
  3.0    5.0,  5.0       1  SW SE 50 Hz, NE 120 Hz      -      -    20.0      -     9.6\
  not measured: it played for 0.21 s
  4.0    5.0,  5.0       1  SW SE 50 Hz, NE 120 Hz    8.0    9.0    20.0   19.0     9.6\
  still ringing
 12.0   10.0, 10.0       1  SW SE 50 Hz, NE 120 Hz   12.0   14.0    20.0   19.0     9.6\
  own, of 2 vibrations
7 touches; with other fingers on the plate, 2 of 3 (67%) had at least the promised contrast
"""


Demo = Callable[..., tuple[int, list[str]]]


@pytest.fixture
def demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Demo:
    """Run `era demo` in an empty folder, with the rows above; returns status and lines printed.

    why_void: that of the run.
    """
    rows = [
        replace(touch_row, drive=DRIVEN, latency_ms=9.62, predicted_level_db_sl=20.0)
        for touch_row in ROWS
    ]

    def run_era(*arguments: str, why_void: str | None = None) -> tuple[int, list[str]]:
        async def run_demo(file: Path, table: object, *, on_row: Any, **options: Any) -> DemoRun:
            assert file.name == ("mine.yaml" if "mine.yaml" in arguments else "paper_plate.yaml")
            assert len(options["scenes"]) == 2
            for touch_row in rows:
                on_row(touch_row)
            return DemoRun(rows, why_void)

        monkeypatch.setattr(demonstration, "run_demo", run_demo)
        status = run_command(["demo", *arguments, "--out", "drawn"])
        return status, capsys.readouterr().out.splitlines(keepends=True)

    def write_pictures(table: object, rows: object, out: Path) -> Pictures:
        return Pictures([out / "t.png"], ["no contents.png: WHY"])

    monkeypatch.setattr(demo_pictures, "write_pictures", write_pictures)
    monkeypatch.setattr(table_file, "cached_table", lambda rig, **options: (small_table(), None))
    monkeypatch.chdir(tmp_path)
    shutil.copy(example_rig_path(), "mine.yaml")
    return run_era


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [((), "era config init my_rig.yaml"), (("mine.yaml",), "era table build mine.yaml")],
    ids=["example rig", "own rig"],
)
def test_lines_say_of_each_touch_what_was_promised_and_felt(
    arguments: tuple[str, ...], expected: str, demo: Demo
) -> None:
    """By hand, of touches alone, kept, missed, silent, too short, still ringing, and of two people.

    With a rig of one's own its table comes next. Without a capture the scenes are the examples'.
    """
    status, (head, arithmetic, scale, _, _, _, *lines) = demo(*arguments, "--real-time")
    assert status == 0
    assert re.search(r"\.yaml: table of 4 ERAs on a mesh of 12x9, ready in [0-9]\.\d s$", head)
    assert arithmetic.startswith("answers are computed by ")
    assert scale == SCALE
    assert "".join(lines).startswith(LINES)
    assert lines[-3:-1] == ["no contents.png: WHY\n", "wrote drawn/t.png\n"]
    assert lines[-1].startswith(f"Next: {expected}")


def test_void_run_prints_no_share_and_draws_nothing(demo: Demo) -> None:
    """Its last line says that the machine was too slow, and why; the exit status is 1."""
    status, lines = demo("--real-time", why_void="a reaction took 400 ms")
    assert status == 1
    assert "%" not in "".join(lines)
    assert "wrote" not in "".join(lines)
    assert lines[-1].startswith("void: this machine was too slow (a reaction took 400 ms)")


FAULT = "amplifier d: state must be OPERATION_ENABLED, got FAULT with fault WATCHDOG"


def contact(number: int) -> Contact:
    """A contact that is down from now on."""
    return Contact(ContactKey("test", number), 0.1, 0.1, threads.now())


@asynccontextmanager
async def recorder_of(rows: list[TouchRow], **plate: AsyncMock) -> AsyncIterator[TouchRecorder]:
    """A recorder of a plate that is not there, by what it replies; its rows are made at the end."""
    doubles = SimpleNamespace(**{"vibration": AsyncMock(), "place_fingers": AsyncMock(), **plate})
    async with asyncio.TaskGroup() as tasks:
        yield TouchRecorder(cast(SimulatedPlate, doubles), tasks, on_row=rows.append)


@pytest.mark.parametrize(
    ("delay", "is_void"), [(0.149, False), (0.151, True)], ids=["short enough", "too long"]
)
def test_run_is_void_when_sensors_follow_a_finger_too_late(delay: float, is_void: bool) -> None:
    """After 150 ms a window of 250 ms at the end of a pattern of 400 ms may contain the move."""

    async def place_slowly(*arguments: object) -> None:
        await asyncio.sleep(delay)

    async def play() -> str | None:
        place = AsyncMock(side_effect=place_slowly)
        async with recorder_of([], place_fingers=place) as recorder:
            loop = Observers()
            recorder.observe(loop)
            finger = contact(1)
            loop.contacts_changed[0]((finger,), Change(down=(finger,)))
        return recorder.why_void()

    why_void = run_virtual(play())
    assert (why_void is not None and "151 ms" in why_void) == is_void


async def test_run_is_void_after_a_rejected_set() -> None:
    """A set that an amplifier or its ledger has rejected."""
    async with recorder_of([]) as recorder:
        loop = Observers()
        recorder.observe(loop)
        assert recorder.why_void() is None
        loop.refused[0]("too late")
        assert "rejected 1 set" in str(recorder.why_void())


def test_demo_gives_the_same_rows_on_a_slow_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """In virtual time, to the last digit, with each frame of touches read 20 ms later."""
    file = example_rig_path()
    table = build_table(load_rig(file), frequencies=np.array([120.0, 160.0, 200.0]))
    scene = Scene(example_scenes(load_rig(file))[0].touches[:100])

    def rows() -> list[dict[str, Any]]:
        with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
            playing = run_demo(file, table, wire="sim", scenes=[scene], on_row=lambda row: None)
            return [row.as_json() for row in runner.run(playing).rows]

    prompt = rows()
    read = TuioSource.read

    def read_slowly(self: TuioSource, *arguments: Any) -> TouchFrame | None:
        time.sleep(0.02)
        return read(self, *arguments)

    monkeypatch.setattr(TuioSource, "read", read_slowly)
    assert rows() == prompt
    levels = {row["measured_level_db_sl"] for row in prompt}
    assert levels != {None}


@pytest.mark.parametrize("silenced_by", ["over_voltage", "stop"])
@in_virtual_time
async def test_silenced_plate_aborts_the_demonstration(
    silenced_by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault of an amplifier or a stop ends it with the cause, and nothing arms again."""
    monkeypatch.setattr(AsyncClient, "layout", AsyncMock())
    async with asyncio.TaskGroup() as tasks, ready_daemon(tmp_path) as (bench, era):
        recorder = TouchRecorder(cast(SimulatedPlate, None), tasks, on_row=lambda row: None)

        async def silence(recording: object) -> None:
            await until_state(era, ENABLED)
            if silenced_by == "stop":
                await era.stop()
            else:
                bench.far.device.inject_fault(FaultWindow(fault="over_voltage", lasts=0.05))
                await until_state(era, "FAULT")

        playing = cast(Any, SimpleNamespace(play=silence))
        with pytest.raises(LinkError, match=r"demonstration aborted: lease lost: (fault|stopped)"):
            await demonstration.play_scenes(
                [Scene([])], playing, recorder, bench.daemon, bench.socket
            )
        assert (await era.status()).state in ("FAULT", "QUICK_STOP_ACTIVE")


async def test_far_end_terminates_process_when_not_ready_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After the startup timeout the process is terminated."""
    monkeypatch.setattr(far_end, "STARTUP_TIMEOUT", 0.0)
    exit_statuses: list[int | None] = []
    terminate = far_end.end_simulation

    async def note(process: "far_end.asyncio.subprocess.Process") -> None:
        await terminate(process)
        exit_statuses.append(process.returncode)

    monkeypatch.setattr(far_end, "end_simulation", note)
    with pytest.raises(LinkError):
        async with simulated_plate(example_rig_path(), ["main"], wire="serial"):
            pass
    assert len(exit_statuses) == 1
    assert exit_statuses[0] is not None


async def test_far_end_reports_exit_status_when_rig_is_invalid(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The process prints its own error with file and line; the exit status is reported."""
    rig = tmp_path / "rig.yaml"
    rig.write_text("plate: 3\n")
    with pytest.raises(LinkError, match="status 2"):
        async with simulated_plate(rig, ["main"], wire="serial"):
            pass
    assert f"{rig}:1: plate: " in capfd.readouterr().err
