"""Learning of the plate: what the daemon says and answers by, the estimator, and its process."""

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import numpy as np
import pytest

from controller.api.schema import LatencySummary, LearningState, PlateEvent
from controller.learning import learned_table as learned_table_module
from controller.learning import learning as module
from controller.learning.learned_table import LearnedTable, PlateReport
from controller.learning.learning import Learning, SettledReadings
from controller.learning.worker import MAX_MEMORY, Worker, make
from controller.operation.plate_controller import Controller
from controller.plate_measurement import PlateSensor, settling
from controller.play.loop import Observers
from controller.play.routing import Drive
from controller.sources.touch import Contact, ContactKey
from drivers.errors import CommandError, LinkError
from drivers.host.amplifier_sensors import Reading, SensorReading
from drivers.playing import AmplifierTone
from model.answer.answer_report import Timing
from model.errors import InputError
from model.estimate.following import PatternReport, SettledPattern
from model.estimate.forward import Sensor
from model.rig.rig_file import example_rig_path
from model.table.table import LocalizationTable
from plates import make_paper_rig, small_table
from registry.limits import HAND_LOAD
from virtual_lines import in_virtual_time


class Taking:
    """A controller that keeps what it answers by."""

    drive_mode = "switched"
    amplifiers: ClassVar[dict[str, object]] = {}
    cycle = SimpleNamespace(is_preparing=False)

    def __init__(self) -> None:
        self.taken: list[LocalizationTable] = []

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Note a table."""
        self.taken.append(table)


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
        self.started: PlateReport | Exception = FOLLOWED
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


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Workers:
    """Of a learning whose amplifiers have a sensor."""
    found = Workers()

    async def sensors(*args: object) -> Any:
        return (SimpleNamespace(place=None),), ()

    monkeypatch.setattr(module, "Worker", found)
    monkeypatch.setattr(module, "SettledReadings", Readings)
    monkeypatch.setattr(module, "plate_sensors", sensors)
    monkeypatch.setattr(module, "check_clocks", lambda amplifiers: None)
    return found


CAUTIOUS = replace(small_table())
CORRECTED = replace(small_table())
FOLLOWED = PlateReport("following", "the plate is followed", None)
CHANGED = PlateReport("changed", "a crack", "look for it")
CUP = replace(CHANGED, cause="a cup lies there", lying=(0.1, 0.2, 0.3))
WATCHED = PlateReport("off", "never measured", "measure it")
TONE = np.array([110.0])  # Hz
PATTERN = SettledPattern(0.0, TONE, np.zeros((1, 4), complex), np.ones((1, 4), complex))


@asynccontextmanager
async def opened(folder: Path) -> AsyncIterator[tuple[Learning, Taking, list[PlateEvent]]]:
    """A learning whose estimator is started, its controller and events, closed at the end."""
    taking, events = Taking(), list[PlateEvent]()
    learning = Learning(
        make_paper_rig(12, 9),
        small_table(),
        Timing(small_table()),
        folder / "learned.npz",
        controller=cast(Controller, taking),
        changed=events.append,
        estimated=lambda latency: None,
    )
    learning.open()
    await asyncio.sleep(0.1)
    yield learning, taking, events
    await learning.close()


async def hand(learning: Learning, *, count: int = 1) -> None:
    """Hand patterns over, and wait until they are estimated."""
    for _ in range(count):
        cast(Any, learning.readings).take(PATTERN)
    await asyncio.sleep(0.1)


def counted(learning: Learning, *names: str) -> tuple[int, ...]:
    """Counts of the status by their names."""
    empty = LatencySummary(count=0, median=None, p99=None, p999=None, histogram=[])
    status = learning.summary(empty)
    return tuple(getattr(status, name) for name in names)


@dataclass(frozen=True)
class Course:
    """What the estimator reports of a pattern, and what is so thereafter.

    taken: how many tables the controller has taken in all; levels: of what was logged for it.
    """

    report: PlateReport
    state: LearningState
    is_cautious: bool | None = None
    taken: int | None = None
    lying: tuple[float, float, float] | None = None
    levels: Sequence[str] | None = None


AGAIN = replace(FOLLOWED, cause="the plate is again as it was")
HELD = replace(FOLLOWED, cause="the plate is not as known", is_alarm=True)
COURSES = {
    # Changed and cautious, until an estimate says that it is as it was.
    "a plate that had changed stays so over a restart": (
        replace(CHANGED, table=CORRECTED),
        [
            Course(CHANGED, "changed", is_cautious=True, levels=[]),
            Course(replace(AGAIN, table=CORRECTED), "following", is_cautious=False),
        ],
    ),
    # Each change is a warning once; answers of a plate that is followed stay while it is not known.
    "answers follow the plate again after a change": (
        FOLLOWED,
        [
            Course(replace(FOLLOWED, table=CORRECTED), "following", taken=2, levels=[]),
            Course(HELD, "following", is_cautious=False, taken=2, levels=["WARNING"]),
            Course(
                replace(CHANGED, table=CORRECTED),
                "changed",
                is_cautious=True,
                taken=3,
                levels=["WARNING"],
            ),
            Course(replace(AGAIN, table=CORRECTED), "following", is_cautious=False, taken=4),
        ],
    ),
    # It is all that such a plate can tell.
    "an alarm of a watched plate is a warning": (
        WATCHED,
        [
            Course(WATCHED, "off", levels=[]),
            Course(replace(WATCHED, is_alarm=True), "off", taken=0, levels=["WARNING"]),
        ],
    ),
    "an object is said until it is gone": (
        FOLLOWED,
        [
            Course(replace(CUP, table=CORRECTED), "changed", is_cautious=True, lying=CUP.lying),
            Course(AGAIN, "following"),
        ],
    ),
    "a note is logged": (
        FOLLOWED,
        [Course(replace(FOLLOWED, note="not used"), "following", levels=["WARNING"])],
    ),
}


@pytest.mark.parametrize("name", COURSES)
@in_virtual_time
async def test_status_follows_the_estimator(
    workers: Workers, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """State, answers and log are those of each report of a course, and each is an event."""
    caplog.set_level("INFO")
    workers.started, course = COURSES[name]
    async with opened(tmp_path) as (learning, taking, events):
        assert learning.event.state == workers.started.state
        for each in course:
            caplog.clear()
            workers.reports.put_nowait(each.report)
            await hand(learning)
            logged = [found.levelname for found in caplog.records]
            assert learning.event.state == each.state, each
            assert each.is_cautious in (None, learning.event.cautious), each
            found = learning.event.object
            assert each.lying == (found and (found.x_m, found.y_m, found.mass_kg)), each
            assert each.taken in (None, len(taking.taken)), each
            assert each.levels in (None, logged), each
            assert events[-1] == learning.event or not logged
        alarms = sum(each.report.is_alarm for each in course)
        assert learning.event.alarms == alarms
        assert counted(learning, "readings", "estimates") == (len(course),) * 2


@in_virtual_time
async def test_onsets_are_shaped_anew_a_minute_after_a_correction(
    workers: Workers, tmp_path: Path
) -> None:
    """Of several corrections in a minute, the first and the last are shaped, in one step each."""
    async with opened(tmp_path) as (learning, taking, _):
        for _ in range(2):
            workers.reports.put_nowait(replace(FOLLOWED, table=CORRECTED))
            await hand(learning)
            await asyncio.sleep(15.0)
        assert len(taking.taken) == 3
        await asyncio.sleep(60.0)
        assert len(taking.taken) == 4
        assert counted(learning, "corrections") == (2,)


@in_virtual_time
async def test_file_that_cannot_be_removed_is_still_followed(
    workers: Workers, tmp_path: Path
) -> None:
    """`forget` names the file, and another estimator starts from it; then answers are as built."""
    workers.started = replace(FOLLOWED, table=CORRECTED)
    async with opened(tmp_path) as (learning, taking, _):
        (tmp_path / "learned.npz").mkdir()
        with pytest.raises(CommandError, match=r"learned\.npz"):
            await learning.forget()
        assert taking.taken[-1] is not CORRECTED
        await asyncio.sleep(0.1)
        assert (workers.count, workers.ended) == (2, 1)
        assert learning.event.state == "following"
        assert taking.taken[-1] is CORRECTED


@in_virtual_time
async def test_what_waits_is_forgotten_with_the_plate(workers: Workers, tmp_path: Path) -> None:
    """The next estimator gets no pattern from before, and those are counted."""
    async with opened(tmp_path) as (learning, _, _):
        await hand(learning, count=3)
        await learning.forget()
        await asyncio.sleep(0.1)
        workers.reports.put_nowait(FOLLOWED)
        await asyncio.sleep(0.1)
        assert counted(learning, "readings", "estimates", "discarded") == (3, 0, 3)


@in_virtual_time
async def test_readings_that_fail_are_started_anew(workers: Workers, tmp_path: Path) -> None:
    """Off with the cause at once; read again after a pause, and followed after an estimate."""
    async with opened(tmp_path) as (learning, _, _):
        readings = cast(Readings, learning.readings)
        readings.ending.set()
        await asyncio.sleep(0.1)
        assert learning.event.state == "off"
        assert "a sensor of no kind" in learning.event.cause
        assert learning.event.remedy is not None
        await asyncio.sleep(11.0)
        assert readings.count == 2
        workers.reports.put_nowait(FOLLOWED)
        await hand(learning)
        assert learning.event.state == "following"
        await asyncio.sleep(61.0)
        assert not learning.event.cautious


@in_virtual_time
async def test_plate_that_is_not_watched_makes_answers_cautious(
    workers: Workers, tmp_path: Path
) -> None:
    """After a minute without readings what was learned is not trusted, and not before."""
    async with opened(tmp_path) as (learning, taking, events):
        cast(Readings, learning.readings).ending.set()
        await asyncio.sleep(59.0)
        assert not learning.event.cautious
        await asyncio.sleep(2.0)
        assert learning.event.cautious
        assert events[-1].cautious
        assert taking.taken == [CAUTIOUS]


@in_virtual_time
async def test_sensors_that_were_not_read_are_asked_for_again(
    workers: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off with the link's error and a remedy; the estimator starts once they reply."""
    replying = module.plate_sensors

    async def silent(*args: object) -> Any:
        raise LinkError("no reply of A")

    monkeypatch.setattr(module, "plate_sensors", silent)
    async with opened(tmp_path) as (learning, _, _):
        assert learning.event.state == "off"
        assert "no reply of A" in learning.event.cause
        assert learning.event.remedy is not None
        with pytest.raises(CommandError, match="no reply of A"):
            await learning.forget()
        monkeypatch.setattr(module, "plate_sensors", replying)
        await asyncio.sleep(11.0)
        assert learning.event.state == "following"


