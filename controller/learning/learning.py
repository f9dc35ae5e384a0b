"""Learning of the plate while the daemon drives it: settled patterns correct the next answers.

    control loop -> SettledReadings -> estimator, in a process of its own -> table -> control loop

The control loop never waits for any of this, and stops do not pass through it. Whatever happens to
the estimator, the daemon goes on: one that dies, or does not answer in time, is replaced after a
growing pause, until several in a row have failed without an estimate.

Answers are replaced in one step. They were prepared before: by the estimator, and for onsets and
endings here, one frequency at a time; until then these keep the shapes of the previous answers.
Without an estimator they stay as they were for `CAUTIOUS_AFTER` seconds, then they are those of a
plate that is not known.

A pattern has settled some time after its last fade and after the last change of the contacts. What
plays is never delayed for a reading: its requests go last on the line, and none is sent while
contacts change. A renewal disturbs a reading, which is then repeated.
"""

import asyncio
import cmath
import contextlib
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from controller.api.schema import (
    LEARNING_WORDS,
    LatencySummary,
    LearningState,
    LearningSummary,
    PlateEvent,
    PlateObject,
)
from controller.learning.learned_table import LearnedTable, PlateReport
from controller.learning.worker import Worker, make, of_made
from controller.operation.plate_controller import Controller
from controller.plate_measurement import PlateSensor, check_clocks, plate_sensors, settling
from controller.play.loop import Observers, PlayReport
from controller.sources.touch import Contact
from drivers.errors import CommandError, DriverError, Preempted
from drivers.host.amplifier_sensors import Reading, finish_reading, start_reading
from model.answer.answer_report import Timing
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.following import SettledPattern
from model.estimate.forward import RestingFinger
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import failure_text
from registry.threads import Backoff

START_LIMIT = 60.0
"""Time [s] in which an estimator must take patterns."""

ESTIMATE_LIMIT = 30.0
"""Time [s] for one pattern; the search for an explanation takes longest."""

MAX_FAILURES = 8
"""Failures in a row after which an estimator is not replaced any more."""

_MAX_WAITING = 16
"""Patterns that wait for the estimator; newer ones are dropped."""

CAUTIOUS_AFTER = 60.0
"""Time [s] without an estimator after which answers no longer trust what was learned."""

_WINDOW = 0.2  # s; of a reading, as in an identification
_READINGS = 4  # of one pattern, at most, where others are disturbed
_MOVED = 0.003  # m; a finger that has moved by less loads the plate as before
_MARGIN = 0.002  # s; of the amplifiers' clocks
_PERIODS = 1.01  # of a tone within a window, for frequencies as amplifiers round them
_KEEP_INTERVAL, _SHAPE_INTERVAL = 10.0, 60.0  # s
_CLOSE_LIMIT = 0.3  # s
_PAUSE = 10.0  # s; before the sensors are asked, or read, again after a failure
_BETWEEN = 0.02  # s; between frequencies, which take a millisecond or two each

_FAILED_REMEDY = "see the log above; era forget starts anew"
_COUNTED = ("readings", "estimates", "corrections", "restarts")

_logger = logging.getLogger(__name__)


