"""Learning of the plate while the daemon drives it: settled patterns correct the next answers.

    control loop -> pattern -> SettledReadings -> EstimatorProcess -> table -> control loop

The control loop never waits for any of this, and stops do not pass through it. Answers are replaced
in one step, whole and prepared. Without an estimator they stay as they were for `CAUTIOUS_AFTER`
seconds, then they are those of a plate that is not known.

`SettledReadings` reads the sensors once in every pattern that has settled: some time after its last
fade and after the last change of the contacts. What plays is never delayed for a reading: its
requests go last on the line, and none is sent while contacts change. A renewal disturbs a reading,
which is then repeated.
"""

import asyncio
import cmath
import logging
import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.api.schema import BAD, LearningState, LearningStatus
from controller.learning.estimator_process import (
    DEFAULT_TIMEOUTS,
    Answers,
    AnswersInUse,
    Estimate,
    EstimatorProcess,
    EstimatorTimeouts,
    Note,
    Ready,
    RefreshedAnswers,
    Start,
)
from controller.plate_measurement import PlateSensor, check_clocks, plate_sensors
from controller.play.loop import Controller
from controller.play.planner import Observers, PlayReport
from controller.sources.touch import Change, Contact
from drivers.errors import CommandError, DriverError, Preempted
from drivers.host.amplifier import Amplifier, Reading, finish_reading, start_reading
from model.answer.answer_report import Timing
from model.estimate.forward import RestingFinger
from model.estimate.settled_patterns import SettledPattern
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import failure_text

WINDOW = 0.2  # s; of a reading, as in an identification
READINGS = 4  # of one pattern, at most, where others are disturbed
_MOVED = 0.003  # m; a finger that has moved by less loads the plate as before
_MARGIN = 0.002  # s; of the amplifiers' clocks
_PERIODS = 1.01  # of a tone within a window, for frequencies as amplifiers round them
_PAUSE_AFTER_FAILURE = 10.0  # s

_logger = logging.getLogger(__name__)


