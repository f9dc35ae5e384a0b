"""What the daemon says and answers by as its estimator replies, without a process."""

import asyncio
import pickle
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import numpy as np
import pytest

from controller.api.schema import LearningState
from controller.learning import learning as module
from controller.learning.estimator import Estimator
from controller.learning.estimator_process import (
    Answers,
    AnswersInUse,
    Estimate,
    EstimatorTimeouts,
    Note,
    Ready,
    RefreshedAnswers,
    Reply,
    Start,
    unpacked,
)
from controller.learning.learning import Learning
from controller.play.loop import Controller
from drivers.errors import CommandError, LinkError
from drivers.playing import AmplifierLayer, AmplifierTone
from model.answer.answer_report import Timing
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.learned_plate import LearnedTable
from model.estimate.settled_patterns import SettledPattern
from model.table.table import LocalizationTable
from plates import make_paper_rig, small_table
from virtual_lines import in_virtual_time


class Taking:
    """A controller that keeps what it answers by."""

    drive_mode = "switched"
    amplifiers: ClassVar[dict[str, object]] = {}

    def __init__(self) -> None:
        self.taken: list[LocalizationTable] = []

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Note a table."""
        self.taken.append(table)


class Estimators:
    """In place of processes: counts them, and replies what a test wants."""

    def __init__(self) -> None:
        self.count, self.pid, self.waiting = 0, None, 0
        self.reply: Callable[[Reply], None] = lambda reply: None

    def __call__(
        self,
        start: Start,
        *,
        received: Callable[[Reply], None],
        failed: Callable[[str, bool], None],
        timeouts: EstimatorTimeouts,
    ) -> "Estimators":
        """One more."""
        self.count += 1
        self.reply = received
        return self

    async def run(self) -> None:
        """Until cancelled."""
        await asyncio.Event().wait()


class Readings:
    """Of no sensors; `ending` ends them."""

    ending: asyncio.Event
    count = 0

    def __init__(self, *args: object, **kwargs: object) -> None:
        Readings.count += 1
        Readings.ending = asyncio.Event()

    async def run(self) -> None:
        """Until they fail."""
        await Readings.ending.wait()
        raise RuntimeError("a sensor of no kind")


@pytest.fixture
def estimators(monkeypatch: pytest.MonkeyPatch) -> Estimators:
    """Of a learning whose amplifiers have sensors."""
    found = Estimators()

    async def sensors(*args: object) -> Any:
        return type("Sensors", (), {"used": ()})

    monkeypatch.setattr(module, "EstimatorProcess", found)
    monkeypatch.setattr(module, "SettledReadings", Readings)
    monkeypatch.setattr(module, "plate_sensors", sensors)
    monkeypatch.setattr(module, "check_clocks", lambda amplifiers: None)
    return found


def answers() -> Answers:
    """Of the small table as it is."""
    table = small_table()
    return Answers(table.fingerprint, replace(table), is_complete=False)


QUIET = Estimate(0.0, alarm=False, is_held=False, explanation="", change="", answers=None)


def ready() -> Ready:
    """Of an estimator that knows the plate."""
    return Ready(0.2, "", "", None, answers(), change="")


@asynccontextmanager
async def opened(folder: Path) -> AsyncIterator[tuple[Learning, Taking]]:
    """A learning whose estimator is started, closed at the end."""
    taking = Taking()
    learning = Learning(
        make_paper_rig(12, 9),
        small_table(),
        Timing(small_table()),
        folder / "learned.npz",
        controller=cast(Controller, taking),
    )
    learning.open()
    await asyncio.sleep(0.1)
    yield learning, taking
    await asyncio.sleep(0.1)
    await learning.close()


@dataclass(frozen=True)
class Told:
    """What the estimator tells, and what is so thereafter, by the names of the status.

    taken: how many tables the controller has taken in all; levels: of what was logged for it.
    """

    reply: Reply
    state: LearningState
    is_cautious: bool | None = None
    taken: int | None = None
    levels: Sequence[str] | None = None


def watching() -> Ready:
    """Of an estimator that can only give alarms."""
    return replace(ready(), only_alarms="never measured")


REFRESHED = RefreshedAnswers(answers(), answers())
CHANGED, FOLLOWING = "changed", "following"
EXPLAINING, ONLY_ALARMS = "explaining", "only_alarms"
COURSES = {
    # Changed and cautious, until an estimate says that it is as it was.
    "a plate that had changed stays so over a restart": [
        Told(replace(ready(), answers=answers(), change="a crack"), CHANGED, is_cautious=True),
        Told(replace(QUIET, change="a crack"), CHANGED),
        Told(replace(QUIET, answers=answers()), FOLLOWING, is_cautious=False),
    ],
    # Not while patterns are held or answers are cautious, and as soon as neither is so.
    "refreshed answers are taken again after a change": [
        Told(ready(), FOLLOWING),
        Told(replace(QUIET, alarm=True, is_held=True), EXPLAINING),
        Told(REFRESHED, EXPLAINING, taken=0),
        Told(replace(QUIET, explanation="a crack", change="a crack", answers=answers()), CHANGED),
        Told(REFRESHED, CHANGED, taken=1),
        Told(replace(QUIET, answers=answers()), FOLLOWING),
        Told(REFRESHED, FOLLOWING, taken=3),
    ],
    # Held, then quiet: the state is again that of a plate that was not measured.
    "a watched plate is only watched after a failure": [
        Told(watching(), ONLY_ALARMS),
        Told(replace(QUIET, is_held=True), EXPLAINING),
        Told(QUIET, ONLY_ALARMS),
    ],
    # It is all that such a plate can tell.
    "an alarm of a watched plate is a warning": [
        Told(watching(), ONLY_ALARMS),
        Told(replace(QUIET, alarm=True), ONLY_ALARMS, levels=["WARNING"]),
    ],
}


@pytest.mark.parametrize("name", COURSES)
@in_virtual_time
async def test_status_follows_the_estimator(
    estimators: Estimators, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """After each reply of a course."""
    async with opened(tmp_path) as (learning, taking):
        for told in COURSES[name]:
            caplog.clear()
            estimators.reply(told.reply)
            status = learning.status
            assert status.state is told.state, told
            assert told.is_cautious in (None, status.cautious), told
            assert told.taken in (None, len(taking.taken)), told
            assert told.levels in (None, [each.levelname for each in caplog.records]), told


@in_virtual_time
async def test_file_that_cannot_be_removed_is_still_followed(
    estimators: Estimators, tmp_path: Path
) -> None:
    """`forget` names the file, and another estimator starts from it."""
    async with opened(tmp_path) as (learning, _):
        estimators.reply(ready())
        await asyncio.sleep(0.1)
        (tmp_path / "learned.npz").mkdir()
        with pytest.raises(CommandError, match=r"learned\.npz"):
            await learning.forget()
        assert estimators.count == 2
        assert learning.status.state == "starting"
        estimators.reply(replace(ready(), answers=answers()))
        assert learning.status.state == "following"


@in_virtual_time
async def test_readings_that_fail_are_started_anew(estimators: Estimators, tmp_path: Path) -> None:
    """Failed with the cause at once; read again after a pause, and followed after an estimate."""
    async with opened(tmp_path) as (learning, _):
        estimators.reply(ready())
        await asyncio.sleep(0.1)
        before = Readings.count
        Readings.ending.set()
        await asyncio.sleep(0.1)
        assert learning.status.state == "failed"
        assert "a sensor of no kind" in learning.status.cause
        await asyncio.sleep(11.0)
        assert Readings.count == before + 1
        estimators.reply(QUIET)
        assert learning.status.state == "following"
        await asyncio.sleep(61.0)
        assert not learning.status.cautious


@in_virtual_time
async def test_readings_that_stay_away_make_answers_cautious(
    estimators: Estimators, tmp_path: Path
) -> None:
    """Nobody watches the plate: after a minute what was learned is not trusted."""
    async with opened(tmp_path) as (learning, _):
        estimators.reply(ready())
        await asyncio.sleep(0.1)
        Readings.ending.set()
        await asyncio.sleep(61.0)
        assert learning.status.cautious


@in_virtual_time
async def test_sensors_that_were_not_read_are_asked_for_again(
    estimators: Estimators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off with the link's error and a remedy; the estimator starts once they reply."""
    replying = module.plate_sensors

    async def silent(*args: object) -> Any:
        raise LinkError("no reply of A")

    monkeypatch.setattr(module, "plate_sensors", silent)
    async with opened(tmp_path) as (learning, _):
        assert learning.status.state == "off"
        assert "no reply of A" in learning.status.cause
        assert learning.status.remedy is not None
        monkeypatch.setattr(module, "plate_sensors", replying)
        await asyncio.sleep(11.0)
        assert learning.status.state == "starting"


