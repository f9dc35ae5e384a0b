"""Control loop of a plate: each cycle plans, sends the changes and feeds the watchdogs.

The cycle waits and sends; the planner does neither. Observers of the loop get a report whenever a
plan changes the contents that play.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import Enum, auto
from typing import ParamSpec, cast

from controller.play.layer_sets import Sets
from controller.play.planner import Plan, PlanKind, Planner
from controller.play.reports import Observers, play_report
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.play.slots import RELEASE_RAMP
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Change, RejectCounter, TouchFrame
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Overtaken,
    Preempted,
)
from drivers.host.group import Group
from drivers.protocol.definition import HEARTBEAT
from model.quantities import counted
from model.structure.plate import Plate
from registry import threads

# s; the loop runs even with nothing to do, for a supervisor that checks whether it is alive.
IDLE_INTERVAL = 0.5

_P = ParamSpec("_P")

_logger = logging.getLogger(__name__)


class SendFailure(Enum):
    """Why the sets of a plan do not play, and what plays instead."""

    PREEMPTED = auto()
    """A touch or a request of a client came before any amplifier played the sets; the former
    contents continue."""
    REFUSED = auto()
    """The amplifiers refused the sets; the former contents continue."""
    NO_REPLY = auto()
    """An amplifier does not reply, and none plays the sets; the former contents continue."""
    UNKNOWN = auto()
    """Any other error: it is unknown which contents play."""


class Cycle:
    """The control loop of a plate; it follows contacts even while it waits.

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
        self._plan: Plan | None = None  # being sent to the amplifiers
        self._wake = asyncio.Event()
        self._heartbeat_due = 0.0
        self._is_newly_armed = False  # until the next turn, which sends all contents again
        self._expiry: asyncio.TimerHandle | None = None

    @property
    def is_preparing(self) -> bool:
        """Whether a change of contacts is on its way to the amplifiers."""
        planner, plan = self.planner, self._plan
        is_unsent = plan is not None and self.group.members.last_sent_at < plan.since
        return planner is not None and (is_unsent or planner.is_waiting)

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
        if self._is_newly_armed:  # not during a turn, whose set may be on the wire
            self._is_newly_armed = False
            planner.forget()
        plan = planner.plan(now)
        try:
            async with self.sending:
                with suppress(LinkDegraded):  # the next plan starts afresh; feed the others
                    if plan is not None and self.group.is_armed:
                        await self._send(planner, plan)
                # Not after a set that was given up: the next cycle silences it first.
                if self._is_heartbeat_due(planner):
                    await self._beat()
        except (Preempted, LinkDegraded):
            pass  # the playback is unknown; the next plan starts afresh
        except LinkError as error:
            _report(self.observers.link_lost, str(error))
        except DriverError as error:
            _report(self.observers.refused, str(error))

    async def _beat(self) -> None:
        """Feed the watchdogs, and note when that is due next."""
        # Counted from the request: the watchdog has run since that was sent.
        due = threads.now() + HEARTBEAT
        self._heartbeat_due = due
        try:
            await self.group.beat()
        finally:
            if self._heartbeat_due == due:  # not hastened meanwhile (`feed_at_once`)
                pause = HEARTBEAT / 2  # for a slow wire
                self._heartbeat_due = max(due, threads.now() + pause)

    async def _send(self, planner: Planner, plan: Plan) -> None:
        """Send the changes of a plan, and report the outcome; raises DriverError.

        While an amplifier is degraded nothing starts or is prolonged. A refused plan is replaced by
        the planner, once.
        """
        if self.group.members.degraded:
            plan = planner.drop_starts(plan)
        self._plan = plan
        try:
            sent_at = await self._play(planner, plan.sets)
        except BaseException as error:
            failure = self._failure_of(error, plan.sets)
            if failure is SendFailure.PREEMPTED:
                return  # the endings follow the sets of the next plan
            if failure is not SendFailure.REFUSED:
                planner.not_played(plan, is_known=failure is SendFailure.NO_REPLY)
                raise
            refusal = cast("CommandRefused", error)
            plan = planner.replace_refused(plan, refusal, now=threads.now())
            await self._send(planner, plan)
            return
        finally:
            self._plan = None
        if plan.sets.reason:
            _report(self.observers.refused, plan.sets.reason)
        if plan.kind is PlanKind.CHANGE:
            playing = planner.slots.by_layer
            report = play_report(plan, playing, sent_at=sent_at, now=threads.now())
            _report(self.observers.reported, report)

    def _failure_of(self, error: BaseException, sets: Sets) -> SendFailure:
        """Classify the exception that ended an attempt to send sets."""
        if isinstance(error, Overtaken):
            return SendFailure.PREEMPTED
        if sets.silence is not None:
            return SendFailure.UNKNOWN
        is_refusal = isinstance(error, CommandRefused) and not isinstance(error, Preempted)
        if is_refusal and self.group.is_armed:
            return SendFailure.REFUSED
        if isinstance(error, LinkDegraded) and not self.group.sets.is_in_doubt:
            return SendFailure.NO_REPLY
        return SendFailure.UNKNOWN

    async def _play(self, planner: Planner, sets: Sets) -> float | None:
        """Play sets, or the silence in their place; return when [s] they start, None if empty."""
        if sets.silence is not None:
            return await self._play_silence(planner, sets.silence)
        if sets.layers:
            return await self._play_layers(planner, sets)
        return None

    async def _play_silence(self, planner: Planner, ramp: float) -> float:
        """Silence all layers along a ramp [s]; return when [s] the last request was sent."""
        sent_at = await self.group.silence(ramp)
        planner.confirm_silence()
        return sent_at

    async def _play_layers(self, planner: Planner, sets: Sets) -> float:
        """Play layers on all amplifiers from one moment [s] on, which is returned."""
        if self.group.sets.is_in_doubt:
            await self.group.silence(RELEASE_RAMP)  # before the next pattern

        def is_preempted() -> bool:
            has_event = self._wake.is_set()  # a touch, or a request of a client
            return has_event and threads.now() < sets.preempted_until

        played = await self.group.play(sets.by_amplifier, is_preempted if sets.updates else None)
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
        """Begin the next cycle immediately."""
        self._wake.set()

    def feed_at_once(self) -> None:
        """Begin the next cycle immediately, and feed the watchdogs in it."""
        self._heartbeat_due = threads.now()
        self._wake.set()

    def note_armed(self, capabilities: PlaybackCapabilities, *, was_armed: bool) -> None:
        """Note that the amplifiers have been armed.

        The next cycle sends all contents and feeds the watchdogs. capabilities: of the
        amplifiers, as identified again; was_armed: whether they were armed before, so that contents
        continue. Raises CommandError without a planner.
        """
        if self.planner is None:
            raise CommandError("controller must be open; call open() first")
        self._is_newly_armed = True
        if not was_armed:
            self.planner.confirm_silence()
        self.planner.replace_capabilities(capabilities)
        self._schedule_expiry()  # fingers may have rested since before
        self.feed_at_once()

    def deliver(self, frame: TouchFrame) -> None:
        """Process a touch frame; call it in the loop's thread."""
        # No plan includes the contacts that came since the last cycle.
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
        """Query the intent source again, because its intent has changed without a touch."""
        if self.planner is not None:
            self.planner.look_again()
        self._wake.set()

    def _is_heartbeat_due(self, planner: Planner) -> bool:
        """Whether to feed the watchdogs now; pending silence has priority."""
        if not self.group.is_armed or planner.is_silence_pending:
            return False
        return threads.now() >= min(self._heartbeat_due, self.group.members.lost_from)

    def _follow(self, change: Change) -> None:
        """Act on a change of contacts, also while the loop waits for amplifiers."""
        planner = self.planner
        self._wake.set()
        if change.up and planner is not None:  # else the amplifiers were never open
            if planner.is_silence_pending:
                self.group.abort_exchange()
            planner.count_unplanned_lifts(change.up)
        _report(self.observers.contacts_changed, self.tracker.contacts, change)

    def _schedule_expiry(self) -> None:
        """Check for expired sources when the next one times out.

        An earlier timer is kept, so that not every frame of a source sets a new one.
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
        change = self.tracker.expire(now)
        if change.up:
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
            if self.planner is not None:
                until = min(until, self.planner.slots.next_update_after(now))
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
