"""All amplifiers of a plate: they play together or not at all."""

import asyncio
import logging
import math
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from enum import Enum, auto
from functools import partial
from typing import Any, TypeVar

from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    LinkTimeout,
    Preempted,
)
from drivers.host.amplifier import CONFIRM_TIMEOUT, DISARM_RAMP, WATCHDOG, Amplifier
from drivers.host.clocks import Clocks
from drivers.host.dialogue import IsPreempted
from drivers.host.feeding import Stopped
from drivers.host.heartbeats import Heartbeats
from drivers.host.jobs import Priority
from drivers.host.joint_sets import JointSets, Played
from drivers.host.members import Members, is_lost, outcomes
from drivers.playing.contents import Layer
from drivers.protocol.definition import ENABLED, QUANTITIES, STOP_RAMP, check_watchdog
from drivers.protocol.records import Values
from registry import threads

_T = TypeVar("_T")
_SESSION, _TOKEN = QUANTITIES["session"], QUANTITIES["token"]
_logger = logging.getLogger(__name__)


class GroupState(Enum):
    """State of all amplifiers together: CLOSED until opened and in the end, LOST by a LinkError.

    STOPPED: disarmed by a stop, which is to be cleared before they are armed.
    """

    CLOSED = auto()
    DISARMED = auto()
    STOPPED = auto()
    ARMED = auto()
    LOST = auto()