@in_virtual_time
async def test_failure_to_read_sensors_is_said_again(
    workers: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without them no estimator is started; `forget` tries again, as an opened amplifier does."""
    asked = 0

    async def failing(*args: object) -> None:
        nonlocal asked
        asked += 1
        raise RuntimeError("no such words")

    monkeypatch.setattr(module, "plate_sensors", failing)
    async with opened(tmp_path) as (learning, _, _):
        assert "no such words" in learning.event.cause
        await learning.forget()
        await asyncio.sleep(0.1)
        learning.open()
        await asyncio.sleep(0.1)
        assert (learning.event.state, workers.count, asked) == ("off", 0, 3)


@in_virtual_time
async def test_estimator_that_fails_is_replaced(workers: Workers, tmp_path: Path) -> None:
    """One that hangs or dies is ended and replaced after a second; its pattern alone is lost."""
    async with opened(tmp_path) as (learning, _, _):
        for failure, reason in ((None, "no reply"), (ChildProcessError("it died"), "it died")):
            workers.reports.put_nowait(failure)
            workers.reports.put_nowait(FOLLOWED)
            began = workers.count
            await hand(learning, count=2)
            await asyncio.sleep(30.1 if failure is None else 0.0)
            assert learning.event.state == "off"
            assert reason in learning.event.cause or failure is None
            assert (workers.count, workers.ended) == (began, began)
            await asyncio.sleep(1.5 * began)
            assert learning.event.state == "following"
        assert counted(learning, "restarts", "estimates", "discarded") == (2, 2, 2)


@in_virtual_time
async def test_estimator_that_always_fails_is_given_up(workers: Workers, tmp_path: Path) -> None:
    """After eight in a row, with the remedy; readings end, and `forget` starts anew."""
    workers.started = ChildProcessError("its process has died")
    async with opened(tmp_path) as (learning, taking, _):
        await asyncio.sleep(600.0)
        assert (workers.count, workers.ended) == (8, 8)
        assert "era forget" in str(learning.event.remedy)
        assert not taking.taken
        assert counted(learning, "restarts") == (7,)
        learning.open()
        await asyncio.sleep(1.0)
        assert workers.count == 8
        workers.started = FOLLOWED
        await learning.forget()
        await asyncio.sleep(1.0)
        assert learning.event.state == "following"


@in_virtual_time
async def test_rig_of_which_nothing_is_learned_is_not_tried_again(
    workers: Workers, tmp_path: Path
) -> None:
    """Its InputError is the cause."""
    workers.started = InputError("a plate that does not scale")
    async with opened(tmp_path) as (learning, _, _):
        await asyncio.sleep(600.0)
        assert workers.count == 1
        assert "does not scale" in learning.event.cause


@in_virtual_time
async def test_patterns_wait_for_a_slow_estimator_up_to_a_number(
    workers: Workers, tmp_path: Path
) -> None:
    """One is estimated, 16 wait, and two more are discarded."""
    async with opened(tmp_path) as (learning, _, _):
        await hand(learning)
        await hand(learning, count=18)
        assert counted(learning, "readings", "discarded") == (19, 2)
        for _ in range(17):
            workers.reports.put_nowait(FOLLOWED)
        await asyncio.sleep(1.0)
        assert counted(learning, "estimates", "discarded") == (17, 2)


def tone(frequency: float, level: float, phase: float) -> AmplifierTone:
    """One in Hz, as a share of full level, in degrees."""
    return AmplifierTone(0, frequency, level, phase)


def settled_readings(take: Callable[[SettledPattern], None]) -> SettledReadings:
    """Of the paper's rig, whose amplifier has a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    found = SettledReadings(rig, cast(Any, SimpleNamespace(amplifiers={"main": None})), take=take)
    found.sensors = [
        PlateSensor("main", number, Sensor(era.name, era.name), 0, 500.0)
        for number, era in enumerate(rig.eras)
    ]
    return found


async def read_of(readings: SettledReadings, drives: Sequence[Drive], *, load: float = 1.0) -> None:
    """Have a second pass in which contents of some drives play under a finger of a load."""
    observers = Observers()
    playing = SimpleNamespace(
        lasts=True,
        contents={n: SimpleNamespace(drive=drive) for n, drive in enumerate(drives)},
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


@pytest.mark.parametrize(("load", "count"), [(1.0, 1), (HAND_LOAD, 0)])
@in_virtual_time
async def test_nothing_is_read_while_a_hand_rests(
    heard: list[Sequence[float]], load: float, count: int
) -> None:
    """Its load is hardly known, so that it would be taken for a change of the plate."""
    read = list[SettledPattern]()
    await read_of(settled_readings(read.append), [{"SW": tone(100.0, 0.1, 0.0)}], load=load)
    assert len(read) == count


@in_virtual_time
async def test_contents_that_play_at_once_are_read_together(heard: list[Sequence[float]]) -> None:
    """Each tone with the bases that play it; not one where the harmonic of another is heard."""
    read = list[SettledPattern]()
    drives = [
        {"NE": tone(200.0, 0.5, 0.0)},
        {"SW": tone(100.0, 0.1, 90.0), "SE": tone(100.0, 0.2, 180.0)},
        {"NW": tone(150.0, 0.3, 0.0)},
    ]
    await read_of(settled_readings(read.append), drives)
    (found,) = read
    assert heard == [[100.0, 150.0, 200.0]]
    assert found.frequencies.tolist() == [100.0, 150.0]
    np.testing.assert_allclose(found.values, [100 + np.arange(4), 150 + np.arange(4)])
    stroke = 100e-6  # m; of the rig
    bases = [[0.1j * stroke, -0.2 * stroke, 0, 0], [0, 0, 0, 0.3 * stroke]]
    np.testing.assert_allclose(found.bases, bases, atol=1e-12)


@in_virtual_time
async def test_contents_that_no_reading_tells_apart_are_not_read(
    heard: list[Sequence[float]],
) -> None:
    """Two of one frequency, or 3 Hz apart where a window is 0.2 s."""
    for frequency in (100.0, 103.0):
        drives = [
            {"SW": tone(100.0, 0.1, 0.0)},
            {"SE": tone(frequency, 0.1, 0.0)},
        ]
        await read_of(settled_readings(lambda pattern: None), drives)
    assert not heard


def learned_table(file: Path) -> LearnedTable:
    """Of the paper's rig, with a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    sensors = tuple(Sensor(era.name, era.name) for era in rig.eras)
    return LearnedTable(rig, small_table(), sensors, "switched", file)


def test_pattern_of_nothing_is_noted_and_leaves_no_file(tmp_path: Path) -> None:
    """Sensors that read 0 give a note, no alarm and no table; nothing is to be saved."""
    file = tmp_path / "learned.npz"
    found = learned_table(file)
    count = len(small_table().eras)
    none = np.zeros((1, count), complex)
    nothing = SettledPattern(1.0, TONE, none + 1e-5, none)
    report = found.take(nothing)
    assert "not used" in report.note
    assert (report.is_alarm, report.table) == (False, None)
    assert found.keep() == ("", None)
    assert not file.exists()


def test_rig_that_was_not_measured_is_only_watched(tmp_path: Path) -> None:
    """Off, with the thickness that an identification would state, and how to get it."""
    report, cautious = learned_table(tmp_path / "learned.npz").start()
    assert report.state == "off"
    assert "thickness" in report.cause
    assert "identify" in str(report.remedy)
    assert report.table is None
    assert cautious.uncertainty == small_table().uncertainty


def test_damaged_file_is_set_aside(tmp_path: Path) -> None:
    """It is renamed, byte for byte, the note names it, and the plate is learned anew."""
    file = tmp_path / "learned.npz"
    file.write_bytes(b"something else")
    report, _ = learned_table(file).start()
    assert not file.exists()
    assert (tmp_path / "learned.npz.old").read_bytes() == b"something else"
    assert "learned.npz.old" in report.note
    assert report.table is None


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


def test_files_of_writers_that_were_killed_are_removed(tmp_path: Path) -> None:
    """Those of this file only."""
    left, other = tmp_path / ".learned.npz.0123456789ab", tmp_path / ".learned.npz.old"
    left.write_bytes(b"half")
    other.write_bytes(b"somebody's")
    learned_table(tmp_path / "learned.npz")
    assert not left.exists()
    assert other.exists()


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
async def test_worker_that_dies_is_reported() -> None:
    """At the call that it was killed in, and at the next one."""
    async with working() as worker:
        assert worker.pid is not None
        napping = asyncio.create_task(worker.call(PATIENCE, nap, 1e3))
        await asyncio.sleep(0.1)
        os.kill(worker.pid, signal.SIGKILL)
        for call in (napping, worker.call(PATIENCE, nap, 0.0)):
            with pytest.raises(ChildProcessError):
                await call


@pytest.mark.real_time
async def test_worker_may_not_take_all_memory() -> None:
    """Twice its limit is refused to it, and it goes on; the unit leaves 0.6 GB to the daemon."""
    unit = (example_rig_path().parent / "systemd" / "era-haptics.service").read_text("utf-8")
    assert "\nMemoryMax=1G\n" in unit
    assert MAX_MEMORY <= 2**30 - 0.6e9
    async with working() as worker:
        with pytest.raises(MemoryError):
            await worker.call(PATIENCE, grow, 2 * MAX_MEMORY)
        assert await worker.call(PATIENCE, grow, 1000) == 1000


@pytest.mark.real_time
async def test_signals_to_all_processes_of_a_daemon_do_not_end_a_worker() -> None:
    """Such as Ctrl-C, `systemctl kill` and a reload: the daemon ends it when it is done."""
    async with working() as worker:
        assert worker.pid is not None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            os.kill(worker.pid, number)
        assert await worker.call(PATIENCE, nap, 0.0) == worker.pid


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
    assert parent.stdout is not None
    worker, *others = map(int, (await parent.stdout.readline()).split())
    assert worker in others
    if is_stopped:
        os.kill(worker, signal.SIGSTOP)
    parent.kill()  # without waiting for its output, which the others may hold open
    assert await gone(parent.pid, *others)
