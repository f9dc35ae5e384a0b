"""Learning of the plate: what the daemon says and answers by, the estimator, and its process."""

import asyncio
import logging
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from controller.api.schema import LatencySummary, LearningSummary, PlateEvent
from controller.learning import learned_table as learned_table_module
from controller.learning import learning as module
from controller.learning.learned_table import LearnedTable, PlateReport
from controller.learning.learning import Learning, SettledReadings
from controller.learning.worker import MAX_MEMORY, Worker, make
from controller.plate_measurement import PlateSensor, settling
from controller.play.loop import Observers
from controller.sources.touch import Contact, ContactKey
from drivers.errors import LinkError
from drivers.host.amplifier_sensors import Reading, SensorReading
from drivers.playing import AmplifierTone
from kit.clock import in_virtual_time
from kit.courses import Taken, courses, follow
from kit.plates import make_paper_rig, small_table
from model.answer.answer_report import Timing
from model.errors import InputError
from model.estimate.following import PatternReport, SettledPattern
from model.estimate.forward import Sensor
from model.rig.rig_file import example_rig_path
from model.table.table import LocalizationTable
from registry.limits import HAND_LOAD


class Readings:
    """In place of those of sensors: `take` hands a pattern over, `ending` ends them."""

    def __init__(self, *args: object, take: Callable[[SettledPattern], None], **more: object):
        self.take, self.sensors, self.settling = take, (), 0.0
        self.ending, self.count, self.disturbed = asyncio.Event(), 0, 0

    async def run(self) -> None:
        """Until they fail."""
        self.count += 1
        self.ending.clear()
        await self.ending.wait()
        raise RuntimeError("a sensor of no kind")


class Workers:
    """In place of processes: counts them, and replies what a test wants.

    started: what the next estimator reports at its start; reports: of the next patterns, an error
    to raise, or None never to reply.
    """

    def __init__(self) -> None:
        self.count, self.ended, self.pid = 0, 0, 1
        self.started: PlateReport | Exception = report_of()
        self.reports = asyncio.Queue[PlateReport | Exception | None]()

    def __call__(self) -> "Workers":
        """One more."""
        self.count += 1
        return self

    async def call(self, limit: float, function: Callable[..., object], *arguments: object) -> Any:
        """Reply, or raise an error, TimeoutError among them."""
        if function is settling:
            return 0.2
        if function is make:
            if isinstance(self.started, Exception):
                raise self.started
            return None
        if arguments[0] is LearnedTable.start:
            return self.started, CAUTIOUS
        if arguments[0] is LearnedTable.keep:
            return "", None
        async with asyncio.timeout(limit):
            found = await self.reports.get()
            if found is None:
                await asyncio.Event().wait()
        if isinstance(found, Exception):
            raise found
        return found

    def end(self) -> None:
        """One less."""
        self.ended += 1


CAUTIOUS = replace(small_table())
CORRECTED = replace(small_table())
TONE = np.array([110.0])  # Hz
PATTERN = SettledPattern(0.0, TONE, np.zeros((1, 4), complex), np.ones((1, 4), complex))
ERRORS = {"ChildProcessError": ChildProcessError("it died"), "InputError": InputError("InputError")}


def report_of(
    *, state: Any = "following", cause: str = "", remedy: str | None = None, **more: Any
) -> PlateReport:
    """What an estimator reports; table: whether it has corrected it, by any word."""
    table = CORRECTED if more.pop("table", None) else None
    lying = tuple(more.pop("lying", ())) or None
    return PlateReport(state, cause, remedy, table=table, lying=cast(Any, lying), **more)


