"""The control loop of a plate, and the controller that opens, arms and stops its amplifiers.

A cycle of the loop plans, sends what changes, then feeds the watchdogs of the amplifiers.
"""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, ParamSpec

from controller.play.intent import IntentSource
from controller.play.planner import Observers, Plan, Planner, play_report
from controller.play.routing import limits_of, playback_capabilities
from controller.play.slots import RELEASE_RAMP
from controller.sources.touch import Change, ContactTracker, RejectCounter, TouchFrame
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Overtaken,
    Preempted,
)
from drivers.host.amplifier import CONFIRM_TIMEOUT, WATCHDOG, Amplifier
from drivers.host.dialogue import UNREACHED, StopOutcome
from drivers.host.group import Group, GroupState
from drivers.opening import Lines
from drivers.protocol.definition import HEARTBEAT, REPLY_TIMEOUT
from model.answer.answer import Limits
from model.answer.answer_report import Timing
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.quantities import counted
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from registry import threads

# s; the loop runs even with nothing to do, for a supervisor that checks whether it is alive.
IDLE_INTERVAL = 0.5

_P = ParamSpec("_P")
_logger = logging.getLogger(__name__)


class Cycle:
    """The control loop of one plate; contacts are followed while it waits, too.

    group: all amplifiers, which are opened and armed elsewhere.
    """

    def __init__(self, plate: Plate, group: Group) -> None:
        self.group = group
        """All amplifiers together; replaced while `sending` is held."""
        self.planner: Planner | None = None
        """Plans for the amplifiers; None until they were open."""
        self.observers = Observers()
        self.tracker = ContactTracker(plate)
        """The contacts, also while no amplifier is open."""
        self.sending = asyncio.Lock()
        """Held while a turn sends."""
        self.is_closed = False
        """Whether `run` ends."""
        self.rejects = RejectCounter(_logger)
        """Counter of all rejected touches, at the sources and as contacts."""
        self.clicks_too_late = 0
        """Number of short vibrations that came too late to be felt while armed, since the start.

        They were over, or had lost their touch, before the amplifiers could play them, as under
        fingers that came and left within a cycle. Refusals by a ledger do not count.
        """
        self._plan: Plan | None = None  # that is on its way to the amplifiers
        self._wake = asyncio.Event()
        self._heartbeat_due = 0.0
        self._is_armed_anew = False  # until the next turn, which sends again what is to play
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def is_preparing(self) -> bool:
        """Whether a change of contacts is on its way to the amplifiers."""
        planner, plan = self.planner, self._plan
        if planner is None:
            return False
        if plan is not None and self.group.members.last_sent_at < plan.since:
            return True
        return planner.is_waiting

    async def run(self) -> None:
        """Run the loop until `close` or cancellation, also while amplifiers are lost or closed.

        It sends only while they are armed. A loss is reported to observers once all others are
        stopped; a loss while disarmed shows in the next request of the supervisor.
        """
        while not self.is_closed:
            await self.step()
            _report(self.observers.cycle_completed)
            await self._wait_for_event()

    async def step(self) -> None:
        """Run the loop once: plan, send what changes, then the heartbeat if it is due."""
        planner, now = self.planner, threads.now()
        self._expire(now)
        self._wake.clear()
        if planner is None:
            return
        if self._is_armed_anew:  # not amid a turn, whose set may be on the wire
            self._is_armed_anew = False
            planner.forget()
        plan = planner.plan(now)
        try:
            async with self.sending:
                with suppress(LinkDegraded):  # what plays is unknown, and planned anew; others feed
                    if plan is not None and self.group.is_armed:
                        await self._send(planner, plan)
                # Not after a set that was given up: the next cycle silences it first.
                if self._is_heartbeat_due(planner):
                    # From its beginning: the watchdog has run since its request was sent.
                    due = self._heartbeat_due = threads.now() + HEARTBEAT
                    try:
                        await self.group.beat()
                    finally:
                        if self._heartbeat_due == due:  # none replies again since
                            rest = HEARTBEAT / 2  # on a slow wire
                            self._heartbeat_due = max(due, threads.now() + rest)
        except (Preempted, LinkDegraded):
            pass  # what plays is unknown, and planned anew
        except LinkError as error:
            _report(self.observers.link_lost, str(error))
        except DriverError as error:
            _report(self.observers.refused, str(error))

    async def _send(self, planner: Planner, plan: Plan) -> None:
        """Send what a plan changes, and report the outcome; raises DriverError.

        While an amplifier is degraded nothing starts or is prolonged.
        """
        if self.group.members.degraded:
            plan = planner.only_ends(plan)
        self._plan = plan
        try:
            outcome = await self._play(planner, plan)
            if isinstance(outcome, CommandRefused):
                plan = planner.refused(plan, outcome, now=threads.now())
                outcome = await self._play(planner, plan)
        finally:
            self._plan = None
        if reason := plan.sets.reason:
            _report(self.observers.refused, reason)
        if plan.is_reported:
            sent_at = outcome if isinstance(outcome, float) else None
            applied = play_report(plan, planner.slots.contents, sent_at=sent_at, now=threads.now())
            _report(self.observers.reported, applied)

    async def _play(self, planner: Planner, plan: Plan) -> float | CommandRefused | None:
        """Play the sets of a plan on all amplifiers, from one moment on.

        Returns when [s] they start, None where nothing is sent, or the refusal. It is unknown what
        plays if anything is raised.
        """
        if not (sets := plan.sets):
            return None
        try:
            if sets.silence is not None:
                sent_at = await self.group.silence(sets.silence)
                planner.slots.may_play = frozenset()
                return sent_at
            if self.group.sets.is_in_doubt:
                await self.group.silence(RELEASE_RAMP)  # before the next pattern
            played = await self.group.apply(
                sets.by_amplifier,
                (lambda: self._wake.is_set() and threads.now() < sets.preempted_until)
                if sets.endings
                else None,
            )
        except Overtaken:  # endings, by what has come since: they follow it
            return None
        except BaseException as error:
            is_overtaken = isinstance(error, Preempted) or not self.group.is_armed
            if isinstance(error, CommandRefused) and not is_overtaken and sets.silence is None:
                return error
            planner.not_played(plan)
            raise
        planner.confirm(sets, played, now=threads.now())
        return played.starts_at

    def count_too_late(self, clicks: int) -> None:
        """Count clicks that came too late to be felt, while armed."""
        if self.group.is_armed:
            self.clicks_too_late += clicks
            _logger.warning(
                "%s came too late to be felt: replies are late", counted(clicks, "click")
            )

    def wake(self) -> None:
        """Begin the next cycle at once."""
        self._wake.set()

    def feed_at_once(self) -> None:
        """Begin the next cycle at once, and feed the watchdogs in it."""
        self._heartbeat_due = threads.now()
        self._wake.set()

    def note_armed(self, limits: Limits, *, was_armed: bool) -> None:
        """Note that the amplifiers have been armed: the next cycle sends all and feeds watchdogs.

        limits: of the amplifiers as they are now; was_armed: also before, so that what plays goes
        on. Raises CommandError without a planner.
        """
        if self.planner is None:
            raise CommandError("controller must be open; call open() first")
        self._is_armed_anew = True
        if not was_armed:
            self.planner.slots.may_play = frozenset()
        self.planner.replace_limits(limits)
        self._schedule_expiry()  # fingers may have rested since before
        self.feed_at_once()

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; to be called in the loop's thread."""
        # Contacts that came since the last cycle have not been decided yet.
        is_undecided = self._wake.is_set() and self.group.is_armed
        change = self.tracker.update(frame, keeps_taps=is_undecided)
        if change:
            self._follow(change)
        self._schedule_expiry()
        for reason in change.rejected:
            self.rejects.count(reason, f"touch of {frame.source}")

    def lift(self, prefix: str) -> None:
        """Lift the contacts of all sources whose names have a prefix; failures are only logged."""
        for source in self.tracker.sources_of(prefix):
            try:
                self.deliver(TouchFrame(source, threads.now(), ()))
            except Exception:
                _logger.exception("loop: fingers of %s not lifted", source)

    def request_update(self) -> None:
        """Query the intent source again, because its intent changed without a touch."""
        if self.planner is not None:
            self.planner.look_again()
        self._wake.set()

    def _is_heartbeat_due(self, planner: Planner) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        if not self.group.is_armed or planner.is_silence_pending:
            return False
        return threads.now() >= min(self._heartbeat_due, self.group.members.lost_from)

    def _follow(self, change: Change) -> None:
        """Act on a change of contacts, also while amplifiers are being awaited."""
        planner = self.planner
        self._wake.set()
        if change.up and planner is not None:  # else the amplifiers were never open
            planner.note_lifts(change.up)
            if planner.is_silence_pending:
                self.group.abort_exchange()
        _report(self.observers.contacts_changed, self.tracker.contacts, change)

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        A timer that is due before stays: nothing is set anew for every frame of a source.
        """
        due = self.tracker.next_expiry
        if self._expiry is not None:
            if self._expiry.when() <= due < math.inf:
                return
            self._expiry.cancel()
            self._expiry = None
        if due < math.inf:
            pause = max(0.0, due - threads.now())
            self._expiry = asyncio.get_running_loop().call_later(pause, self._time_out)

    def _time_out(self) -> None:
        self._expiry = None
        self._expire(threads.now())
        self._schedule_expiry()

    def _expire(self, now: float) -> None:
        """Lift contacts that no source has confirmed in time; called before every plan."""
        if (change := self.tracker.expire(now)).up:
            self._follow(change)

    async def _wait_for_event(self) -> None:
        """Wait for a change, a heartbeat, or the expiry of an intent."""
        if self._wake.is_set():
            return
        now = threads.now()
        until = now + IDLE_INTERVAL
        if self.planner is not None:
            until = min(until, self.planner.due)
        if self.group.is_armed:
            until = min(until, self._heartbeat_due, self.group.members.lost_from)
            if self.planner is not None and now < (due := self.planner.slots.ending_due):
                until = min(until, due)
        pause = max(0.0, until - now)
        timer = asyncio.get_running_loop().call_later(pause, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            timer.cancel()


def _report(callbacks: Iterable[Callable[_P, object]], *args: _P.args, **kwargs: _P.kwargs) -> None:
    """Call all observers of an event; log their exceptions."""
    for callback in callbacks:
        try:
            callback(*args, **kwargs)
        except Exception:
            _logger.exception("loop: observer failed")


CLOSING_RAMP = 0.050  # s; not urgent, so longer than a release


class Controller:
    """Drives the amplifiers of a rig by touch frames: open, arm, run its `cycle`, close.

    It starts disarmed: contacts are followed but nothing is sent. The loop sends the heartbeat
    itself after it has run, so that the watchdogs of the amplifiers trip when it hangs.

    table: for this rig; lines: makes the lines to its amplifiers, anew for each opening;
    intent_source: says what contacts shall feel; timing: shapes the patterns of the table; urls,
    serial_numbers: by amplifier name; drive_mode: None for the best that the amplifiers can play;
    connected: called with all amplifiers when their lines are open; watchdog [s]: of armed ones.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        lines: Callable[[Lines | None], Lines],
        intent_source: IntentSource,
        timing: Timing,
        urls: Mapping[str, str] | None = None,
        serial_numbers: Mapping[str, str] | None = None,
        drive_mode: str | None = None,
        connected: Callable[[Mapping[str, Amplifier]], None] = lambda amplifiers: None,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.cycle = Cycle(rig.plate, Group({}, watchdog=watchdog))
        """The control loop."""
        self._rig, self._intent_source, self._timing = rig, intent_source, timing
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
        self._before: Lines | None = None  # the last ones, also once they are closed
        self._opened: dict[str, Amplifier] = {}  # last, identified or not
        self._owed: dict[str, asyncio.Future[Awaitable[Mapping[str, StopOutcome]]]] = {}  # stops
        self._serial_numbers = dict(serial_numbers or {})
        self._connected = connected
        self.watchdog = watchdog
        """Watchdog of armed amplifiers [s]."""
        self.amplifiers: dict[str, Amplifier] = {}
        """Amplifiers by name, as identified last; empty before."""
        self._drive_mode = drive_mode

    @property
    def group(self) -> Group:
        """All amplifiers together."""
        return self.cycle.group

    @property
    def is_released(self) -> bool:
        """Whether all lines are closed."""
        return self._lines is None

    @property
    def drive_mode(self) -> str:
        """The drive mode of questions to the table; the best possible one until `open`."""
        if self.cycle.planner is not None:
            return self.cycle.planner.capabilities.drive_mode
        return self._drive_mode or DRIVE_MODES[-1]

    def replace_answers(self, table: LocalizationTable, timing: Timing) -> None:
        """Answer touches by another table of this plate from now on, in one step.

        What plays is kept until its contacts change or rest. The caller prepares the table: nothing
        is computed here.
        """
        self.table, self._timing = table, timing
        if self.cycle.planner is not None:
            self.cycle.planner.replace_answers(table, timing)

    async def open(self) -> None:
        """Open every amplifier, or none, and prepare what they can play; all stay disarmed.

        A stop reaches each as soon as its line is open, whatever becomes of the others.
        An amplifier that was open before must have the serial number that it had, and keeps the
        vibrations that its limits over time count. Raises LinkError, CommandError, and InputError
        for a wired channel that its amplifier does not have or a drive mode that one cannot play.
        After a LinkError the lines stay open for the next attempt, until `release`: a board may
        restart whenever its port is opened.
        """
        cycle = self.cycle
        cycle.is_closed = False
        if self._lines is None or self._lines.is_closing:
            self._lines = self._before = self._make_lines(self._before)
        lines = self._lines
        try:
            async with cycle.sending:  # to those of before
                cycle.group = Group(
                    self._opened, watchdog=self.watchdog, restored=cycle.feed_at_once
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
            planner = Planner(
                self._rig,
                self.table,
                tracker=cycle.tracker,
                capabilities=playback_capabilities(
                    self._rig, amplifiers, drive_mode=self._drive_mode
                ),
                intent_source=self._intent_source,
                timing=self._timing,
                check=self.group.sets.refusal_of,
                arrived=cycle.request_update,
                too_late=cycle.count_too_late,
                clock_errors=lambda: self.group.clock_errors,
            )
            await asyncio.to_thread(planner.prepare)  # seconds, of a large rig
        except BaseException as error:
            if not isinstance(error, LinkError):
                await self.release()
            raise
        cycle.planner = planner

    async def _amplifier(self, lines: Lines, name: str) -> Amplifier:
        """Open the line of an amplifier, and send the stop that it is owed.

        An amplifier whose line is open since another attempt is kept, with a stop in progress.
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
        """Switch the high voltage on, so that touches are felt; `cycle` runs or starts at once."""
        was_armed = self.group.is_armed
        await self.group.arm()
        self.cycle.note_armed(limits_of(self._rig, self.amplifiers), was_armed=was_armed)

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        await self.group.disarm()

    def stop(self) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
        """Quick-stop every amplifier on an open line; latched until `clear`; see `Group.stop`."""
        return self.group.stop()

    def stop_all(self) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
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
        stopping: Awaitable[Mapping[str, StopOutcome]],
        owed: Mapping[str, asyncio.Future[Awaitable[Mapping[str, StopOutcome]]]],
    ) -> Mapping[str, StopOutcome]:
        if owed:
            await asyncio.wait(owed.values(), timeout=CONFIRM_TIMEOUT)
        outcomes = {**await stopping}
        self._owe()  # what was lost meanwhile
        for opened in owed.values():
            if opened.done():
                outcomes |= await opened.result()
        return {name: outcomes.get(name, self.what_may_play(name)) for name in self.urls}

    def what_may_play(self, name: str, cause: str = "") -> StopOutcome:
        """Return what an amplifier may be playing; cause: why no more is known."""
        opened = self._opened.get(name)
        return UNREACHED if opened is None else opened.what_may_play(cause)

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause is gone; nothing arms by itself."""
        await self.group.clear()

    async def close(self) -> None:
        """Release the amplifiers, and end the cycle."""
        self.cycle.is_closed = True
        self.cycle.wake()
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


async def _identified(
    amplifiers: Sequence[Amplifier], stopping: Awaitable[Mapping[str, StopOutcome]]
) -> Mapping[str, StopOutcome]:
    """Await a stop, and identify amplifiers meanwhile: an unknown one confirms nothing."""
    for each in amplifiers:
        each.capabilities = {}
    requests = [each.identify(timeout=REPLY_TIMEOUT) for each in amplifiers]
    identifying = asyncio.gather(*requests, return_exceptions=True)
    try:
        return await stopping
    finally:
        identifying.cancel()
