"""The control loop: from touch frames to the amplifiers, and a heartbeat while it is alive."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import ParamSpec

from controller.group.amplifier_group import AmplifierGroup, Phase
from controller.group.guards import make_guards
from controller.loop.capabilities import PlaybackCapabilities, playback_capabilities
from controller.loop.decision import RELEASE_RAMP, Decider, Decision
from controller.loop.envelopes import ENVELOPE_TIME
from controller.loop.intent import IntentSource, NewestBuzzes
from controller.loop.observer import Observer, applied_by, silenced_by
from controller.loop.orders import Order, PatternTiming
from controller.loop.routing import drive_of_eras
from controller.loop.selection import PatternTable
from controller.sources.contacts import Change
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import TouchFrame, TouchSource
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import DriveCommand
from drivers.errors import CommandError, DriverError, LinkError
from drivers.operation.watchdog import HEARTBEAT
from model.errors import InputError
from model.rig.rig import Rig
from registry.plugins import failure_text

# On an orderly end nobody waits, so the end is soft.
CLOSING_RAMP = 0.050

# With nothing to do the loop runs all the same, for whoever watches whether it still does.
IDLE_TURN = 0.5

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")


class Controller:
    """Drives the amplifiers of a rig by what touch sources say: open, arm, run, close.

    table must be for this rig; amplifiers by their names in it, not yet open. Starts disarmed: then
    contacts are followed but nothing is sent. The heartbeat is sent by the loop itself after it has
    run, so that a loop that hangs lets the amplifiers' watchdogs trip.

    intent_source: who feels what; by default the newest contact buzzes where it is. timing: what
    shapes the table's patterns; ramps only without it. drive_mode: that of the patterns, None for
    the best that the amplifiers can play. envelope_time [s]: how long loading envelopes may hold up
    a touch, 0 for ramps only.
    """

    def __init__(
        self,
        rig: Rig,
        table: PatternTable,
        *,
        amplifiers: Mapping[str, Amplifier],
        sources: Sequence[TouchSource] = (),
        observer: Observer | None = None,
        intent_source: IntentSource | None = None,
        timing: PatternTiming | None = None,
        drive_mode: str | None = None,
        envelope_time: float = ENVELOPE_TIME,
    ) -> None:
        if amplifiers.keys() != rig.amplifiers.keys():
            raise InputError(
                f"the rig names the amplifiers {', '.join(sorted(rig.amplifiers))}, but given are "
                f"{', '.join(sorted(amplifiers)) or 'none'}"
            )
        self._rig = rig
        self._table = table
        self._amplifiers = amplifiers
        self._group = AmplifierGroup(amplifiers)
        self._sources = sources
        self._observer = observer or Observer()
        self._intent_source = intent_source or NewestBuzzes()
        self._timing = timing
        self._drive_mode = drive_mode
        self._envelope_time = envelope_time if timing is not None else 0.0
        self._tally = RejectCounter(_logger)
        self._opened_decider: Decider | None = None
        self._wake = asyncio.Event()
        self._heartbeat_due = 0.0
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def phase(self) -> Phase:
        """How the amplifiers stand."""
        return self._group.phase

    @property
    def capabilities(self) -> PlaybackCapabilities:
        """What the opened amplifiers can play together; raises CommandError before `open`."""
        return self._decider.capabilities

    @property
    def plain_because(self) -> str | None:
        """Why touches begin along plain ramps just now though the amplifiers play envelopes."""
        return self._decider.plain_because(clock.now()) if self._opened_decider else None

    @property
    def rejected_touches(self) -> Mapping[str, int]:
        """How many touches could not be contacts, by the reason."""
        return self._tally.counts

    async def open(self) -> None:
        """Open every amplifier and prepare what they can play; all stay disarmed.

        Raises LinkError, CommandError, and InputError if the rig wires a channel that an amplifier
        has not or one cannot play the mode; then none stays open.
        """
        await self._group.open()
        try:
            decider = Decider(
                self._rig,
                self._table,
                guards=make_guards(self._rig, self._amplifiers),
                capabilities=playback_capabilities(
                    self._rig,
                    self._amplifiers,
                    drive_mode=self._drive_mode,
                    envelope_time=self._envelope_time,
                ),
                intent_source=self._intent_source,
                timing=self._timing,
                envelope_time=self._envelope_time,
            )
            decider.prepare()
        except BaseException:
            await self._group.close({})
            raise
        self._opened_decider = decider

    async def arm(self) -> None:
        """High voltage on; from now on touches are felt. `run` must be running or start at once."""
        decider = self._decider
        await self._group.arm()
        decider.forget()
        self._heartbeat_due = clock.now()
        self._watch_leases()  # from now on: fingers may have rested since before
        self._wake.set()

    async def disarm(self) -> None:
        """Silent along a short ramp, then high voltage off."""
        await self._group.disarm()

    async def stop(self) -> None:
        """Quick stop of every amplifier that can be reached; latched until `clear`."""
        await self._group.stop()

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause is gone; nothing arms by itself."""
        await self._group.clear()

    async def close(self) -> None:
        """Ramp to zero in 50 ms, confirm it by reading back, disarm and close; ends `run`."""
        decider = self._opened_decider
        silence = decider.silence(ramp=CLOSING_RAMP).commands if decider else {}
        self._wake.set()
        await self._group.close(silence)

    async def run(self) -> None:
        """Run the loop until `close` or cancellation; raises LinkError when an amplifier is lost.

        By then all others have been stopped. A source that fails or ends does not end the loop.
        While they are disarmed nothing is asked of them here: a link that is lost then shows in
        what is asked next, which raises, and in `phase`; the daemon's supervisor looks at both.
        """
        listening = [asyncio.create_task(self._listen(source)) for source in self._sources]
        try:
            while self.phase is not Phase.CLOSED:
                await self.step()
                self._tell(self._observer.turned)
                await self._next_cause()
        finally:
            if self._expiry is not None:
                self._expiry.cancel()
            for task in listening:
                task.cancel()
            await asyncio.gather(*listening, return_exceptions=True)

    async def step(self) -> None:
        """One turn of the loop: decide, send what is new, then the heartbeat if it is due."""
        self._wake.clear()
        decision = self._decider.decide(clock.now())
        for change in decision.changes:
            self._tell(self._observer.contacts_changed, decision.contacts, change)
        try:
            if self.phase is Phase.ARMED and (decision.is_new or decision.order is not None):
                await self._carry_out(decision)
            if self._is_heartbeat_due and await self._group.heartbeat():
                self._heartbeat_due = clock.now() + HEARTBEAT
        except LinkError as error:
            self._tell(self._observer.link_lost, str(error))
            raise
        except DriverError as error:
            self._tell(self._observer.refused, str(error))

    def deliver(self, frame: TouchFrame) -> None:
        """Take over a touch frame; to be called in the loop's thread."""
        change = self._decider.take(frame)
        for reason in change.rejected:
            self._tally.count(reason, f"touch of {frame.source}")
        self._follow(change)

    def reconsider(self) -> None:
        """Ask for intents again, for they are others though no contact has changed."""
        self._wake.set()

    @property
    def _is_heartbeat_due(self) -> bool:
        """Whether the amplifiers are to be told that the loop has run; silence goes before that."""
        is_time = self.phase is Phase.ARMED and clock.now() >= self._heartbeat_due
        return is_time and not self._decider.owes_silence

    @property
    def _decider(self) -> Decider:
        """What decides; raises CommandError before `open`."""
        if self._opened_decider is None:
            raise CommandError("the controller is not open yet; call open() first")
        return self._opened_decider

    def _follow(self, change: Change) -> None:
        """See to what follows from a change, also while the amplifiers are being waited for."""
        if change:
            self._wake.set()
        if self._decider.owes_silence:
            self._group.abort_unsent()
        self._watch_leases()

    def _watch_leases(self) -> None:
        """Look again when the next source is overdue."""
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        due = self._decider.next_expiry
        if due is not None and self.phase is Phase.ARMED:
            pause = max(0.0, due - clock.now())
            self._expiry = asyncio.get_running_loop().call_later(pause, self._expire)

    def _expire(self) -> None:
        """A source may be overdue."""
        self._follow(self._decider.expire(clock.now()))

    async def _carry_out(self, decision: Decision) -> None:
        """Send the commands of a decision and tell what came of them; raises DriverError."""
        drive: Mapping[str, DriveCommand] | None = {}
        if decision.order is not None:
            drive = await self._play(decision.order)
        if drive is not None:
            self._tell_outcome(decision, drive)

    async def _play(self, order: Order) -> Mapping[str, DriveCommand] | None:
        """Have an order played; what plays then, by ERA. None if silence came in between."""
        achieved = None
        try:
            if self._group.is_set_incomplete and order.pattern is not None:
                # Half of a set is none: silence goes before whatever shall be played instead.
                silence = self._decider.silence(ramp=RELEASE_RAMP).commands
                if await self._group.play(silence) is None:
                    return None
            achieved = await self._group.play(order.commands, envelopes=order.envelopes)
        finally:
            if achieved is None:  # whoever goes on from here must not count on it
                self._decider.forget()
        if achieved is None:
            return None
        drive = drive_of_eras(achieved, self._rig)
        self._decider.confirm(drive, now=clock.now())
        if any(order.envelopes.values()):
            self._decider.loaded_in(self._group.loading_time, now=clock.now())
        return drive

    def _tell_outcome(self, decision: Decision, drive: Mapping[str, DriveCommand]) -> None:
        """Tell what a decision has led to; what plays now, by ERA."""
        order = decision.order
        if order is not None and order.problem is not None:
            self._tell(self._observer.refused, order.problem)
        if order is not None and order.is_brake:
            return  # nothing else is felt by it
        sent = self._group.last_sent
        if order is not None and order.pattern is not None:
            self._tell(
                self._observer.pattern_applied,
                applied_by(decision, order.pattern, drive=drive, sent=sent, timing=self._timing),
            )
        else:
            self._tell(
                self._observer.silenced,
                silenced_by(decision, sent=None if order is None else sent, now=clock.now()),
            )

    async def _listen(self, source: TouchSource) -> None:
        """Take what a source says; one that fails is told, and leaves its contacts to expire."""
        try:
            await source.run(self.deliver)
        except Exception as error:
            _logger.exception("a touch source failed")
            self._tell(self._observer.source_failed, failure_text(error))

    async def _next_cause(self) -> None:
        """Wait until there is a reason to run: news, a heartbeat, an overdue source or intent."""
        now = clock.now()
        moments = [now + IDLE_TURN]
        if self._decider.due is not None:
            moments.append(self._decider.due)
        if self.phase is Phase.ARMED:
            moments.append(self._heartbeat_due)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, min(moments) - now)):
                await self._wake.wait()

    def _tell(self, callback: Callable[_P, None], *args: _P.args, **kwargs: _P.kwargs) -> None:
        """Call an observer; whatever it raises stays here."""
        try:
            callback(*args, **kwargs)
        except Exception:
            _logger.exception("an observer of the control loop failed")