@dataclass
class Learned(Taken):
    """A plate that is learned; taken: the tables that the controller has answered by.

    asked: how often sensors were to be read; sensors: why they are not, "" if they reply.
    """

    learning: Learning = field(init=False)
    workers: Workers = field(default_factory=lambda: Workers())
    events: list[PlateEvent] = field(default_factory=list)
    taken: list[LocalizationTable] = field(default_factory=list)
    asked: int = 0
    sensors: str = ""

    @property
    def event(self) -> PlateEvent:
        """What is published to clients; a change that is logged has been published."""
        assert self.learning.event in (self.events or [self.learning.event])[-1:] or not self.log
        return self.learning.event

    @property
    def status(self) -> LearningSummary:
        """What the status says."""
        empty = LatencySummary(count=0, median=None, p99=None, p999=None, histogram=[])
        return self.learning.summary(empty)

    @property
    def is_corrected(self) -> bool:
        """Whether answers are by the corrected table."""
        return self.taken[-1] is CORRECTED

    @property
    def is_cautious(self) -> bool:
        """Whether they are by that of a plate that is not known."""
        return self.taken[-1] is CAUTIOUS

    def will_report(self, **report: Any) -> None:
        """Let the estimator report this of the next pattern that has no report."""
        self.workers.reports.put_nowait(report_of(**report))

    def will_fail(self, cause: str) -> None:
        """Let its process die at the next pattern."""
        self.workers.reports.put_nowait(ChildProcessError(cause))

    def will_hang(self) -> None:
        """Let it never reply to the next pattern."""
        self.workers.reports.put_nowait(None)

    async def hands(self, count: int) -> None:
        """Hand patterns over, and wait for what is reported of them."""
        self.log.clear()
        for _ in range(count):
            cast(Any, self.learning.readings).take(PATTERN)
        await asyncio.sleep(0.1)

    async def reports(self, **report: Any) -> None:
        """Hand a pattern over of which this is reported."""
        self.will_report(**report)
        await self.hands(1)

    async def readings_fail(self) -> None:
        """Let what reads patterns end by a bug."""
        cast(Readings, self.learning.readings).ending.set()
        await asyncio.sleep(0.1)

    def sensors_reply(self) -> None:
        """Let sensors be read from now on."""
        self.sensors = ""

    def starts(self) -> None:
        """Let estimators start from now on."""
        self.workers.started = report_of()

    def file_is_a_folder(self) -> None:
        """Have a folder where the file is, which cannot be removed."""
        self.learning._file.mkdir()

    async def plate_sensors(self, *_: object) -> Any:
        """One sensor, or the error of reading it."""
        self.asked += 1
        if self.sensors:
            raise RuntimeError(self.sensors) if "bug" in self.sensors else LinkError(self.sensors)
        return (SimpleNamespace(place=None),), ()

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Note a table that the controller answers by."""
        self.taken.append(table)


@asynccontextmanager
async def learned(
    *, started: Any = MappingProxyType({}), sensors: str = ""
) -> AsyncIterator[Learned]:
    """A plate whose estimator is started; started: what it reports then, or the error that ends it.

    sensors: why they cannot be read.
    """
    found = Learned(sensors=sensors)
    error = ERRORS[started] if isinstance(started, str) else None
    found.workers.started = error or report_of(**started)
    controller: Any = SimpleNamespace(
        drive_mode="switched",
        amplifiers={},
        cycle=SimpleNamespace(is_preparing=False),
        replace_answers=found.replace_answers,
    )
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "Worker", found.workers)
        patch.setattr(module, "SettledReadings", Readings)
        patch.setattr(module, "plate_sensors", found.plate_sensors)
        patch.setattr(module, "check_clocks", lambda amplifiers: None)
        patch.setattr(module._logger, "isEnabledFor", lambda level: level >= logging.INFO)
        found.learning = Learning(
            make_paper_rig(12, 9),
            small_table(),
            Timing(small_table()),
            Path(folder) / "learned.npz",
            controller=controller,
            changed=found.events.append,
            estimated=lambda latency: None,
        )
        found.learning.open()
        await asyncio.sleep(0.1)
        yield found
        await found.learning.close()


COURSES = courses(Path(__file__).with_name("learning.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_plate_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], learned)


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[float]]:
    """Tones that were read; each sensor hears each tone by its frequency and its own number."""
    asked = list[Sequence[float]]()

    async def start(amplifier: object, frequencies: Sequence[float], window: float) -> Reading:
        asked.append(frequencies)
        return Reading(1, "RUNNING", window, 0, 0, len(frequencies), ())

    async def finish(amplifier: object, started: Reading) -> Reading:
        heard = [
            SensorReading(False, tuple([(frequency + n, 0.0) for frequency in asked[-1]]))
            for n in range(4)
        ]
        return replace(started, state="COMPLETE", sensors=tuple(heard))

    monkeypatch.setattr(module, "start_reading", start)
    monkeypatch.setattr(module, "finish_reading", finish)
    return asked


async def read_of(
    *drives: Mapping[str, tuple[float, float, float]], load: float = 1.0
) -> list[SettledPattern]:
    """What is read in a second in which contents of drives play under a finger of a load.

    On the paper's rig, whose amplifier has a sensor at each ERA; drives: frequency [Hz], share of
    full level and phase in degrees by ERA.
    """
    rig, observers, read = make_paper_rig(12, 9), Observers(), list[SettledPattern]()
    controller = cast(Any, SimpleNamespace(amplifiers={"main": None}))
    readings = SettledReadings(rig, controller, take=read.append)
    readings.sensors = [
        PlateSensor("main", number, Sensor(era.name, era.name), 0, 500.0)
        for number, era in enumerate(rig.eras)
    ]
    playing = SimpleNamespace(
        lasts=True,
        contents={
            n: SimpleNamespace(drive={era: AmplifierTone(0, *each) for era, each in drive.items()})
            for n, drive in enumerate(drives)
        },
        contacts=(Contact(ContactKey("a", 1), 0.1, 0.1, 0.0, load),),
        time=0.0,
        settled_after=0.1,
    )
    readings.observe(observers)
    running = asyncio.create_task(readings.run())
    for callback in observers.reported:
        callback(cast(Any, playing))
    await asyncio.sleep(1.0)
    running.cancel()
    return read


@in_virtual_time
async def test_contents_that_play_at_once_are_read_together(heard: list[Sequence[float]]) -> None:
    """Each tone with the bases that play it; not one where the harmonic of another is heard."""
    (found,) = await read_of(
        {"NE": (200.0, 0.5, 0.0)},
        {"SW": (100.0, 0.1, 90.0), "SE": (100.0, 0.2, 180.0)},
        {"NW": (150.0, 0.3, 0.0)},
    )
    assert heard == [[100.0, 150.0, 200.0]]
    assert found.frequencies.tolist() == [100.0, 150.0]
    np.testing.assert_allclose(found.values, [100 + np.arange(4), 150 + np.arange(4)])
    stroke = 100e-6  # m; of the rig
    bases = [[0.1j * stroke, -0.2 * stroke, 0, 0], [0, 0, 0, 0.3 * stroke]]
    np.testing.assert_allclose(found.bases, bases, atol=1e-12)


@in_virtual_time
async def test_contents_are_not_read_together_that_no_reading_tells_apart_nor_beside_a_hand(
    heard: list[Sequence[float]],
) -> None:
    """Two of one frequency, or 3 Hz apart where a window is 0.2 s.

    The load of a hand is hardly known, so that it would be taken for a change of the plate.
    """
    for frequency in (100.0, 103.0):
        await read_of({"SW": (100.0, 0.1, 0.0)}, {"SE": (frequency, 0.1, 0.0)})
    await read_of({"SW": (100.0, 0.1, 0.0)}, load=HAND_LOAD)
    assert not heard
    await read_of({"SW": (100.0, 0.1, 0.0)})
    assert len(heard) == 1


def learned_table(file: Path) -> LearnedTable:
    """Of the paper's rig, with a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    sensors = tuple(Sensor(era.name, era.name) for era in rig.eras)
    return LearnedTable(rig, small_table(), sensors, "switched", file)


