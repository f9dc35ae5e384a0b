"""What the daemon says and answers by as its estimator replies, without a process."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, cast

import pytest

from controller.learning import learning as module
from controller.learning.estimator_process import EstimatorTimeouts
from controller.learning.learning import Learning
from controller.learning.learning_status import LearningState
from controller.learning.messages import Answers, Estimate, Ready, Refreshed, Reply, Start
from controller.loop.loop import Controller
from drivers.errors import CommandError, LinkError
from model.table.table import LocalizationTable
from model.table.timing import Timing
from paper_plate import make_paper_rig
from small_table import small_table
from virtual_loop import in_virtual_time


class Taking:
    """A controller that keeps what it answers by."""

    drive_mode = "switched"
    amplifiers: ClassVar[dict[str, object]] = {}

    def __init__(self) -> None:
        self.taken: list[LocalizationTable] = []

    def replace_answers(self, table: LocalizationTable, timing: Timing | None) -> None:
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
    monkeypatch.setattr(module, "check_common_start", lambda amplifiers: None)
    return found


def answers() -> Answers:
    """Of the small table as it is."""
    table = small_table()
    return Answers(table.fingerprint, replace(table), is_complete=False)


QUIET = Estimate(0.0, alarm=False, is_held=False, explanation="", change="", answers=None)


def ready() -> Ready:
    """Of an estimator that knows the plate."""
    return Ready(0.2, "", "", None, answers(), change="")


async def opened(folder: Path) -> tuple[Learning, Taking]:
    """A learning whose estimator is started."""
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
    return learning, taking


@in_virtual_time
async def test_plate_that_had_changed_stays_so_over_a_restart(
    estimators: Estimators, tmp_path: Path
) -> None:
    """Ready with the flag: changed and robust, until an estimate says that it is as it was."""
    learning, _ = await opened(tmp_path)
    estimators.reply(replace(ready(), answers=answers(), change="a crack"))
    assert learning.status.state is LearningState.CHANGED
    assert learning.status.are_robust
    estimators.reply(replace(QUIET, change="a crack"))
    assert learning.status.state is LearningState.CHANGED
    estimators.reply(replace(QUIET, answers=answers()))
    assert learning.status.state is LearningState.FOLLOWING
    assert learning.status.remedy is None
    assert not learning.status.are_robust
    await asyncio.sleep(0.1)
    await learning.close()


@in_virtual_time
async def test_refreshed_answers_are_taken_again_after_a_change(
    estimators: Estimators, tmp_path: Path
) -> None:
    """Not while patterns are held or answers are robust, and as soon as neither is so."""
    learning, taking = await opened(tmp_path)
    estimators.reply(ready())
    refreshed = Refreshed(answers(), answers())
    estimators.reply(replace(QUIET, alarm=True, is_held=True))
    estimators.reply(refreshed)
    assert taking.taken == []
    estimators.reply(replace(QUIET, explanation="a crack", change="a crack", answers=answers()))
    estimators.reply(refreshed)
    assert len(taking.taken) == 1
    estimators.reply(replace(QUIET, answers=answers()))
    estimators.reply(refreshed)
    assert len(taking.taken) == 3
    await asyncio.sleep(0.1)
    await learning.close()


@in_virtual_time
async def test_watched_plate_is_only_watched_after_a_failure(
    estimators: Estimators, tmp_path: Path
) -> None:
    """Held, then quiet: the state is again that of a plate that was not measured."""
    learning, _ = await opened(tmp_path)
    estimators.reply(replace(ready(), only_alarms="never measured"))
    assert learning.status.state is LearningState.ONLY_ALARMS
    estimators.reply(replace(QUIET, is_held=True))
    estimators.reply(QUIET)
    assert learning.status.state is LearningState.ONLY_ALARMS
    await asyncio.sleep(0.1)
    await learning.close()


@in_virtual_time
async def test_file_that_cannot_be_removed_is_still_followed(
    estimators: Estimators, tmp_path: Path
) -> None:
    """`forget` names the file, and another estimator starts from it."""
    learning, _ = await opened(tmp_path)
    estimators.reply(ready())
    await asyncio.sleep(0.1)
    (tmp_path / "learned.npz").mkdir()
    with pytest.raises(CommandError, match=r"learned\.npz"):
        await learning.forget()
    assert estimators.count == 2
    assert learning.status.state is LearningState.STARTING
    estimators.reply(replace(ready(), answers=answers()))
    assert learning.status.state is LearningState.FOLLOWING
    await asyncio.sleep(0.1)
    await learning.close()


@in_virtual_time
async def test_readings_that_fail_are_started_anew(estimators: Estimators, tmp_path: Path) -> None:
    """Failed with the cause at once; read again after a pause, and followed after an estimate."""
    learning, _ = await opened(tmp_path)
    estimators.reply(ready())
    await asyncio.sleep(0.1)
    before = Readings.count
    Readings.ending.set()
    await asyncio.sleep(0.1)
    assert learning.status.state is LearningState.FAILED
    assert "a sensor of no kind" in learning.status.cause
    await asyncio.sleep(11.0)
    assert Readings.count == before + 1
    estimators.reply(QUIET)
    assert learning.status.state is LearningState.FOLLOWING
    await asyncio.sleep(61.0)
    assert not learning.status.are_robust
    await learning.close()


@in_virtual_time
async def test_readings_that_stay_away_make_answers_robust(
    estimators: Estimators, tmp_path: Path
) -> None:
    """Nobody watches the plate: after a minute what was learned is not trusted."""
    learning, _ = await opened(tmp_path)
    estimators.reply(ready())
    await asyncio.sleep(0.1)
    Readings.ending.set()
    await asyncio.sleep(61.0)
    assert learning.status.are_robust
    await learning.close()


@in_virtual_time
async def test_sensors_that_were_not_read_are_asked_for_again(
    estimators: Estimators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off with the link's error and a remedy; the estimator starts once they reply."""
    replying = module.plate_sensors

    async def silent(*args: object) -> Any:
        raise LinkError("no reply of A")

    monkeypatch.setattr(module, "plate_sensors", silent)
    learning, _ = await opened(tmp_path)
    assert learning.status.state is LearningState.OFF
    assert "no reply of A" in learning.status.cause
    assert learning.status.remedy is not None
    monkeypatch.setattr(module, "plate_sensors", replying)
    await asyncio.sleep(11.0)
    assert learning.status.state is LearningState.STARTING
    await asyncio.sleep(0.1)
    await learning.close()


@in_virtual_time
async def test_alarm_of_a_watched_plate_is_a_warning(
    estimators: Estimators, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is all that such a plate can tell."""
    learning, _ = await opened(tmp_path)
    estimators.reply(replace(ready(), only_alarms="never measured"))
    await asyncio.sleep(0.1)
    caplog.clear()
    estimators.reply(replace(QUIET, alarm=True))
    assert learning.status.state is LearningState.ONLY_ALARMS
    assert [each.levelname for each in caplog.records] == ["WARNING"]
    await learning.close()


@in_virtual_time
async def test_forget_asks_for_sensors_that_were_never_read(
    estimators: Estimators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without them no estimator is started; a failure to read them is said again."""

    async def failing(*args: object) -> None:
        raise RuntimeError("no such words")

    monkeypatch.setattr(module, "plate_sensors", failing)
    learning, _ = await opened(tmp_path)
    assert learning.status.state is LearningState.FAILED
    await learning.forget()
    await asyncio.sleep(0.1)
    assert (learning.status.state, estimators.count) == (LearningState.FAILED, 0)
    await learning.close()