@in_virtual_time
async def test_forget_asks_for_sensors_that_were_never_read(
    estimators: Estimators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without them no estimator is started; a failure to read them is said again."""

    async def failing(*args: object) -> None:
        raise RuntimeError("no such words")

    monkeypatch.setattr(module, "plate_sensors", failing)
    async with opened(tmp_path) as (learning, _):
        assert learning.status.state == "failed"
        await learning.forget()
        await asyncio.sleep(0.1)
        assert (learning.status.state, estimators.count) == ("failed", 0)


def estimator(file: Path, *, now: Callable[[], float] = time.monotonic) -> Estimator:
    """Of the paper's rig, with a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    sensors = tuple(Sensor(era.name, era.name) for era in rig.eras)
    return Estimator(Start(rig, small_table(), sensors, "switched", file), now=now)


def test_pattern_of_nothing_is_noted_and_leaves_no_file(tmp_path: Path) -> None:
    """Sensors that read 0 give a note and an estimate of no change; nothing is to be saved."""
    file = tmp_path / "learned.npz"
    found = estimator(file)
    count = len(small_table().eras)
    nothing = SettledPattern(1.0, 110.0, np.full(count, 1e-5 + 0j), np.zeros(count, dtype=complex))
    note, estimate = found.take(nothing)
    assert isinstance(note, Note)
    assert not note.is_final
    assert isinstance(estimate, Estimate)
    assert (estimate.time, estimate.alarm, estimate.answers) == (1.0, False, None)
    assert found.save() is None
    assert not file.exists()


def test_damaged_file_is_set_aside(tmp_path: Path) -> None:
    """It is renamed, byte for byte, the note names it, and the estimator starts anew."""
    file = tmp_path / "learned.npz"
    file.write_bytes(b"something else")
    found = estimator(file)
    assert not file.exists()
    assert (tmp_path / "learned.npz.old").read_bytes() == b"something else"
    assert "learned.npz.old" in found.note
    assert found.ready().answers is None


def test_folder_without_room_is_noted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts go on with each chore, and the next note is of another error."""
    clock, errors = [0.0], [OSError(28, "No space left on device")]

    def save(learned: LearnedTable) -> None:
        raise errors[0]

    found = estimator(tmp_path / "learned.npz", now=lambda: clock[0])
    monkeypatch.setattr(LearnedTable, "save", save)
    monkeypatch.setattr(found, "_is_saved", False)
    notes = []
    for second in range(10, 60, 10):
        clock[0] = float(second)
        if second == 40:
            errors[0] = OSError(30, "Read-only file system")
        notes.append(found.chores())
    assert [len(each) for each in notes] == [1, 0, 0, 1, 0]
    assert all(isinstance(note, Note) for each in notes for note in each)


def test_files_of_writers_that_were_killed_are_removed(tmp_path: Path) -> None:
    """Those of this file only."""
    left, other = tmp_path / ".learned.npz.0123456789ab", tmp_path / ".learned.npz.old"
    left.write_bytes(b"half")
    other.write_bytes(b"somebody's")
    estimator(tmp_path / "learned.npz")
    assert not left.exists()
    assert other.exists()


def test_answers_of_another_table_are_refused() -> None:
    """By its fingerprint, and nothing is replaced; those of the own one are, and can be reset."""
    base, taken = small_table(), list[LocalizationTable]()
    controller = SimpleNamespace(replace_answers=lambda table, timing: taken.append(table))
    in_use = AnswersInUse(cast(Controller, controller), base, Timing(base))
    other = replace(base, masses=(), eras=base.eras[::-1])
    with pytest.raises(InputError, match="table"):
        in_use.replace(Answers(other.fingerprint, other, is_complete=True))
    assert taken == []
    own = replace(base)
    in_use.replace(Answers(base.fingerprint, own, is_complete=False))
    in_use.reset()
    assert taken == [own, base]


def test_no_command_comes_by_a_message() -> None:
    """What an amplifier could play is refused, wherever it stands in it."""
    layer = AmplifierLayer(0, (AmplifierTone(0, 110.0, 1.0),))
    with pytest.raises(pickle.UnpicklingError, match="drivers"):
        unpacked(pickle.dumps(Note([layer])))  # type: ignore[arg-type]