def test_rig_that_was_not_measured_is_only_watched(tmp_path: Path) -> None:
    """Off, with the thickness that an identification would state, and how to get it.

    A damaged file is set aside: it is renamed, byte for byte, the note names it, and the plate is
    learned anew. Files of writers that were killed are removed, those of this file only.
    """
    file, half = tmp_path / "learned.npz", tmp_path / ".learned.npz.0123456789ab"
    for path, content in (
        (file, b"something else"),
        (half, b"half"),
        (tmp_path / ".learned.npz.old", b"somebody's"),
    ):
        path.write_bytes(content)
    report, cautious = learned_table(file).start()
    assert (report.state, report.table) == ("off", None)
    assert "thickness" in report.cause
    assert "identify" in str(report.remedy)
    assert cautious.uncertainty == small_table().uncertainty
    assert {each.name for each in tmp_path.iterdir()} == {"learned.npz.old", ".learned.npz.old"}
    assert (tmp_path / "learned.npz.old").read_bytes() == b"something else"
    assert "learned.npz.old" in report.note


def test_pattern_of_nothing_is_noted_and_leaves_no_file(tmp_path: Path) -> None:
    """Sensors that read 0 give a note, no alarm and no table; nothing is to be saved."""
    file = tmp_path / "learned.npz"
    found, none = learned_table(file), np.zeros((1, len(small_table().eras)), complex)
    report = found.take(SettledPattern(1.0, TONE, none + 1e-5, none))
    assert "not used" in report.note
    assert (report.is_alarm, report.table, found.keep()) == (False, None, ("", None))
    assert not file.exists()