class Group:
    """Amplifiers by name, their lines open. A failure of one stops all; nothing arms by itself.

    A stop runs to completion even if its caller is cancelled. watchdog [s]: of armed amplifiers.
    restored: called where one that did not reply does again; its watchdog has run down meanwhile.
    draw: of session numbers and of the first token, so that none of an earlier host is repeated.
    """

    def __init__(
        self,
        amplifiers: Mapping[str, Amplifier],
        *,
        watchdog: float = WATCHDOG,
        restored: Callable[[], None] = lambda: None,
        draw: Callable[[int, int], int] = random.randint,
    ) -> None:
        self.state = GroupState.CLOSED
        self.members = Members(amplifiers)
        """Which of them reply, and which are lost."""
        self.amplifiers = self.members.amplifiers
        self.sets = JointSets(self.members, draw(_TOKEN.minimum, _TOKEN.maximum))
        """What they play together."""
        self._clocks = Clocks(self.members)
        self._heartbeats = Heartbeats(self.members, self.sets, self._clocks, restored)
        self._watchdog, self._draw = watchdog, draw
        self._arming = asyncio.Lock()  # a second arm waits for the first
        self._closing = asyncio.Lock()  # a second close waits for the first
        self._limit: asyncio.Timeout | None = None  # of an exchange in progress

    @property
    def clock_errors(self) -> Mapping[str, float]:
        """Errors of the clocks [s rms] by amplifier, see `Clocks.errors`."""
        return self._clocks.errors

    @property
    def is_open(self) -> bool:
        """Whether all reply as far as is known: neither closed nor lost."""
        return self.state not in (GroupState.CLOSED, GroupState.LOST)

    @property
    def is_armed(self) -> bool:
        """Whether layers may be played."""
        return self.state is GroupState.ARMED

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed.

        Raises LinkError, and CommandError for a wire that is too slow for the watchdog.
        """
        members, before = self.members, self.members.epoch
        members.gives_up_at = math.inf
        await self._all([each.open() for each in self.amplifiers.values()])
        for amplifier in self.amplifiers.values():
            check_watchdog(self._watchdog, amplifier.exchange_time("Set"))
        self._clocks.follow()
        self._heartbeats.follow()
        # Each amplifier says itself what it has latched before.
        self.state = GroupState.DISARMED if members.epoch == before else GroupState.STOPPED

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        Each line has a session of its own: a broadcast reaches all of it, and one whose cable was
        exchanged for another line's neither plays nor is fed. If all are armed, also by a request
        that came first, nothing changes. Raises DriverError, LinkDegraded where one only does not
        reply for now.
        """
        members, before = self.members, self.members.epoch
        async with self._arming:
            if not self.is_open:
                raise CommandError(
                    f"amplifiers must be open to be armed, got {self.state.name}; close and open "
                    "all of them again"
                )
            if self.state is GroupState.STOPPED:  # an amplifier that restarted does not know
                raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
            if members.silencing:  # the result would depend on the order of frames
                raise CommandRefused(
                    "amplifiers are being stopped or disarmed; arm again if that is still wanted"
                )
            members.check_none_since(before)
            amplifiers = [*self.amplifiers.values()]
            if self.is_armed:
                statuses = await self.statuses(Priority.ARM)
                members.check_none_since(before)
                if all(each["state"] == ENABLED for each in statuses.values()):
                    return
                self._leave_armed()
                before = members.epoch
                await members.silence(self._disarm, amplifiers, STOP_RAMP)
                members.check_none_since(before)
            for amplifier in amplifiers:
                amplifier.check_other_host()  # before a disarm of what failed ends its vibration
            await self._clocks.settle()
            members.check_none_since(before)
            drawn = self._draw(_SESSION.minimum, _SESSION.maximum)
            sessions = {
                line: (drawn + number) % _SESSION.maximum + 1
                for number, line in enumerate(members.lines)
            }
            arms = [each.arm(sessions[each.line], self._watchdog) for each in amplifiers]
            arming = asyncio.ensure_future(outcomes(arms))
            try:
                members.checked(await asyncio.shield(arming))
                members.check_none_since(before)
            except BaseException as error:
                self._note(error)
                await members.silence(self._disarm_armed, arming)
                if isinstance(error, DriverError):
                    members.check_none_since(before)
                if members.is_degraded_only(error):
                    raise LinkDegraded(str(error)) from error
                if members.lost_by:
                    self._lose()
                raise
            self.sets.is_incomplete = False
            self.state = GroupState.ARMED

    async def _disarm_armed(self, arming: "asyncio.Future[Any]") -> None:
        """Disarm what may have been armed by this; any other may be another host's."""
        await arming
        retried = self.members.retried
        disarms = [
            retried(each, partial(each.disarm, STOP_RAMP))
            for each in self.amplifiers.values()
            if each.may_be_armed
        ]
        # One that is mute stops none.
        if not all(isinstance(each, LinkError | None) for each in await outcomes(disarms)):
            await self.stop()

    def beat(self) -> Coroutine[Any, Any, Sequence[object]]:
        """Feed the watchdog of every amplifier that replies; raises as `apply`.

        Of one that does not reply the status is read meanwhile; one that replies again must still
        play its set.
        """
        return self._exchange(self._heartbeats.beat)

    def apply(
        self, layers: Mapping[str, Sequence[Layer]], is_preempted: IsPreempted | None = None
    ) -> Coroutine[Any, Any, Played]:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused; silence alone is not staged. One
        that is no longer armed does not refuse a set: it stops all.
        Raises Preempted where a stop, disarm or `abort_exchange` came first, and LinkDegraded where
        one does not reply: then it is unknown whether the set plays. What else fails stops all
        amplifiers before it is raised.
        is_preempted: asked before one is sent the set, and before they are to play it; if so,
        Overtaken, and what plays goes on.
        """
        return self._exchange(partial(self.sets.play, layers, is_preempted))

    async def silence(self, ramp: float) -> float:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed.

        Returns when [s] the last request went out. Raises as `apply`.
        """
        await self._exchange(partial(self.sets.silence, ramp))
        return self.members.last_sent_at

    def abort_exchange(self) -> None:
        """End an `apply`, `silence` or `beat` in progress, so that silence can be sent next.

        What was not sent is not sent any more; a request on the wire is waited for at most 8 ms.
        """
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(threads.now())

    async def _exchange(self, exchange: Callable[[], Awaitable[_T | DriverError]]) -> _T:
        """Run an exchange of the control loop; any unexplained failure stops all amplifiers.

        An error that it returns stops none.
        """
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")
        members, before = self.members, self.members.epoch
        limit = asyncio.timeout(None)
        try:
            try:
                async with limit as self._limit:
                    done = await exchange()
            finally:
                self._limit, members.has_joint_set = None, False
        except Exception as error:
            self._note(error)
            has_lost = isinstance(error, LinkTimeout) and self.state is GroupState.LOST
            if limit.expired() and isinstance(error, TimeoutError | Preempted) and not has_lost:
                raise Preempted("given up, since silence comes first") from error
            if members.is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            is_explained = members.epoch != before and self.state is not GroupState.LOST
            if is_explained and isinstance(error, DriverError):
                raise Preempted("a stop or disarm came first") from error
            replying = [name for name, each in self.amplifiers.items() if not each.silence_cause]
            await self.stop(waits_for=replying)
            if has_lost:  # also where it was degraded when this began
                raise LinkTimeout(next(iter(members.lost_by.values()), str(error))) from error
            raise
        if isinstance(done, DriverError):
            raise done
        return done

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, read back from every amplifier.

        It goes on to its end if its caller is cancelled. Where one fails all are stopped.
        """
        self._leave_armed()
        await self.members.silence(self._disarm, [*self.amplifiers.values()], ramp)

    async def _disarm(self, amplifiers: Sequence[Amplifier], ramp: float) -> None:
        retried = self.members.retried
        try:
            await self._all([retried(each, partial(each.disarm, ramp)) for each in amplifiers])
        except BaseException:
            await self.stop()
            raise

    def stop(
        self, ramp: float = STOP_RAMP, *, waits_for: Sequence[str] | None = None
    ) -> Coroutine[Any, Any, Mapping[str, Stopped]]:
        """Stop every amplifier along a ramp [s], lost ones too; latched until `clear`.

        The requests are queued when this returns. Await it for what became of each, by name: of
        those of some names, None for all. It goes on to its end if its caller is cancelled.
        """
        self._leave_armed()
        if self.is_open:
            self.state = GroupState.STOPPED
        members, stops = self.members, dict[str, asyncio.Future[Stopped]]()
        for line in members.lines:
            if len(line.members) > 1:  # so that none waits for the reply of another
                try:
                    members.broadcast_stop(line, ramp)
                except Exception:  # each amplifier is stopped by itself as well
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        for name, amplifier in self.amplifiers.items():
            try:
                stops[name] = amplifier.stop(ramp)
            except Exception as error:  # the others are stopped all the same
                stops[name] = asyncio.get_running_loop().create_future()
                stops[name].set_exception(error)
        names = stops if waits_for is None else waits_for
        return members.silence(members.stopped, {name: stops[name] for name in names})

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone.

        Raises Preempted while amplifiers are being stopped or disarmed: nothing precedes that.
        """
        if self.members.silencing:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        before = self.members.epoch
        try:
            await self._all([each.clear() for each in self.amplifiers.values()])
        except LinkError:
            await self.stop()
            raise
        except CommandRefused as error:
            if self.members.epoch != before:  # the stop of now is another one
                raise Preempted("a stop came first; find the cause, then clear again") from error
            raise
        if self.members.epoch == before and self.state is GroupState.STOPPED:
            self.state = GroupState.DISARMED

    async def statuses(self, priority: Priority = Priority.OTHER) -> dict[str, Values]:
        """Read the status of every amplifier, by name; again while one does not reply.

        Raises LinkError once that one is lost.
        """
        amplifiers, retried = self.amplifiers.values(), self.members.retried
        statuses = await self._all(
            [retried(each, partial(each.read_status, priority)) for each in amplifiers]
        )
        return dict(zip(self.amplifiers, statuses, strict=True))

    async def close(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, confirm it by reading back, and disarm; may be called twice.

        A failure stops all amplifiers and is logged. The lines are left to their owner.
        """
        is_armed, now = self.is_armed, threads.now()
        self._leave_armed()
        self.state = GroupState.CLOSED
        # Of one that does not reply by then a stop is all that is left.
        self.members.gives_up_at = min(self.members.gives_up_at, now + CONFIRM_TIMEOUT)
        async with self._closing:
            amplifiers = [
                each
                for each in self.amplifiers.values()
                if each.may_be_armed
                and (
                    is_armed
                    or not is_lost(each)
                    or (each.line.loss is None and each.what_may_play().may_play_until > now)
                )
            ]
            try:
                if amplifiers:
                    await self.members.silence(self._disarm, amplifiers, ramp)
            except DriverError as error:
                _logger.error("amplifiers: stopped, because closing failed: %s", error)
            if self.members.silencing:  # only then is a line closed
                await asyncio.wait({*self.members.silencing})

    def _leave_armed(self) -> None:
        """Leave ARMED for DISARMED, if armed, so that nothing more is played."""
        self.members.epoch += 1
        if self.is_armed:
            self.state = GroupState.DISARMED

    def _lose(self) -> None:
        """Enter the state LOST, in which nothing is played."""
        if self.state is not GroupState.CLOSED:
            self.state = GroupState.LOST

    def _note(self, error: BaseException) -> None:
        """Note an error of a request: it may show that an amplifier is lost."""
        if isinstance(error, LinkError) and not self.members.is_degraded_only(error):
            error.lost = tuple(self.members.lost_by)
            self._lose()

    async def _all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error, noted."""
        try:
            return await self.members.all(requests)
        except LinkError as error:
            self._note(error)
            raise
