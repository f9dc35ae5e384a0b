"""The control loop: decide, send what changed, then feed the amplifiers' watchdogs."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from typing import Any

from controller.play.capabilities import playback_capabilities
from controller.play.decision import RELEASE_RAMP, Decider, Decision
from controller.play.intent import IntentSource
from controller.play.observer import Observer, applied_by, silenced_by
from controller.play.routing import PlateSet
from controller.sources.contacts import Change, ContactTracker
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import TouchFrame
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Preempted,
)
from drivers.host.amplifier import CONFIRM_TIMEOUT, WATCHDOG, Amplifier
from drivers.host.feeding import UNREACHED, Stopped
from drivers.host.group import Group, GroupState
from drivers.host.joint_sets import Played
from drivers.opening import Lines
from drivers.protocol.timing import HEARTBEAT, REPLY_TIMEOUT
from model.answer.timing import Timing
from model.counting import counted
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import clock

CLOSING_RAMP = 0.050  # s; not urgent, so longer than a release

# s; the loop runs even with nothing to do, for a supervisor that checks whether it is alive.
IDLE_INTERVAL = 0.5

_logger = logging.getLogger(__name__)


class Controller:
    """Drives the amplifiers of a rig by touch frames: open, arm, run, close.

    table: for this rig; lines: makes the lines to its amplifiers, anew for each opening; urls and
    expected serial numbers by amplifier name. Starts disarmed: contacts are followed but nothing is
    sent. The loop sends the heartbeat itself after it has run, so that the watchdogs of the
    amplifiers trip when it hangs.

    intent_source: what contacts shall feel. timing: shapes the patterns of the table. drive_mode:
    None for the best that the amplifiers can play.
    connected: called with all amplifiers when their lines are open. watchdog [s]: of armed ones.
    observers: called in order.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        lines: Callable[[], Lines],
        intent_source: IntentSource,
        timing: Timing,
        urls: Mapping[str, str] | None = None,
        serial_numbers: Mapping[str, str] | None = None,
        observer: Observer = Observer(),  # noqa: B008  frozen
        drive_mode: str | None = None,
        connected: Callable[[Mapping[str, Amplifier]], None] = lambda amplifiers: None,
        watchdog: float = WATCHDOG,
    ) -> None:
        self._rig = rig
        self.table = table
        """The table that answers."""
        self.urls = dict(rig.amplifiers if urls is None else urls)
        if self.urls.keys() != rig.amplifiers.keys():
            raise InputError(
                f"amplifiers must be those of the rig ({', '.join(sorted(rig.amplifiers))}), got "
                f"{', '.join(sorted(self.urls)) or 'none'}"
            )
        self._make_lines = lines
        self._lines: Lines | None = None  # also after an attempt to open that has failed
        self._opened: dict[str, Amplifier] = {}  # last, identified or not
        self._owed: dict[str, asyncio.Future[Awaitable[Mapping[str, Stopped]]]] = {}  # stops
        self._serial_numbers = dict(serial_numbers or {})
        self._connected = connected
        self.watchdog = watchdog
        """Watchdog of armed amplifiers [s]."""
        self.group = Group({}, watchdog=watchdog)
        """All amplifiers together."""
        self.amplifiers: dict[str, Amplifier] = {}
        """Amplifiers by name, as identified last; empty before."""
        self.observers = [observer]
        self._intent_source = intent_source
        self._timing = timing
        self._drive_mode = drive_mode
        self._tracker = ContactTracker(rig.plate)  # also while no amplifier is open
        self.rejects = RejectCounter(_logger)
        """What of touches was rejected, at the sources and as contacts: the only such counter."""
        self.clicks_too_late = 0
        """Short vibrations that came too late to be felt while armed, since the start.

        They were over, or had lost their touch, before the amplifiers were to play them; with
        fingers that had left before they were looked at. Not what a ledger refuses, or neighbours
        do not allow.
        """
        self._decider_if_open: Decider | None = None
        self._wake = asyncio.Event()
        self._changed_at = -math.inf  # s; of the last change, until all are decided
        self._heartbeat_due = 0.0
        self._sending = asyncio.Lock()  # held while a turn sends
        self._is_closed = False
        self._is_armed_anew = False  # until the next turn, which sends again what is to play
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def is_released(self) -> bool:
        """Whether all lines are closed."""
        return self._lines is None

    @property
    def is_preparing(self) -> bool:
        """Whether a change of contacts is on its way to the amplifiers."""
        if self._decider_if_open is not None and self._decider_if_open.is_choosing:
            return True
        return self.group.members.last_sent_at < self._changed_at

    @property
    def drive_mode(self) -> str:
        """The drive mode of questions to the table; the best possible one until `open`."""
        if self._decider_if_open is not None:
            return self._decider_if_open.capabilities.drive_mode
        return self._drive_mode or DRIVE_MODES[-1]

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Answer touches by another table of this plate from now on, in one step.

        What plays stays until its contacts change. Prepared by the caller: nothing is computed
        here.
        """
        self.table, self._timing = table, timing
        if self._decider_if_open is not None:
            self._decider_if_open.replace_answers(table, timing)

    async def open(self) -> None:
        """Open every amplifier, or none, and prepare what they can play; all stay disarmed.

        A stop reaches each as soon as its line is open, whatever becomes of the others.
        An amplifier that was open before must have the serial number that it had, and keeps the
        vibrations that its limits over time count. Raises LinkError, CommandError, and InputError
        for a wired channel that its amplifier does not have or a drive mode that one cannot play.
        After a LinkError the lines stay open for the next attempt, until `release`: a board may
        restart whenever its port is opened.
        """
        self._is_closed = False
        if self._lines is None or self._lines.is_closing:
            self._lines = self._make_lines()
        lines = self._lines
        try:
            async with self._sending:  # to those of before
                self.group = Group(
                    self._opened, watchdog=self.watchdog, restored=self._feed_at_once
                )
            opening = [self._amplifier(lines, name) for name in self.urls]
            results = await asyncio.gather(*opening, return_exceptions=True)
            by_name = zip(self.urls, results, strict=True)
            lost = {name: each for name, each in by_name if isinstance(each, LinkError)}
            for error in lost.values():
                error.lost = tuple(lost)
            opened = self.group.members.checked(results)
            amplifiers = dict(zip(self.urls, opened, strict=True))
            self._connected(amplifiers)
            await self.group.open()
            for name, amplifier in amplifiers.items():
                self._serial_numbers[name] = amplifier.identity["serial_number"]
                if name in self.amplifiers:
                    amplifier.ledger.go_on_from(self.amplifiers[name].ledger)
                self.amplifiers[name] = amplifier
            decider = Decider(
                self._rig,
                self.table,
                tracker=self._tracker,
                capabilities=playback_capabilities(
                    self._rig, amplifiers, drive_mode=self._drive_mode
                ),
                intent_source=self._intent_source,
                timing=self._timing,
                arrived=self._wake.set,
                too_late=self._count_too_late,
            )
            await asyncio.to_thread(decider.prepare)  # seconds, of a large rig
        except BaseException as error:
            if not isinstance(error, LinkError):
                await self.release()
            raise
        self._decider_if_open = decider

    async def _amplifier(self, lines: Lines, name: str) -> Amplifier:
        """Open the line of an amplifier, and send the stop that it is owed.

        One whose line is open since another attempt is the same, as is a stop of it that goes on.
        Raises LinkError, CommandError.
        """
        before = amplifier = self._opened.get(name)
        if amplifier is None or amplifier.line.loss is not None:
            amplifier = await lines.amplifier(
                self.urls[name],
                self._rig.limits,
                name=name,
                serial_number=self._serial_numbers.get(name),
                is_output=name in self._rig.outputs,
            )
            if before is not None:
                amplifier.go_on_from(before)
        self._opened[name] = self.group.amplifiers[name] = amplifier
        if name in self._owed:
            stopping = _identified([amplifier], self.group.stop(waits_for=[name]))
            self._owed.pop(name).set_result(asyncio.ensure_future(stopping))
        return amplifier

    async def arm(self) -> None:
        """Switch the high voltage on, so that touches are felt; `run` must run or start at once."""
        was_armed = self.group.is_armed
        await self.group.arm()
        self._is_armed_anew = True
        if not was_armed:  # else what plays goes on
            self._decider.playing.may_play = frozenset()
        self._heartbeat_due = clock.now()
        self._schedule_expiry()  # fingers may have rested since before
        self._wake.set()

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        await self.group.disarm()

    def stop(self) -> Coroutine[Any, Any, Mapping[str, Stopped]]:
        """Quick-stop every amplifier on an open line; latched until `clear`; see `Group.stop`."""
        return self.group.stop()

    def stop_all(self) -> Coroutine[Any, Any, Mapping[str, Stopped]]:
        """Quick-stop every amplifier, those whose lines are closed as soon as they are opened.

        The requests on open lines are queued when this returns. Await it for what is known of each,
        by name: of one whose line is opened within 0.3 s by its reply.
        """
        stopping = self.group.stop()
        if self.group.state is GroupState.CLOSED:  # who replies on open lines is not known for sure
            opened = [each for each in self.group.amplifiers.values() if each.line.loss is None]
            stopping = _identified(opened, stopping)
        self._owe()
        return self._stopped(asyncio.ensure_future(stopping), {**self._owed})

    def _owe(self) -> None:
        """Owe a stop to each amplifier whose line is closed."""
        for name in self.urls:
            amplifier = self.group.amplifiers.get(name)
            if amplifier is None or amplifier.line.loss is not None:
                self._owed.setdefault(name, asyncio.get_running_loop().create_future())

    async def _stopped(
        self,
        stopping: Awaitable[Mapping[str, Stopped]],
        owed: Mapping[str, asyncio.Future[Awaitable[Mapping[str, Stopped]]]],
    ) -> Mapping[str, Stopped]:
        if owed:
            await asyncio.wait(owed.values(), timeout=CONFIRM_TIMEOUT)
        outcomes = {**await stopping}
        self._owe()  # what was lost meanwhile
        for opened in owed.values():
            if opened.done():
                outcomes |= await opened.result()
        return {name: outcomes.get(name, self.what_may_play(name)) for name in self.urls}

    def what_may_play(self, name: str, cause: str = "") -> Stopped:
        """What an amplifier may play as far as is known; cause: why no more is; see there."""
        opened = self._opened.get(name)
        return UNREACHED if opened is None else opened.what_may_play(cause)

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone; nothing arms by itself."""
        await self.group.clear()

    async def close(self) -> None:
        """Release the amplifiers, and end `run`."""
        self._is_closed = True
        self._wake.set()
        await self.release()

    async def release(self) -> None:
        """Ramp to zero in 50 ms, confirm it by reading back, disarm and close all lines."""
        lines = self._lines  # those of now: others may be opened meanwhile
        if lines is not None:
            lines.is_closing = True
        try:
            await self.group.close(CLOSING_RAMP)
        finally:
            try:
                if lines is not None:
                    await lines.close()
            finally:
                if self._lines is lines:
                    self._lines = None

    async def run(self) -> None:
        """Run the loop until `close` or cancellation, also while amplifiers are lost or closed.

        It sends only while they are armed. An observer is told of a loss, all others are stopped
        by then; a loss while disarmed shows in the next request, as the supervisor checks.
        """
        while not self._is_closed:
            await self.step()
            self._report(lambda each: each.cycle_completed())
            await self._wait_for_event()

    async def step(self) -> None:
        """Run the loop once: decide, send what changed, then the heartbeat if it is due."""
        self._wake.clear()
        decider = self._decider_if_open
        if decider is None:
            return
        now = clock.now()
        if self._is_armed_anew:  # not amid a turn, whose set may be on the wire
            self._is_armed_anew = False
            decider.forget()
        if (expired := self._tracker.expire(now)).up:
            decider.note(now, expired)
        decision = decider.decide(now)
        try:
            async with self._sending:
                with suppress(LinkDegraded):  # what plays is unknown, and decided anew; others feed
                    await self._send(decider, decision, now)
                # Not after a set that was given up: the next cycle silences it first.
                if self._is_heartbeat_due:
                    # From its beginning: the watchdog has run since its request was sent.
                    due = self._heartbeat_due = clock.now() + HEARTBEAT
                    try:
                        await self.group.beat()
                    finally:
                        if self._heartbeat_due == due:  # none replies again since
                            rest = HEARTBEAT / 2  # on a slow wire
                            self._heartbeat_due = max(due, clock.now() + rest)
        except (Preempted, LinkDegraded):
            pass  # what plays is unknown, and decided anew
        except LinkError as error:
            lost = str(error)
            self._report(lambda each: each.link_lost(lost))
        except DriverError as error:
            reason = str(error)
            self._report(lambda each: each.refused(reason))
        finally:
            if expired.up:
                self._report(lambda each: each.contacts_changed(self._tracker.contacts, expired))
            if not self._wake.is_set():
                self._changed_at = -math.inf

    async def _send(self, decider: Decider, decision: Decision | None, now: float) -> None:
        """Send what a decision at a time [s] changes, or what is due by itself; raises DriverError.

        Sends nothing unless the amplifiers are armed.
        """
        if not self.group.is_armed:
            return
        if decision is None:
            if now >= decider.playing.due:
                await self._go_on(decider, now)
        elif decision.started and self.group.members.degraded:
            await self._end_only(decider, decision)
        else:
            await self._execute(decider, decision)

    def _count_too_late(self, clicks: int) -> None:
        if self.group.is_armed:
            self.clicks_too_late += clicks
            _logger.warning(
                "%s came too late to be felt: replies are late", counted(clicks, "click")
            )

    def _feed_at_once(self) -> None:
        self._heartbeat_due = clock.now()
        self._wake.set()

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; to be called in the loop's thread."""
        # Contacts that came since the last cycle have not been decided yet.
        is_undecided = self.group.is_armed and self._wake.is_set()
        change = self._tracker.update(frame, keeps_taps=is_undecided)
        if change:
            self._follow(change, frame.time)
        self._schedule_expiry()
        for reason in change.rejected:
            self.rejects.count(reason, f"touch of {frame.source}")

    def lift(self, prefix: str) -> None:
        """Lift the fingers of all sources whose names begin so, whatever fails at one of them."""
        for source in self._tracker.sources_of(prefix):
            try:
                self.deliver(TouchFrame(source, clock.now(), ()))
            except Exception:
                _logger.exception("loop: fingers of %s not lifted", source)

    def request_update(self) -> None:
        """Query the intent source again, because its intent changed without a touch."""
        if self._decider_if_open is not None:
            self._decider_if_open.look_again()
        self._wake.set()

    @property
    def _is_heartbeat_due(self) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        if not self.group.is_armed or self._decider.is_silence_pending:
            return False
        return clock.now() >= min(self._heartbeat_due, self.group.members.lost_from)

    @property
    def _decider(self) -> Decider:
        if self._decider_if_open is None:
            raise CommandError("controller must be open; call open() first")
        return self._decider_if_open

    def _follow(self, change: Change, time: float) -> None:
        """Act on a change of contacts at a time [s], also while amplifiers are being awaited."""
        decider = self._decider_if_open
        if decider is not None:  # else the amplifiers were never open
            decider.note(time, change)
        self._wake.set()
        if self.group.is_armed:
            self._changed_at = clock.now()
        if decider is not None and decider.is_silence_pending:
            self.group.abort_exchange()
        self._report(lambda each: each.contacts_changed(self._tracker.contacts, change))

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        A timer that is due before stays: nothing is set anew for every frame of a source.
        """
        due = self._tracker.next_expiry
        if self._expiry is not None:
            if self._expiry.when() <= due < math.inf:
                return
            self._expiry.cancel()
            self._expiry = None
        if due < math.inf:
            pause = max(0.0, due - clock.now())
            self._expiry = asyncio.get_running_loop().call_later(pause, self._expire)

    def _expire(self) -> None:
        self._expiry, now = None, clock.now()
        if (change := self._tracker.expire(now)).up:
            self._follow(change, now)
        self._schedule_expiry()

    async def _go_on(self, decider: Decider, now: float) -> None:
        """Prolong the layers that are due, and report those that have ended; raises DriverError."""
        due = {} if self.group.members.degraded else decider.renewal(now)
        if due:
            decider.playing.renewed(due, await self._play(decider, due), now=clock.now())
        if (ended := decider.ended(now)) is not None:
            self._report_playing(decider, ended, sent_at=None)

    async def _end_only(self, decider: Decider, decision: Decision) -> None:
        """End what a decision ends, unreported, and start nothing; raises DriverError."""
        ends = decider.only_ends(decision)
        if ends.sets:
            played = await self._play(decider, ends.sets)
            if isinstance(played, CommandRefused):
                raise played
            decider.confirm(ends, played, now=clock.now())

    async def _execute(self, decider: Decider, decision: Decision) -> None:
        """Send the sets of a decision and report the outcome; raises DriverError."""
        sent_at = None
        if decision.silence is not None:
            sent_at = await self._silence(decider, decision.silence)
        elif decision.sets:
            played = await self._play(decider, decision.sets)
            if isinstance(played, CommandRefused):
                instead = decider.refused(decision, played, now=clock.now())
                await self._execute(decider, instead)
                return
            sent_at = played.sent_at
            decider.confirm(decision, played, now=clock.now())
        refusal = decision.refusal
        if refusal is not None:
            self._report(lambda each: each.refused(refusal))
        self._report_playing(decider, decision, sent_at=sent_at)

    def _report_playing(
        self, decider: Decider, decision: Decision, *, sent_at: float | None
    ) -> None:
        """Report what plays after a decision, or silence; sent_at [s]: None if nothing was sent."""
        if decision.selection.contents and decision.silence is None:
            applied = applied_by(
                decision,
                decider.playing.contents,
                sent_at=sent_at,
                now=clock.now(),
                timing=self._timing,
            )
            self._report(lambda each: each.pattern_applied(applied))
            return
        silenced = silenced_by(decision, sent_at=sent_at, now=clock.now())
        self._report(lambda each: each.silenced(silenced))

    async def _silence(self, decider: Decider, ramp: float) -> float:
        """Silence all layers of all amplifiers; returns when [s] that was sent."""
        try:
            sent_at = await self.group.silence(ramp)
        except BaseException:
            decider.forget()
            raise
        decider.playing.may_play = frozenset()
        return sent_at

    async def _play(
        self, decider: Decider, sets: Mapping[int, PlateSet]
    ) -> Played | CommandRefused:
        """Play the sets of layers on all amplifiers, from one moment on, or say why not.

        Whatever is raised instead leaves it unknown what plays.
        """
        try:
            if self.group.sets.is_incomplete:
                await self.group.silence(RELEASE_RAMP)  # before the next pattern
            layers = {
                name: [each.layers[name] for each in sets.values()] for name in self._rig.amplifiers
            }
            return await self.group.apply(layers)
        except BaseException as error:
            is_overtaken = isinstance(error, Preempted) or not self.group.is_armed
            if isinstance(error, CommandRefused) and not is_overtaken:
                return error
            decider.forget()
            raise

    async def _wait_for_event(self) -> None:
        """Wait for a change, a heartbeat, the timeout of a source or the expiry of an intent."""
        if self._wake.is_set():
            return
        now = clock.now()
        until = min(now + IDLE_INTERVAL, self._tracker.next_expiry)
        if self._decider_if_open is not None:
            until = min(until, self._decider_if_open.due)
        if self.group.is_armed:
            until = min(until, self._heartbeat_due, self.group.members.lost_from)
        pause = max(0.0, until - now)
        timer = asyncio.get_running_loop().call_later(pause, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            timer.cancel()

    def _report(self, event: Callable[[Observer], None]) -> None:
        """Report an event to all observers; their exceptions are only logged."""
        for observer in self.observers:
            try:
                event(observer)
            except Exception:
                _logger.exception("loop: observer failed")


async def _identified(
    amplifiers: Sequence[Amplifier], stopping: Awaitable[Mapping[str, Stopped]]
) -> Mapping[str, Stopped]:
    """Await a stop, and identify amplifiers meanwhile: an unknown one confirms nothing."""
    for each in amplifiers:
        each.capabilities = {}
    requests = [each.identify(timeout=REPLY_TIMEOUT) for each in amplifiers]
    identifying = asyncio.gather(*requests, return_exceptions=True)
    try:
        return await stopping
    finally:
        identifying.cancel()
