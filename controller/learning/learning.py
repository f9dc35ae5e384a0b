"""The daemon's plate stays known: patterns that settle correct the answers to the next touches.

    control loop -> pattern -> SettledReadings -> EstimatorProcess -> table -> control loop

The control loop never waits for any of this, and stops do not pass through it. Answers are replaced
in one step, whole and prepared. Without an estimator they stay as they were, for a while.
"""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from controller.api.schema import BAD, LearningState, LearningStatus
from controller.learning.answers_in_use import AnswersInUse
from controller.learning.estimator_process import (
    DEFAULT_TIMEOUTS,
    EstimatorProcess,
    EstimatorTimeouts,
)
from controller.learning.messages import Answers, Estimate, Note, Ready, RefreshedAnswers, Start
from controller.learning.settled_readings import SettledReadings
from controller.plate_measurement import PlateSensor, check_clocks, plate_sensors
from controller.play.loop import Controller
from controller.play.observer import Observers, PlayReport
from controller.sources.contacts import Change, Contact
from drivers.errors import CommandError, DriverError
from model.answer.answer_report import Timing
from model.identification.settled_patterns import SettledPattern
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import failure_text

CAUTIOUS_AFTER = 60.0
"""Time [s] without an estimator after which answers no longer trust what was learned."""

_PAUSE = 10.0  # s; before the sensors are asked, or read, again after a failure

_CHANGED_REMEDY = (
    "look for a loose mount, a crack or something on the plate; then identify it (era rig identify)"
    ", or discard what was learned (era forget)"
)
_UNUSUAL = ("changed", "explaining", "failed")
_FAILED_REMEDY = "see the log above; era forget starts anew"

_logger = logging.getLogger(__name__)