class SettledReadings:
    """Follows what the control loop reports, and reads each pattern once it has settled.

    amplifiers: by name; their clocks must agree.
    sensors: of these amplifiers.
    settling: time [s] until the plate has settled.
    take: receives each pattern with its reading, at the time [s] when the window ended.
    disturbed: called for each reading that a change, an overload or the link has spoilt.
    """

    def __init__(
        self,
        rig: Rig,
        amplifiers: Mapping[str, Amplifier],
        sensors: Sequence[PlateSensor],
        *,
        settling: float,
        take: Callable[[SettledPattern], None],
        disturbed: Callable[[], None],
    ) -> None:
        self._rig, self._amplifiers, self._sensors = rig, amplifiers, sensors
        self._settling, self._take, self._disturbed = settling, take, disturbed
        self._highest = min(sensor.frequency_max for sensor in sensors)
        self._contacts: tuple[Contact, ...] = ()
        self._settled_contacts: tuple[Contact, ...] = ()
        self._playing: PlayReport | None = None
        self._due = math.inf
        self._change = asyncio.Event()

    def pattern_applied(self, applied: PlayReport) -> None:
        """Follow a pattern that the amplifiers have confirmed, if it can be read."""
        frequencies = {command.frequency for command in applied.drive.values()}
        is_one = len(applied.contents) == len(frequencies) == 1
        is_read = applied.lasts and is_one and max(frequencies) <= self._highest
        self._playing = applied if is_read else None
        self._contacts = applied.contacts
        self._wait_for(applied.time + applied.settled_after)

    def contacts_changed(self, contacts: tuple[Contact, ...]) -> None:
        """Follow the contacts; where they load the plate otherwise it settles anew."""
        self._contacts = contacts
        if not _are_same(contacts, self._settled_contacts):
            self._wait_for(threads.now())

    def ended(self) -> None:
        """Read no more of what played."""
        self._playing, self._due = None, math.inf
        self._change.set()

    async def run(self) -> None:
        """Read every pattern that settles, until cancelled."""
        while True:
            self._change.clear()
            if await self._changes_by(self._due):
                continue
            applied, contacts = self._playing, self._contacts
            self._due = math.inf
            if applied is None:
                continue
            try:
                await self._read(applied, contacts)
            except Preempted:
                self._disturbed()  # what preempted it is read once it has settled
            except DriverError as error:
                self._disturbed()
                _logger.info("reading given up: %s", error)
                await asyncio.sleep(_PAUSE_AFTER_FAILURE)

    def _wait_for(self, since: float) -> None:
        """Read a settling time after a moment [s] with the contacts of now."""
        self._settled_contacts = self._contacts
        self._due = math.inf if self._playing is None else since + self._settling
        self._change.set()

    async def _changes_by(self, moment: float) -> bool:
        """Wait for a change until a moment [s]; whether there was one."""
        timeout = None if math.isinf(moment) else max(0.0, moment - threads.now())
        try:
            async with asyncio.timeout(timeout):
                await self._change.wait()
        except TimeoutError:
            return False
        return True

    async def _read(self, applied: PlayReport, contacts: tuple[Contact, ...]) -> None:
        """Read a pattern until a reading was not disturbed; raises DriverError."""
        (frequency,) = {command.frequency for command in applied.drive.values()}
        for _ in range(READINGS):
            readings, ended_at = await self._measure(frequency)
            if self._change.is_set():
                self._disturbed()
                return
            if all(each.state == "COMPLETE" for each in readings.values()):
                break
        else:
            self._disturbed()
            return
        values = []
        for sensor in self._sensors:
            several = readings[sensor.amplifier].sensors
            if sensor.number >= len(several) or several[sensor.number].is_overloaded:
                self._disturbed()
                return
            reading = readings[sensor.amplifier]
            values.append(sensor.accelerations(reading, np.array([frequency]))[0])
        if not np.isfinite(values).all() or not np.any(values):  # no phase to turn others to
            self._disturbed()
            _logger.info("reading given up: all sensors read nothing")
            return
        tip = self._rig.fingertip
        fingers = [RestingFinger(c.x, c.y, tip.scaled(c.load)) for c in contacts if tip is not None]
        pattern = SettledPattern(
            ended_at,
            frequency,
            np.array(
                [
                    cmath.rect(tone.level * era.full_level, math.radians(tone.phase))
                    if (tone := applied.drive.get(era.name)) is not None
                    else 0j
                    for era in self._rig.eras
                ]
            ),
            np.array(values),
            tuple(fingers),
            has_phase=False,  # outputs follow their clocks by a delay that is not known
        )
        self._take(pattern)

    async def _measure(self, frequency: float) -> tuple[Mapping[str, Reading], float]:
        """Read a tone [Hz] at all amplifiers; the readings, and when [s] their window ended.

        Nothing is requested after a change meanwhile.
        """
        names = {sensor.amplifier for sensor in self._sensors}
        amplifiers = {name: self._amplifiers[name] for name in sorted(names)}
        window = max(WINDOW, _PERIODS / frequency)
        started = {
            name: await start_reading(each, [frequency], window)
            for name, each in amplifiers.items()
        }
        end = threads.now() + max(each.left for each in started.values())
        if await self._changes_by(end + _MARGIN):
            return started, end
        found = {
            name: await finish_reading(each, replace(started[name], left=0.0))
            for name, each in amplifiers.items()
        }
        return found, end


def _are_same(contacts: tuple[Contact, ...], before: tuple[Contact, ...]) -> bool:
    """Whether contacts load the plate as others did."""
    then = {contact.key: contact for contact in before}
    return len(contacts) == len(before) and all(
        contact.key in then
        and math.dist((contact.x, contact.y), (then[contact.key].x, then[contact.key].y)) <= _MOVED
        and contact.load == then[contact.key].load
        for contact in contacts
    )


CAUTIOUS_AFTER = 60.0
"""Time [s] without an estimator after which answers no longer trust what was learned."""

_PAUSE = 10.0  # s; before the sensors are asked, or read, again after a failure

_CHANGED_REMEDY = (
    "look for a loose mount, a crack or something on the plate; then identify it (era rig identify)"
    ", or discard what was learned (era forget)"
)
_UNUSUAL = ("changed", "explaining", "failed")
_FAILED_REMEDY = "see the log above; era forget starts anew"


class Learning:
    """Learning of one plate, from `open` on, when all amplifiers are open, until `close`.

    table, timing: of the rig as built.
    file: of what is learned.
    changed: called at each change of state or cause.
    estimated: called with the time [s] from the end of a reading to the answers that follow it.
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
        """Report that the plate is followed, or only watched."""
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
        """Stop trusting what was learned, since no estimator watches the plate."""
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
        """Set state, cause and remedy, log them and report the change."""
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
        """Read settled patterns; report failures and start again after them."""
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