class SettledReadings:
    """Follows what the control loop reports, and reads each pattern once it has settled.

    The clocks of the controller's amplifiers must agree.

    take: receives each pattern with its reading, at the time [s] when the window ended.
    """

    def __init__(
        self, rig: Rig, controller: Controller, *, take: Callable[[SettledPattern], None]
    ) -> None:
        self.sensors: Sequence[PlateSensor] = ()
        """Sensors of the amplifiers, to be set before `run`."""
        self.settling = 0.0
        """Time [s] until the plate has settled, to be set before `run`."""
        self.disturbed = 0
        """Number of readings that a change, an overload or the link has spoilt."""
        self._rig, self._controller = rig, controller
        self._take = take
        self._contacts: tuple[Contact, ...] = ()
        self._settled_contacts: tuple[Contact, ...] = ()
        self._playing: PlayReport | None = None
        self._due = math.inf  # s; when it has settled
        self._change = asyncio.Event()

    def observe(self, loop: Observers) -> None:
        """Observe what the control loop reports."""
        loop.contacts_changed.append(lambda contacts, change: self._contacts_changed(contacts))
        loop.reported.append(self._reported)

    def ended(self) -> None:
        """Read no more of what played."""
        self._playing, self._due = None, math.inf
        self._change.set()

    def _reported(self, applied: PlayReport) -> None:
        """Follow a pattern that the amplifiers have confirmed, if it can be read."""
        if not applied.contents:
            self.ended()
            return
        highest = min((each.frequency_max for each in self.sensors), default=0.0)
        frequencies, _ = self._tones(applied)
        is_apart = np.diff(frequencies, prepend=0.0).min() * _WINDOW >= 1
        is_read = applied.lasts and len(applied.contents) == len(frequencies) and is_apart
        self._playing = applied if is_read and frequencies[-1] <= highest else None
        self._contacts = applied.contacts
        self._wait_for(applied.time + applied.settled_after)

    def _contacts_changed(self, contacts: tuple[Contact, ...]) -> None:
        """Follow the contacts; where they load the plate otherwise it settles anew."""
        self._contacts = contacts
        if not _are_same(contacts, self._settled_contacts):
            self._wait_for(threads.now())

    def _wait_for(self, since: float) -> None:
        """Read a settling time after a moment [s] with the contacts of now, unless a hand rests."""
        self._settled_contacts = self._contacts
        has_hand = any(each.is_hand for each in self._contacts)  # its load is hardly known
        self._due = math.inf if self._playing is None or has_hand else since + self.settling
        self._change.set()

    async def run(self) -> None:
        """Read every pattern that settles, until cancelled."""
        while True:
            self._change.clear()
            if await self._changes_by(self._due) or self._playing is None:
                continue
            self._due, pattern = math.inf, None
            try:
                pattern = await self._read(self._playing, self._contacts)
            except Preempted:
                pass  # what preempted it is read once it has settled
            except DriverError as error:
                _logger.info("reading given up: %s", error)
                await asyncio.sleep(_PAUSE)
            if pattern is None:
                self.disturbed += 1
            else:
                self._take(pattern)

    async def _changes_by(self, moment: float) -> bool:
        """Wait for a change until a moment [s]; whether there was one."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(None if math.isinf(moment) else moment):
                await self._change.wait()
        return self._change.is_set()

    async def _read(
        self, applied: PlayReport, contacts: tuple[Contact, ...]
    ) -> SettledPattern | None:
        """Read a pattern until a reading was not disturbed, None if all were; raises DriverError.

        Without the phase of its drives: outputs follow their clocks by a delay that is not known.
        """
        frequencies, bases = self._tones(applied)
        for _ in range(_READINGS):
            readings, ended_at = await self._measure(frequencies)
            if self._change.is_set():
                return None
            if all(each.state == "COMPLETE" for each in readings.values()):
                break
        else:
            return None
        overloaded = [readings[each.amplifier].sensors[each.number] for each in self.sensors]
        if any(each.is_overloaded for each in overloaded):
            return None
        values = np.array(
            [each.accelerations(readings[each.amplifier], frequencies) for each in self.sensors]
        ).T
        if not np.isfinite(values).all() or not np.abs(values).any(axis=1).all():
            _logger.info("reading given up: all sensors read nothing")  # no phase to turn others to
            return None
        tip = self._rig.fingertip
        fingers = (
            ()
            if tip is None
            else (RestingFinger(each.x, each.y, tip.scaled(each.load)) for each in contacts)
        )
        # Not where the second harmonic of another tone is heard as well.
        is_own = np.abs(frequencies[:, None] - 2 * frequencies).min(axis=1) * _WINDOW >= 1
        return SettledPattern(
            ended_at,
            frequencies[is_own],
            bases[is_own],
            values[is_own],
            tuple(fingers),
            has_phase=False,
        )

    def _tones(self, applied: PlayReport) -> tuple[FloatArray, ComplexArray]:
        """Frequencies (k,) [Hz] of what plays, ascending, and bases (k, n) [m] as commanded."""
        tones = [
            (number, tone)
            for each in applied.contents.values()
            for number, era in enumerate(self._rig.eras)
            if (tone := each.drive.get(era.name))
        ]
        frequencies, rows = np.unique([t.frequency for _, t in tones], return_inverse=True)
        bases = np.zeros((len(frequencies), len(self._rig.eras)), dtype=complex)
        for row, (number, tone) in zip(rows, tones, strict=True):
            level = tone.level * self._rig.eras[number].full_level
            bases[row, number] += cmath.rect(level, math.radians(tone.phase))
        return frequencies, bases

    async def _measure(self, frequencies: FloatArray) -> tuple[Mapping[str, Reading], float]:
        """Read tones (k,) [Hz] at all amplifiers; the readings, and when [s] their window ended.

        Nothing is requested after a change meanwhile.
        """
        names = sorted({sensor.amplifier for sensor in self.sensors})
        amplifiers = {name: self._controller.amplifiers[name] for name in names}
        window = max(_WINDOW, _PERIODS / float(np.diff(frequencies, prepend=0.0).min()))
        started = {
            name: await start_reading(each, frequencies.tolist(), window)
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
        changed: Callable[[PlateEvent], None],
        estimated: Callable[[float], None],
    ) -> None:
        self.event = PlateEvent(
            state="off",
            cause="amplifiers not asked for their sensors yet",
            remedy=None,
            cautious=False,
            alarms=0,
        )
        """Present state of the plate, and why."""
        self.readings = SettledReadings(rig, controller, take=self._hand)
        """Readings of the plate, which are to observe the control loop."""
        self.worker: Worker | None = None
        """Process of the estimator, if one runs."""
        self._rig, self._base, self._file = rig, (table, timing), file
        self._controller = controller
        self._changed, self._estimated = changed, estimated
        self._table, self._timing = self._base
        self._cautious: LocalizationTable | None = None
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._estimated_at: float | None = None  # s
        self._is_shaped = True
        self._in_hand = 0  # pattern that is being estimated
        self._waiting: asyncio.Queue[SettledPattern] = asyncio.Queue(_MAX_WAITING)
        self._task: asyncio.Task[None] | None = None
        self._outage: asyncio.TimerHandle | None = None

    def summary(self, latency_ms: LatencySummary) -> LearningSummary:
        """What is learned; latency_ms: of what `estimated` was called with."""
        at, counts = self._estimated_at, self._counts
        waiting = self._waiting.qsize() + self._in_hand
        found = {
            **self.event.model_dump(),
            **self._counts,
            "disturbed": self.readings.disturbed,
            # Neither estimated nor waiting, nor with the estimator.
            "discarded": counts["readings"] - counts["estimates"] - waiting,
            "last_estimate_s": None if at is None else max(0.0, threads.now() - at),
            "latency_ms": latency_ms,
        }
        return LearningSummary.model_validate(found)

    def open(self) -> None:
        """Start once the amplifiers are open; they are asked again after a failure."""
        if self._task is None or (self._task.done() and not self.readings.sensors):
            self._task = asyncio.create_task(self._run(), name="plate")

    async def forget(self) -> None:
        """Discard what was learned; answers are those of the table as built at once.

        Raises CommandError where nothing is learned, and where the file cannot be removed: then
        what was learned is still followed.
        """
        if not self.readings.sensors and self.event.remedy != _FAILED_REMEDY:
            raise CommandError(f"nothing is learned of the plate: {self.event.cause}")
        await self.close()
        self._cautious = None
        self._answer_by(*self._base, is_cautious=False)
        try:
            self._file.unlink(missing_ok=True)
        except OSError as error:
            raise CommandError(
                f"{self._file}: cannot be removed, and is still followed: {error}; make its folder "
                "writable for the daemon, then repeat era forget"
            ) from error
        finally:
            self.open()

    async def close(self) -> None:
        """End the estimator, which keeps what it has learned."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._task = None
        self._end_outage()

    async def _run(self) -> None:
        """Follow the plate until cancelled, or until that fails for good."""
        try:
            if not await self._has_sensors():
                return
            async with asyncio.TaskGroup() as beside:
                reading = beside.create_task(self._read())
                await self._keep_estimator()
                reading.cancel()
        except Exception as error:
            _logger.exception("plate: learning failed")
            self._fail(failure_text(error))
        finally:
            self._waiting = asyncio.Queue(_MAX_WAITING)

    async def _has_sensors(self) -> bool:
        """Ask the amplifiers for their sensors until they tell; whether they have some of use."""
        while not self.readings.sensors:
            try:
                check_clocks(self._controller.amplifiers)
                self.readings.sensors, _ = await plate_sensors(
                    self._rig, self._controller.amplifiers
                )
            except CommandError as error:
                self._say("off", str(error))
                return False
            except DriverError as error:
                cause = f"sensors not read: {error}; asking again every {_PAUSE:g} s"
                self._say("off", cause, "check the link and the supply of the amplifiers")
                await asyncio.sleep(_PAUSE)
        return True

    async def _keep_estimator(self) -> None:
        """Replace the estimator whenever it fails, until that is final."""
        self._say("off", "the estimator is starting")
        backoff, failures = Backoff(first=1.0, maximum=60.0), 0
        while True:
            started_at, estimates = threads.now(), self._counts["estimates"]
            try:
                await self._estimate()
            except InputError as error:
                reason, failures = str(error), MAX_FAILURES
            except OSError as error:
                reason = str(error)
            except Exception as error:
                _logger.exception("plate: the estimator failed")
                reason = failure_text(error)
            finally:
                self.worker, self._in_hand = None, 0
            failures = 1 if self._counts["estimates"] > estimates else failures + 1
            if failures >= MAX_FAILURES:
                self._fail(f"estimator: {reason}")
                return
            self._counts["restarts"] += 1
            self._fail(f"estimator: {reason}; retrying")
            await asyncio.sleep(backoff.pause(ran_for=threads.now() - started_at))

    async def _estimate(self) -> None:
        """Run one estimator; raises InputError for a rig of which nothing can be learned.

        Raises OSError where it does not start, reply or live.
        """
        worker = self.worker = Worker()
        try:
            table, heard = self._base[0], [sensor.place for sensor in self.readings.sensors]
            band = float(table.frequencies[0]), float(table.frequencies[-1])
            self.readings.settling = await worker.call(START_LIMIT, settling, self._rig, band)
            await worker.call(
                START_LIMIT,
                make,
                LearnedTable,
                self._rig,
                replace(table),  # without what is prepared in it
                heard,
                self._controller.drive_mode,
                self._file.absolute(),
            )
            report, self._cautious = await worker.call(START_LIMIT, of_made, LearnedTable.start)
            if self.event.cautious:
                self._answer_by(*self._base, is_cautious=False)
            self._follow(report)
            keep_at = shape_at = threads.now()
            while True:
                if threads.now() >= shape_at and not self._is_shaped:
                    await self._shape()
                    shape_at = threads.now() + _SHAPE_INTERVAL
                try:
                    async with asyncio.timeout_at(keep_at):
                        pattern = await self._waiting.get()
                except TimeoutError:
                    keep_at = threads.now() + _KEEP_INTERVAL
                    note, cautious = await worker.call(ESTIMATE_LIMIT, of_made, LearnedTable.keep)
                    self._note(note)
                    self._cautious = cautious or self._cautious
                    continue
                self._in_hand = 1
                report = await worker.call(ESTIMATE_LIMIT, of_made, LearnedTable.take, pattern)
                self._in_hand = 0
                self._follow(report, pattern)
        finally:
            with contextlib.suppress(Exception):
                await worker.call(_CLOSE_LIMIT, of_made, LearnedTable.keep)
            worker.end()

    def _hand(self, pattern: SettledPattern) -> None:
        self._counts["readings"] += 1
        with contextlib.suppress(asyncio.QueueFull):
            self._waiting.put_nowait(pattern)

    def _follow(self, report: PlateReport, pattern: SettledPattern | None = None) -> None:
        """Follow what the estimator has found at its start, or in a pattern."""
        self._end_outage()
        self._note(report.note)
        if report.table is not None:
            timing = self._timing.following(report.table)
            self._answer_by(report.table, timing, is_cautious=report.state == "changed")
            self._is_shaped = False
            self._counts["corrections"] += 1
        if pattern is not None:
            self._estimated_at = threads.now()
            self._counts["estimates"] += 1
            if report.table is not None:
                self._estimated(threads.now() - pattern.time)
        self.event = self.event.model_copy(update={"alarms": self.event.alarms + report.is_alarm})
        if report.is_alarm or (report.state, report.cause) != (self.event.state, self.event.cause):
            is_bad = report.is_alarm or report.state == "changed"
            self._say(report.state, report.cause, report.remedy, is_bad=is_bad, lying=report.lying)

    def _note(self, note: str) -> None:
        if note:
            _logger.warning("plate: %s", note)

    async def _shape(self) -> None:
        """Shape onsets and endings for the present table, while nothing is on its way."""
        table = self._table
        timing, frequencies = Timing(table), table.frequencies.tolist()
        while frequencies:
            if not self._controller.cycle.is_preparing:
                timing.prepare([frequencies.pop()])
            await asyncio.sleep(_BETWEEN)
        if self._table is table:
            self._answer_by(table, timing, is_cautious=self.event.cautious)
            self._is_shaped = True

    def _answer_by(self, table: LocalizationTable, timing: Timing, *, is_cautious: bool) -> None:
        self._table, self._timing = table, timing
        self._controller.replace_answers(table, timing)
        self.event = self.event.model_copy(update={"cautious": is_cautious})

    def _end_outage(self) -> None:
        if self._outage is not None:
            self._outage.cancel()
            self._outage = None

    def _answer_cautiously(self) -> None:
        """Stop trusting what was learned, since no estimator watches the plate."""
        if self._cautious is not None and not self.event.cautious:
            timing = self._timing.following(self._cautious)
            self._answer_by(self._cautious, timing, is_cautious=True)
            self._counts["corrections"] += 1
            self._note(
                f"not watched for {CAUTIOUS_AFTER:g} s, answers are those of a plate that is not "
                "known"
            )
            self._changed(self.event)

    def _say(
        self,
        state: LearningState,
        cause: str,
        remedy: str | None = None,
        *,
        is_bad: bool = False,
        lying: tuple[float, float, float] | None = None,
    ) -> None:
        """Set state, cause, remedy and what lies there, log them and report the change."""
        found = None
        if lying is not None:
            found = PlateObject(x_m=lying[0], y_m=lying[1], mass_kg=lying[2])
        said = {"state": state, "cause": cause, "remedy": remedy, "object": found}
        self.event = self.event.model_copy(update=said)
        level = logging.WARNING if is_bad else logging.INFO
        words = LEARNING_WORDS[state]
        _logger.log(level, "plate: %s: %s", words, cause, extra={"topic": "plate"})
        self._changed(self.event)

    def _fail(self, cause: str) -> None:
        """Say why the plate is not watched; after a while answers are cautious, unless it is."""
        self._say("off", cause, _FAILED_REMEDY, is_bad=True)
        if self._outage is None:
            loop = asyncio.get_running_loop()
            self._outage = loop.call_later(CAUTIOUS_AFTER, self._answer_cautiously)

    async def _read(self) -> None:
        """Read settled patterns; report failures and start again after them."""
        while True:
            try:
                await self.readings.run()
            except Exception as error:
                _logger.exception("plate: readings failed")
                self._fail(f"readings: {failure_text(error)}; retrying every {_PAUSE:g} s")
            await asyncio.sleep(_PAUSE)