class Learning:
    """Learning of one plate, from `open` on, when all amplifiers are open, until `close`.

    table, timing: of the rig as built; file: of what is learned; changed: called at each change of
    state or cause; estimated: with the time [s] from the end of a reading to the answers that
    follow it.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        timing: Timing,
        file: Path,
        *,
        controller: Controller,
        changed: Callable[[LearningStatus], None] = lambda status: None,
        estimated: Callable[[float], None] = lambda latency: None,
        timeouts: EstimatorTimeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        self.status = LearningStatus(
            state="off",
            cause="amplifiers not asked for their sensors yet",
            remedy=None,
            cautious=False,
            alarms=0,
            readings=0,
            estimates=0,
            discarded=0,
            disturbed=0,
            corrections=0,
            restarts=0,
        )
        self.estimated_at: float | None = None  # s; the last estimate
        self._rig, self._base, self._file = rig, table, file
        self._controller = controller
        self._changed, self._estimated, self._timeouts = changed, estimated, timeouts
        self._answers = AnswersInUse(controller, table, timing)
        self._cautious: Answers | None = None
        self._only_alarms, self._is_held = "", False
        self._sensors: Sequence[PlateSensor] | None = None  # until they were read
        self._readings: SettledReadings | None = None
        self._estimator: EstimatorProcess | None = None
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._outage: asyncio.TimerHandle | None = None

    @property
    def estimator_pid(self) -> int | None:
        """Process number of the estimator, if one runs."""
        return None if self._estimator is None else self._estimator.pid

    def observe(self, loop: Observers) -> None:
        """Observe what the control loop reports."""
        loop.contacts_changed.append(self._contacts_changed)
        loop.pattern_applied.append(self._pattern_applied)
        loop.silenced.append(lambda silenced: self.ended())

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        if self._readings is not None:
            self._readings.contacts_changed(contacts)

    def _pattern_applied(self, applied: PlayReport) -> None:
        if self._readings is not None:
            self._readings.pattern_applied(applied)

    def ended(self) -> None:
        """Note that nothing plays any more."""
        if self._readings is not None:
            self._readings.ended()

    def open(self) -> None:
        """Start once the amplifiers are open; they are asked again after a failure."""
        if self._estimator is None and "opening" not in self._tasks:
            self._spawn("opening", self._open())

    async def forget(self) -> None:
        """Discard what was learned; answers are those of the table as built at once.

        Raises CommandError where nothing is learned, and where the file cannot be removed: then
        what was learned is still followed.
        """
        if self.status.state == "off":
            raise CommandError(f"nothing is learned of the plate: {self.status.cause}")
        await self._end("opening", "estimator", "readings", "shaping")
        self._estimator, self._readings, self._cautious = None, None, None
        self._note_lost(waiting=0)
        self._reset()
        try:
            self._file.unlink(missing_ok=True)
        except OSError as error:
            raise CommandError(
                f"{self._file}: cannot be removed, and is still followed: {error}; make its folder "
                "writable for the daemon, then repeat era forget"
            ) from error
        finally:
            if self._sensors is None:
                self.open()
            else:
                self._start(self._sensors)

    async def close(self) -> None:
        """End the estimator, which keeps what it has learned."""
        if self._outage is not None:
            self._outage.cancel()
        await self._end(*self._tasks)

    async def _open(self) -> None:
        """Ask the amplifiers for their sensors until they tell; start an estimator if they have."""
        while True:
            try:
                check_clocks(self._controller.amplifiers)
                found = await plate_sensors(self._rig, self._controller.amplifiers)
            except CommandError as error:
                self._say("off", str(error))
                return
            except DriverError as error:
                self._say(
                    "off",
                    f"sensors not read: {error}; asking again every {_PAUSE:g} s",
                    "check the link and the supply of the amplifiers",
                )
                await asyncio.sleep(_PAUSE)
            else:
                self._sensors = found.used
                self._start(found.used)
                return

    def _start(self, sensors: Sequence[PlateSensor]) -> None:
        self._say("starting", "the estimator is starting")
        start = Start(
            self._rig,
            replace(self._base),  # without what is prepared in it
            tuple(sensor.place for sensor in sensors),
            self._controller.drive_mode,
            self._file.absolute(),
        )
        self._estimator = EstimatorProcess(
            start, received=self._received, failed=self._failed, timeouts=self._timeouts
        )
        self._spawn("estimator", self._estimator.run())

    def _received(self, reply: Ready | Estimate | RefreshedAnswers | Note) -> None:
        match reply:
            case Ready():
                self._ready(reply)
            case Estimate():
                self._take(reply)
            case RefreshedAnswers():
                self._cautious = reply.cautious
                if not self.status.cautious and not self._is_held:
                    self._correct(reply.answers)
            case Note():
                _logger.warning("plate: %s", reply.text)

    def _ready(self, ready: Ready) -> None:
        self._end_outage()
        if ready.note:
            _logger.warning("plate: learning anew: %s", ready.note)
        self._cautious, self._is_held = ready.cautious, False
        self._only_alarms = ready.only_alarms
        if ready.answers is not None:
            self._correct(ready.answers, is_cautious=bool(ready.change))
        elif self.status.cautious:
            self._reset()
        if "readings" not in self._tasks:
            self._spawn("readings", self._read(ready.settling))
        if ready.change:
            self._say("changed", ready.change, _CHANGED_REMEDY)
        else:
            known = "what was learned before" if ready.answers else "the rig as built"
            self._say_followed(f"the plate is followed from {known} on")

    def _say_followed(self, cause: str) -> None:
        """Say that the plate is as known, or only watched."""
        if self._only_alarms:
            self._say(
                "only_alarms",
                f"answers stay as built: {self._only_alarms}",
                "identify the plate (era rig identify)",
            )
        else:
            self._say("following", cause)

    def _hand(self, pattern: SettledPattern) -> None:
        is_taken = self._estimator is not None and self._estimator.hand(pattern)
        self._count(readings=1, discarded=0 if is_taken else 1)

    def _take(self, estimate: Estimate) -> None:
        self.estimated_at = threads.now()
        self._is_held = estimate.is_held
        if self._readings is not None:
            self._end_outage()
        self._count(estimates=1)
        if estimate.alarm:
            self._count(alarms=1)
        if estimate.answers is not None:
            self._correct(estimate.answers, is_cautious=bool(estimate.change))
            self._estimated(threads.now() - estimate.time)
        if estimate.change:
            if estimate.explanation or self.status.state != "changed":
                self._say("changed", estimate.change, _CHANGED_REMEDY)
        elif estimate.explanation:
            self._say("following", f"the plate has changed: {estimate.explanation}")
        elif estimate.is_held:
            if self.status.state != "explaining":
                cause = "the plate is not as known; the next patterns tell what has changed"
                self._say("explaining", cause)
        elif estimate.alarm:
            cause = f"the plate is not as the rig says (alarm {self.status.alarms})"
            self._say(self.status.state, cause, self.status.remedy, is_alarm=True)
        elif self.status.state in _UNUSUAL:
            self._say_followed("the plate is again as it was")

    def _reset(self) -> None:
        self._answers.reset()
        self.status = self.status.model_copy(update={"cautious": False})

    def _correct(self, answers: Answers, *, is_cautious: bool = False) -> None:
        self._answers.replace(answers)
        self.status = self.status.model_copy(update={"cautious": is_cautious})
        self._count(corrections=1)
        if answers.is_complete:
            self._spawn("shaping", self._answers.shape_anew())

    def _note_lost(self, *, waiting: int) -> None:
        """Count readings that will not be estimated, but for those that wait."""
        status = self.status
        lost = status.readings - status.estimates - status.discarded - waiting
        self._count(discarded=max(lost, 0))

    def _failed(self, reason: str, is_final: bool) -> None:
        """Note that an estimator has ended."""
        self._note_lost(waiting=0 if self._estimator is None else self._estimator.waiting)
        self._await_outage()
        if is_final:
            self._say("failed", f"estimator: {reason}", _FAILED_REMEDY)
        else:
            self._count(restarts=1)
            self._say("restarting", f"estimator: {reason}; retrying")

    def _await_outage(self) -> None:
        """Answer cautiously after a while, unless the plate is watched again by then."""
        if self._outage is None:
            loop = asyncio.get_running_loop()
            self._outage = loop.call_later(CAUTIOUS_AFTER, self._answer_cautiously)

    def _end_outage(self) -> None:
        if self._outage is not None:
            self._outage.cancel()
            self._outage = None

    def _answer_cautiously(self) -> None:
        """Trust what was learned no longer, since nobody watches the plate."""
        if self._cautious is None or self.status.cautious:
            return
        self._correct(self._cautious, is_cautious=True)
        _logger.warning(
            "plate: not watched for %g s, answers are those of a plate that is not known",
            CAUTIOUS_AFTER,
        )
        self._changed(self.status)

    def _say(
        self,
        state: LearningState,
        cause: str,
        remedy: str | None = None,
        *,
        is_alarm: bool = False,
    ) -> None:
        """Note a state, and tell of it."""
        said = {"state": state, "cause": cause, "remedy": remedy}
        self.status = self.status.model_copy(update=said)
        level = logging.WARNING if state in BAD or is_alarm else logging.INFO
        _logger.log(level, "plate: %s: %s", state, cause, extra={"topic": "plate"})
        self._changed(self.status)

    def _count(self, **counts: int) -> None:
        now = {key: getattr(self.status, key) + more for key, more in counts.items()}
        self.status = self.status.model_copy(update=now)

    def _spawn(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        """Run work in the only task of a name; the daemon goes on if it fails."""
        if name in self._tasks:
            self._tasks[name].cancel()
        task = asyncio.create_task(self._guarded(name, work), name=f"plate {name}")
        self._tasks[name] = task
        task.add_done_callback(
            lambda done: self._tasks.pop(name) if self._tasks.get(name) is done else None
        )

    async def _guarded(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except Exception as error:
            _logger.exception("plate: %s failed", name)
            self._say("failed", failure_text(error), _FAILED_REMEDY)

    async def _read(self, settling: float) -> None:
        """Read what settles; what fails is said, and started anew."""
        while True:
            self._readings = SettledReadings(
                self._rig,
                self._controller.amplifiers,
                self._sensors or (),
                settling=settling,
                take=self._hand,
                disturbed=lambda: self._count(disturbed=1),
            )
            try:
                await self._readings.run()
            except Exception as error:
                _logger.exception("plate: readings failed")
                self._readings = None
                self._say(
                    "failed",
                    f"readings: {failure_text(error)}; retrying every {_PAUSE:g} s",
                    _FAILED_REMEDY,
                )
                self._await_outage()
            await asyncio.sleep(_PAUSE)

    async def _end(self, *names: str) -> None:
        ending = [self._tasks[name] for name in names if name in self._tasks]
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)