def test_folder_without_room_is_noted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts go on, the next note is of another error, and what was written is not again."""
    errors: list[OSError | None] = [OSError(28, "No space left"), OSError(30, "Read-only"), None]
    written = 0

    def save(*args: object, **more: object) -> None:
        nonlocal written
        if errors[0] is not None:
            raise errors[0]
        written += 1

    found = learned_table(tmp_path / "learned.npz")

    def take(pattern: SettledPattern) -> PatternReport:
        found.live.known = replace(found.live.known, x=found.live.known.x.copy())
        return PatternReport()

    monkeypatch.setattr(learned_table_module, "save_learned", save)
    monkeypatch.setattr(found.live, "take", take)
    found.take(PATTERN)
    notes = []
    for _ in range(3):
        notes.append([bool(found.keep()[0]) for _ in range(2)])
        errors.append(errors.pop(0))
    assert notes == [[True, False], [True, False], [False, False]]
    assert written == 1


PATIENCE = 300.0  # s; a worker gives way to all else that runs


def nap(seconds: float) -> int:
    """Sleep, and return the process number."""
    time.sleep(seconds)
    return os.getpid()


def grow(size: int) -> int:
    """Take memory."""
    return len(bytearray(size))


@asynccontextmanager
async def working() -> AsyncIterator[Worker]:
    """A worker that has started."""
    worker = Worker()
    try:
        await worker.call(PATIENCE, nap, 0.0)
        yield worker
    finally:
        worker.end()


def exists(pid: int) -> bool:
    """Whether a process runs."""
    try:
        return " Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][:3]
    except OSError:
        return False


async def gone(*pids: int) -> bool:
    """Whether processes end within ten seconds; those that do not are killed."""
    for _ in range(200):
        if not any(map(exists, pids)):
            return True
        await asyncio.sleep(0.05)
    for pid in filter(exists, pids):
        os.kill(pid, signal.SIGKILL)
    return False


@pytest.mark.real_time
async def test_worker_that_hangs_holds_nothing() -> None:
    """Its call ends in time, the loop goes on meanwhile, and `end` returns at once and kills it."""
    async with working() as worker:
        assert await worker.call(PATIENCE, nap, 0.0) == worker.pid
        ticks = asyncio.create_task(asyncio.sleep(0.1))
        with pytest.raises(TimeoutError, match=r"no reply within 0\.3 s"):
            await worker.call(0.3, nap, 1e3)
        assert ticks.done()
        began = time.monotonic()
        worker.end()
        assert time.monotonic() - began < 0.2
        assert await gone(worker.pid or 0)


@pytest.mark.real_time
async def test_worker_goes_on_after_signals_and_without_memory_and_is_reported_when_it_dies() -> (
    None
):
    """Signals such as Ctrl-C, `systemctl kill` and a reload: the daemon ends it when it is done.

    Twice its limit of memory is refused to it; the unit leaves 0.6 GB to the daemon. Its death is
    reported at the call that it was killed in, and at the next one.
    """
    unit = (example_rig_path().parent / "systemd" / "era-haptics.service").read_text("utf-8")
    assert "\nMemoryMax=1G\n" in unit
    assert MAX_MEMORY <= 2**30 - 0.6e9
    async with working() as worker:
        assert worker.pid is not None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            os.kill(worker.pid, number)
        assert await worker.call(PATIENCE, nap, 0.0) == worker.pid
        with pytest.raises(MemoryError):
            await worker.call(PATIENCE, grow, 2 * MAX_MEMORY)
        assert await worker.call(PATIENCE, grow, 1000) == 1000
        napping = asyncio.create_task(worker.call(PATIENCE, nap, 1e3))
        await asyncio.sleep(0.1)
        os.kill(worker.pid, signal.SIGKILL)
        for call in (napping, worker.call(PATIENCE, nap, 0.0)):
            with pytest.raises(ChildProcessError):
                await call


PARENT = """
import asyncio, os, time
from controller.learning.worker import Worker

async def main():
    worker = Worker()
    await worker.call(300.0, dict)
    children = open(f"/proc/self/task/{os.getpid()}/children").read()
    print(worker.pid, children, flush=True)
    time.sleep(1000)

if __name__ == "__main__":
    asyncio.run(main())
"""


@pytest.mark.real_time
@pytest.mark.parametrize("is_stopped", [False, True])
async def test_worker_ends_with_a_daemon_that_was_killed(tmp_path: Path, is_stopped: bool) -> None:
    """By kill -9, also where the worker is stopped itself; nothing else of it is left either."""
    file = tmp_path / "parent.py"
    file.write_text(PARENT)
    pipe = asyncio.subprocess.PIPE
    parent = await asyncio.create_subprocess_exec(sys.executable, str(file), stdout=pipe)
    worker, *others = map(int, (await parent.stdout.readline()).split())
    assert worker in others
    if is_stopped:
        os.kill(worker, signal.SIGSTOP)
    parent.kill()  # without waiting for its output, which the others may hold open
    assert await gone(parent.pid, *others)
