"""The control loop: decide, send what changed, then feed the amplifiers' watchdogs."""

import asyncio
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import ParamSpec

from controller.group.amplifier_group import AmplifierGroup, GroupState
from controller.group.guards import check_watchdogs, make_guards
from controller.group.synchronized_play import Played
from controller.loop.capabilities import PlaybackCapabilities, playback_capabilities
from controller.loop.decision import RELEASE_RAMP, Decider, Decision
from controller.loop.envelopes import MAX_LOADING_TIME
from controller.loop.intent import BuzzNewestContact, IntentSource
from controller.loop.observer import Observer, applied_by, silenced_by
from controller.loop.routing import commands_by_era
from controller.loop.safe_sets import SafeSets
from controller.sources.contacts import Change
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import TouchFrame, TouchSource
from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.command import DriveCommand
from drivers.errors import CommandError, DriverError, LinkError
from drivers.guard import Guard
from drivers.operation.silence import StopOutcome
from drivers.operation.watchdog import HEARTBEAT
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.timing import Timing
from registry.plugins import failure_text

CLOSING_RAMP = 0.050  # s; not urgent, so longer than a release

# s; the loop runs even with nothing to do, for a supervisor that checks whether it is alive.
IDLE_INTERVAL = 0.5

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")


class Controller:
    """Drives the amplifiers of a rig from touch sources: open, arm, run, close.

    table: for this rig; amplifiers by name, not yet open. Starts disarmed: contacts are followed
    but nothing is sent. The loop sends the heartbeat itself after it has run, so that the watchdogs
    of the amplifiers trip when it hangs.

    intent_source: by default the newest contact buzzes where it is. timing: shapes the patterns of
    the table, ramps only without it. drive_mode: None for the best that the amplifiers can play.
    max_loading_time [s]: how long loading envelopes may delay a touch, 0 for ramps only.
    is_supervised: whether amplifiers without a watchdog are driven. watchdog [s]: of armed ones.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        amplifiers: Mapping[str, Amplifier],
        sources: Sequence[TouchSource] = (),
        observer: Observer | None = None,
        intent_source: IntentSource | None = None,
        timing: Timing | None = None,
        drive_mode: str | None = None,
        max_loading_time: float = MAX_LOADING_TIME,
        is_supervised: bool = False,
        watchdog: float = WATCHDOG,
    ) -> None:
        if amplifiers.keys() != rig.amplifiers.keys():
            raise InputError(
                f"amplifiers must be those of the rig ({', '.join(sorted(rig.amplifiers))}), got "
                f"{', '.join(sorted(amplifiers)) or 'none'}"
            )
        self._rig = rig
        self._table = table
        self._is_supervised = is_supervised
        self._amplifiers = amplifiers
        self._group = AmplifierGroup(amplifiers, watchdog=watchdog)
        self._sources = sources
        self._observer = observer or Observer()
        self._intent_source = intent_source or BuzzNewestContact()
        self._timing = timing
        self._drive_mode = drive_mode
        self._max_loading_time = max_loading_time if timing is not None else 0.0
        self._rejects = RejectCounter(_logger)
        self._decider_if_open: Decider | None = None
        self._guards: Mapping[str, Guard] = {}
        self._wake = asyncio.Event()
        self._changed_at: float | None = None  # s; until all changes are decided
        self._heartbeat_due = 0.0
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def group_state(self) -> GroupState:
        """State of all amplifiers together."""
        return self._group.state

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        return self._group.degraded

    @property
    def is_preparing(self) -> bool:
        """Whether a change of contacts is on its way to the amplifiers."""
        return self._changed_at is not None and self._group.last_sent_at < self._changed_at

    @property
    def capabilities(self) -> PlaybackCapabilities:
        """Capabilities of the open amplifiers together; raises CommandError before `open`."""
        return self._decider.capabilities

    @property
    def drive_mode(self) -> str:
        """The drive mode of questions to the table; the best possible one until `open`."""
        if self._decider_if_open is not None:
            return self._decider_if_open.capabilities.drive_mode
        return self._drive_mode or [*DRIVE_MODES][-1]

    @property
    def ramp_only_reason(self) -> str | None:
        """Why touches start along plain ramps now though the amplifiers play envelopes."""
        return self._decider.ramp_only_reason(clock.now()) if self._decider_if_open else None

    @property
    def rejected_touches(self) -> Mapping[str, int]:
        """Number of touches that could not be contacts, by reason."""
        return self._rejects.counts

    def replace_answers(self, table: LocalizationTable, timing: Timing | None) -> None:
        """Answer touches by another table of this plate from now on, in one step.

        What plays stays until its contacts change. Prepared by the caller: nothing is computed
        here.
        """
        self._table, self._timing = table, timing
        if self._decider_if_open is not None:
            self._decider_if_open.replace_answers(table, timing)

    async def open(self) -> None:
        """Open every amplifier, or none, and prepare what they can play; all stay disarmed.

        Raises LinkError, CommandError, also for one without a watchdog, and InputError for a wired
        channel that its amplifier does not have or a drive mode that one cannot play.
        """
        await self._group.open()
        try:
            if not self._is_supervised:
                check_watchdogs(self._amplifiers)
            self._guards = make_guards(self._rig, self._amplifiers, self._guards)
            decider = Decider(
                self._rig,
                self._table,
                guards=self._guards,
                capabilities=playback_capabilities(
                    self._rig,
                    self._amplifiers,
                    drive_mode=self._drive_mode,
                    max_loading_time=self._max_loading_time,
                ),
                intent_source=self._intent_source,
                timing=self._timing,
                max_loading_time=self._max_loading_time,
            )
            decider.prepare()
        except BaseException:
            await self._group.close({})
            raise
        self._decider_if_open = decider

    async def arm(self) -> None:
        """Switch the high voltage on, so that touches are felt; `run` must run or start at once."""
        decider = self._decider
        await self._group.arm()
        decider.forget()
        self._heartbeat_due = clock.now()
        self._schedule_expiry()  # fingers may have rested since before
        self._wake.set()

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        await self._group.disarm()

    async def stop(self) -> Mapping[str, StopOutcome]:
        """Quick-stop every amplifier; latched until `clear`; returns the outcome of each."""
        return await self._group.stop()

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone; nothing arms by itself."""
        await self._group.clear()

    async def close(self) -> None:
        """Ramp to zero in 50 ms, confirm it by reading back, disarm and close; ends `run`."""
        decider = self._decider_if_open
        silence = decider.silence(ramp=CLOSING_RAMP).sets if decider else {}
        self._wake.set()
        await self._group.close(silence)

    async def run(self) -> None:
        """Run the loop until `close` or cancellation; raises LinkError when an amplifier is lost.

        All others are stopped first. A source that fails or ends does not end the loop.
        While disarmed the loop sends nothing: a lost link then shows in the next request, which
        raises, and in `group_state`; the daemon's supervisor checks both.
        """
        listening = [asyncio.create_task(self._listen(source)) for source in self._sources]
        try:
            while self.group_state is not GroupState.CLOSED:
                await self.step()
                self._report(self._observer.cycle_completed)
                await self._wait_for_event()
        finally:
            if self._expiry is not None:
                self._expiry.cancel()
            for task in listening:
                task.cancel()
            await asyncio.gather(*listening, return_exceptions=True)

    async def step(self) -> None:
        """Run the loop once: decide, send what changed, then the heartbeat if it is due."""
        self._wake.clear()
        now = clock.now()
        expired = self._decider.expire(now)
        decision = self._decider.decide(now)
        is_aborted = False
        try:
            if self.group_state is GroupState.ARMED and decision is not None:
                if decision.pattern is not None and self._group.degraded:
                    self._decider.forget()  # decided again once all amplifiers reply
                else:
                    ready_at = now if decision.sets is None else max(now, decision.sets.ready_at)
                    load_until = ready_at + self._max_loading_time
                    is_aborted = not await self._execute(decision, load_until=load_until)
            elif self.group_state is GroupState.ARMED and not self._group.degraded:
                await self._renew(now)
            # The set may be incomplete then: the next cycle silences it, before the heartbeat.
            if self._is_heartbeat_due and not is_aborted and await self._group.heartbeat():
                self._heartbeat_due = clock.now() + HEARTBEAT
        except LinkError as error:
            self._report(self._observer.link_lost, str(error))
            raise
        except DriverError as error:
            self._report(self._observer.refused, str(error))
        finally:
            self._report_change(expired)
            if not self._wake.is_set():
                self._changed_at = None

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; to be called in the loop's thread."""
        # Contacts that came since the last cycle have not been decided yet.
        is_undecided = self.group_state is GroupState.ARMED and self._wake.is_set()
        change = self._decider.update(frame, keeps_taps=is_undecided)
        self._follow(change)
        for reason in change.rejected:
            self._rejects.count(reason, f"touch of {frame.source}")

    def request_update(self) -> None:
        """Query the intent source again, because its intent changed without a touch."""
        self._wake.set()

    @property
    def _is_heartbeat_due(self) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        is_time = self.group_state is GroupState.ARMED and clock.now() >= self._heartbeat_due
        return is_time and not self._decider.is_silence_pending

    @property
    def _decider(self) -> Decider:
        if self._decider_if_open is None:
            raise CommandError("controller must be open; call open() first")
        return self._decider_if_open

    def _follow(self, change: Change) -> None:
        """Act on a change of contacts, also while amplifiers are being awaited."""
        if change:
            self._wake.set()
            if self.group_state is GroupState.ARMED:
                self._changed_at = clock.now()
        if self._decider.is_silence_pending:
            self._group.abort_exchange()
        self._schedule_expiry()
        self._report_change(change)

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        A timer that is due before stays: nothing is set anew for every frame of a source.
        """
        due = self._decider.next_expiry
        if due is None or self.group_state is not GroupState.ARMED:
            due = math.inf
        if self._expiry is not None:
            if self._expiry.when() <= due < math.inf:
                return
            self._expiry.cancel()
            self._expiry = None
        if due < math.inf:
            pause = max(0.0, due - clock.now())
            self._expiry = asyncio.get_running_loop().call_later(pause, self._expire)

    def _expire(self) -> None:
        self._expiry = None
        self._follow(self._decider.expire(clock.now()))

    async def _execute(self, decision: Decision, *, load_until: float) -> bool:
        """Send the sets of a decision and report the outcome; raises DriverError.

        False if silence came in between. load_until [s]: when envelopes must be loaded.
        """
        commands: Mapping[str, DriveCommand] = {}
        sent_at = None
        if decision.sets is not None:
            played = await self._play(
                decision.sets, is_pattern=decision.pattern is not None, load_until=load_until
            )
            if played is not None and played.loading_time is not None:
                self._decider.note_loading_time(
                    played.loading_time, now=clock.now(), is_late=played.is_late
                )
            if played is not None and played.is_late:
                plain = self._decider.without_onset(decision)
                if plain is None:
                    return True
                return await self._execute(plain, load_until=load_until)
            if played is None:
                return False
            commands, sent_at = commands_by_era(played.achieved, self._rig), played.sent_at
            self._decider.confirm(commands, now=clock.now(), sent_at=sent_at)
        if decision.refusal is not None:
            self._report(self._observer.refused, decision.refusal)
        if decision.adds_endings_only:
            return True  # what is felt stays the same
        if decision.pattern is not None and sent_at is not None:
            applied = applied_by(
                decision,
                decision.pattern,
                commands=commands,
                sent_at=sent_at,
                # Bases do not follow a ramp of the voltage as is predicted.
                timing=None if self._rig.voltage else self._timing,
            )
            self._report(self._observer.pattern_applied, applied)
        else:
            silenced = silenced_by(decision, sent_at=sent_at, now=clock.now())
            self._report(self._observer.silenced, silenced)
        return True

    async def _renew(self, now: float) -> None:
        """Prolong the playback if due; raises DriverError."""
        sets = self._decider.renewal(now)
        if sets is not None and await self._play(sets, is_pattern=True) is not None:
            self._decider.confirm_renewal(sets, now=clock.now())

    async def _play(
        self, sets: SafeSets, *, is_pattern: bool, load_until: float = math.inf
    ) -> Played | None:
        """Play sets on all amplifiers; None if silence came in between."""
        played = None
        try:
            if self._group.is_set_incomplete and is_pattern:
                # Silence an incomplete set before the next pattern.
                silence = self._decider.silence(ramp=RELEASE_RAMP, before=sets)
                if await self._group.play(silence.sets) is None:
                    return None
            played = await self._group.play(
                sets.sets, envelopes=sets.envelopes, load_until=load_until
            )
        finally:
            if played is None:  # the playback is unknown now
                self._decider.forget()
        return played

    async def _listen(self, source: TouchSource) -> None:
        """Run a source; report one that fails, and leave its contacts to time out."""
        try:
            await source.run(self.deliver)
        except Exception as error:
            _logger.exception("touch source: failed")
            self._report(self._observer.source_failed, failure_text(error))

    async def _wait_for_event(self) -> None:
        """Wait for a change, a heartbeat, the timeout of a source or the expiry of an intent."""
        if self._wake.is_set():
            return
        now = clock.now()
        until, due = now + IDLE_INTERVAL, self._decider.due
        if due is not None:
            until = min(until, due)
        if self.group_state is GroupState.ARMED:
            until = min(until, self._heartbeat_due)
        pause = max(0.0, until - now)
        timer = asyncio.get_running_loop().call_later(pause, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            timer.cancel()

    def _report_change(self, change: Change) -> None:
        if change:
            self._report(self._observer.contacts_changed, self._decider.contacts, change)

    def _report(self, callback: Callable[_P, None], *args: _P.args, **kwargs: _P.kwargs) -> None:
        """Call an observer; its exceptions are only logged."""
        try:
            callback(*args, **kwargs)
        except Exception:
            _logger.exception("loop: observer failed")
