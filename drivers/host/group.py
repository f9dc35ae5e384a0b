"""All amplifiers of a plate, which play together or not at all.

`Group` holds the state of all amplifiers: a failure of one amplifier stops all, and nothing arms
automatically.
"""

import asyncio
import logging
import math
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
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
from drivers.host.group_clocks import Clocks
from drivers.host.group_states import REACTIONS, Failure, GroupState
from drivers.host.heartbeats import Heartbeats
from drivers.host.joint_sets import JointSets, PlayedSet, UnplayedSet
from drivers.host.line import Line
from drivers.host.members import Members, is_lost, outcomes
from drivers.host.requests import Priority
from drivers.host.set_admission import IsPreempted, StagedSet
from drivers.host.stops import StopOutcome
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import ENABLED, QUANTITIES, STOP_RAMP, check_watchdog
from drivers.protocol.records import Values
from registry import threads

_T = TypeVar("_T")
_SESSION = QUANTITIES["session"]
_TOKEN = QUANTITIES["token"]
_logger = logging.getLogger(__name__)


class Group:
    """Amplifiers by name, on open lines. A failure stops all; nothing arms automatically.

    A stop runs to completion even if its caller is cancelled. watchdog: of armed amplifiers [s].
    restored: called when a mute amplifier replies again; its watchdog has run down meanwhile.
    draw: draws random session numbers and the first token, so that values of an earlier host are
    not repeated.
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
        """Tracks which amplifiers reply, and which are lost."""
        self.amplifiers = self.members.amplifiers
        self.sets = JointSets(self.members, draw(_TOKEN.minimum, _TOKEN.maximum))
        """Makes them play together."""
        self._clocks = Clocks(self.members, self.sets)
        self._heartbeats = Heartbeats(self.members, self.sets, self._clocks, restored)
        self._watchdog = watchdog
        self.draw = draw
        """Draws random session numbers."""
        self._arming = asyncio.Lock()
        """A second arm waits for the first."""
        self._closing = asyncio.Lock()
        """A second close waits for the first."""
        self._limits = set[asyncio.Timeout]()
        """Each ends an exchange in progress if it is rescheduled to an earlier time."""

    @property
    def clock_errors(self) -> Mapping[str, float]:
        """Errors of the clocks [s rms] by amplifier, see `Clocks.errors`."""
        return self._clocks.errors

    @property
    def is_open(self) -> bool:
        """Whether the amplifiers are neither closed nor lost."""
        return self.state not in (GroupState.CLOSED, GroupState.LOST)

    @property
    def is_armed(self) -> bool:
        """Whether layers may be played."""
        return self.state is GroupState.ARMED

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed.

        Raises LinkError, or CommandError if a wire is too slow for the watchdog.
        """
        members = self.members
        epoch = members.epoch
        members.gives_up_at = math.inf
        await self._all([amplifier.open() for amplifier in self.amplifiers.values()])
        for amplifier in self.amplifiers.values():
            check_watchdog(self._watchdog, amplifier.exchange_time("Set"))
        self._clocks.follow()
        self._heartbeats.follow()
        # What an amplifier has latched before is in its own status.
        self.state = GroupState.DISARMED if members.epoch == epoch else GroupState.STOPPED

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        Each line has a session of its own: a broadcast reaches all amplifiers of a line, and one
        whose cable was moved to another line neither plays nor is fed. If all are armed already,
        nothing changes. Raises DriverError, and LinkDegraded if an amplifier only does not reply
        for the moment.
        """
        members = self.members
        epoch = members.epoch
        async with self._arming:
            self._check_may_arm()
            members.check_none_since(epoch)
            amplifiers = [*self.amplifiers.values()]
            if self.is_armed:
                statuses = await self.statuses(Priority.ARM)
                members.check_none_since(epoch)
                if all(status["state"] == ENABLED for status in statuses.values()):
                    return
                self._leave_armed()
                epoch = members.epoch
                await members.start_disarming(self._disarm, amplifiers, STOP_RAMP)
                members.check_none_since(epoch)
            for amplifier in amplifiers:
                # If this came later, the disarm after a failure would end another host's vibration.
                amplifier.check_other_host()
            await self._arm_all(amplifiers, epoch)
            self.sets.note_armed()
            self.state = GroupState.ARMED

    def _check_may_arm(self) -> None:
        """Raise CommandError or CommandRefused if the state of the group forbids arming."""
        if not self.is_open:
            raise CommandError(
                f"amplifiers must be open to be armed, got {self.state.name}; close and reopen "
                "all amplifiers"
            )
        if self.state is GroupState.STOPPED:  # a restarted amplifier has lost its latch
            raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
        if self.members.disarming:  # otherwise the order of frames would decide the result
            raise CommandRefused(
                "amplifiers are being stopped or disarmed; arm again if that is still wanted"
            )

    def _draw_sessions(self, amplifiers: Sequence[Amplifier]) -> dict[Line, int]:
        """Draw a session for each line that none of the amplifiers held last."""
        drawn = self.draw(_SESSION.minimum, _SESSION.maximum)
        while True:
            sessions = {
                line: (drawn + number) % _SESSION.maximum + 1
                for number, line in enumerate(self.members.lines)
            }
            if all(amplifier.session != sessions[amplifier.line] for amplifier in amplifiers):
                return sessions
            drawn += 1

    async def _arm_all(self, amplifiers: Sequence[Amplifier], epoch: int) -> None:
        """Arm amplifiers that are disarmed; disarm them after a failure or a newer stop."""
        members = self.members
        await self._clocks.settle()
        members.check_none_since(epoch)
        sessions = self._draw_sessions(amplifiers)
        arms = [amplifier.arm(sessions[amplifier.line], self._watchdog) for amplifier in amplifiers]
        arming = asyncio.ensure_future(outcomes(arms))
        try:
            members.checked(await asyncio.shield(arming))
            members.check_none_since(epoch)
        except BaseException as error:
            await members.start_disarming(self._disarm_armed, arming)
            if isinstance(error, DriverError):
                members.check_none_since(epoch)
            # Only now: an amplifier that replied to the disarm is not lost.
            if members.is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            if members.lost_by or isinstance(error, LinkError):
                self._lose(error)
            raise

    async def _disarm_armed(self, arming: "asyncio.Future[Any]") -> None:
        """Disarm the amplifiers that this may have armed; another host may use the others."""
        await arming
        retried = self.members.retried
        disarms = [
            retried(amplifier, partial(amplifier.disarm, STOP_RAMP))
            for amplifier in self.amplifiers.values()
            if amplifier.may_be_armed
        ]
        # An amplifier that is only mute does not stop the others.
        if not all(isinstance(outcome, LinkError | None) for outcome in await outcomes(disarms)):
            await self.stop()

    def beat(self) -> Coroutine[Any, Any, Sequence[object]]:
        """Feed the watchdog of every amplifier that replies; raises as `play`.

        The status of each other amplifier is read meanwhile; if it replies again, it must still
        play its set.
        """
        return self._exchange(self._heartbeats.beat)

    async def apply(self, layers: Mapping[str, Sequence[AmplifierLayer]]) -> PlayedSet:
        """Play layers on the amplifiers with these names, see `play`."""
        sets = {}
        for name, amplifier_layers in layers.items():
            sets[name] = StagedSet(amplifier_layers)
        return await self.play(sets)

    async def play(
        self, sets: Mapping[str, StagedSet], is_preempted: IsPreempted | None = None
    ) -> PlayedSet:
        """Play sets on the amplifiers with these names; all start at one moment.

        If one amplifier refuses its set, none commits, and CommandRefused is raised; a set that
        only silences is not staged first. An amplifier that is no longer armed stops all.
        Raises Preempted if a stop, disarm or `abort_exchange` came first, and LinkDegraded if an
        amplifier does not reply, so that it is unknown whether the set plays. Any other failure
        stops all amplifiers before it is raised.
        is_preempted: called before a set is sent, and again before it is committed; if it returns
        True, Overtaken is raised and the current playback continues.
        """
        outcome = await self._exchange(partial(self.sets.play, sets, is_preempted))
        if isinstance(outcome, UnplayedSet):
            raise await self._react(outcome.failure, outcome.reason)
        return outcome

    async def silence(self, ramp: float) -> float:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed.

        A `play` in progress must be ended first (`abort_exchange`), or all amplifiers are stopped.
        Returns the time [s] at which the last request went out. Raises as `play`.
        """
        await self._exchange(partial(self.sets.silence, ramp))
        return self.members.last_sent_at

    def abort_exchange(self) -> None:
        """End each `play`, `silence` or `beat` in progress, so that silence can be sent next.

        Requests that were not sent yet are dropped; one on the wire is awaited for at most 8 ms.
        """
        for limit in self._limits:
            if not limit.expired():
                limit.reschedule(threads.now())

    async def _exchange(self, exchange: Callable[[], Awaitable[_T]]) -> _T:
        """Run an exchange of the control loop; react to an error, then raise it."""
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")
        epoch = self.members.epoch
        limit = asyncio.timeout(None)
        try:
            try:
                async with limit:
                    self._limits.add(limit)
                    return await exchange()
            finally:
                self._limits.discard(limit)
        except Exception as error:
            failure = self._failure_of(error, epoch, is_aborted=limit.expired())
            reported_error = await self._react(failure, error)
            if reported_error is error:
                raise
            raise reported_error from error

    def _failure_of(self, error: Exception, epoch: int, *, is_aborted: bool) -> Failure:
        """Classify the error of an exchange that began in an epoch.

        is_aborted: whether `abort_exchange` has ended it.
        """
        is_degraded = self.members.is_degraded_only(error)
        is_link_error = isinstance(error, LinkError)
        if is_link_error and not is_degraded and self.state is not GroupState.CLOSED:
            return Failure.LOST
        # A LinkTimeout is a TimeoutError too: an amplifier that did not reply in time to an aborted
        # exchange, but is not lost, stops nothing, because silence is sent next.
        if is_aborted and isinstance(error, TimeoutError | Preempted):
            return Failure.ABORTED
        if is_degraded:
            return Failure.DEGRADED
        has_new_epoch = self.members.epoch != epoch and self.state is not GroupState.LOST
        if has_new_epoch and isinstance(error, DriverError):
            return Failure.PREEMPTED
        return Failure.FAULT

    async def _react(self, failure: Failure, error: Exception) -> Exception:
        """React to a failure as `REACTIONS` demands; return the error to be raised."""
        reaction = REACTIONS[failure]
        if reaction.is_loss:
            self._lose(error)
        if reaction.stops:
            amplifiers = self.amplifiers
            replying = [name for name in amplifiers if not amplifiers[name].no_reply_cause]
            await self.stop(waits_for=replying)
        if failure is Failure.LOST and isinstance(error, LinkTimeout):
            # The error may be LinkDegraded, if the amplifier was not lost yet when it was raised.
            return LinkTimeout(next(iter(self.members.lost_by.values()), str(error)))
        if reaction.error is None:
            return error
        return reaction.error(reaction.message or str(error))

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp to silence [s] and switch the high voltage off, confirmed by every amplifier.

        It runs to completion if its caller is cancelled. If one amplifier fails, all are stopped.
        """
        self._leave_armed()
        await self.members.start_disarming(self._disarm, [*self.amplifiers.values()], ramp)

    async def _disarm(self, amplifiers: Sequence[Amplifier], ramp: float) -> None:
        retried = self.members.retried
        try:
            await self._all(
                [retried(amplifier, partial(amplifier.disarm, ramp)) for amplifier in amplifiers]
            )
        except BaseException:
            await self.stop()
            raise

    def stop(
        self, ramp: float = STOP_RAMP, *, waits_for: Sequence[str] | None = None
    ) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
        """Stop every amplifier along a ramp [s], lost ones too; latched until `clear`.

        The requests are queued when this returns. Await it for the outcome of each amplifier by
        name; waits_for: names of the amplifiers to await, None for all. It runs to completion even
        if its caller is cancelled.
        """
        self._leave_armed()
        if self.is_open:
            self.state = GroupState.STOPPED
        members = self.members
        stops: dict[str, asyncio.Future[StopOutcome]] = {}
        for line in members.lines:
            if len(line.members) > 1:  # so that no amplifier waits for the reply of another
                try:
                    members.broadcast_stop(line, ramp)
                except Exception:  # each amplifier is also stopped by its own request
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        for name, amplifier in self.amplifiers.items():
            try:
                stops[name] = amplifier.stop(ramp)
            except Exception as error:  # the others are still stopped
                stops[name] = asyncio.get_running_loop().create_future()
                stops[name].set_exception(error)
        names = stops if waits_for is None else waits_for
        return members.start_disarming(members.stopped, {name: stops[name] for name in names})

    async def clear(self) -> None:
        """Acknowledge stops, and faults that no longer exist.

        Raises Preempted while amplifiers are being stopped or disarmed.
        """
        if self.members.disarming:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        epoch = self.members.epoch
        try:
            await self._all([amplifier.clear() for amplifier in self.amplifiers.values()])
        except LinkError:
            await self.stop()
            raise
        except CommandRefused as error:
            if self.members.epoch != epoch:  # there is a newer stop
                raise Preempted("a stop came first; find the cause, then clear again") from error
            raise
        if self.members.epoch == epoch and self.state is GroupState.STOPPED:
            self.state = GroupState.DISARMED

    async def statuses(self, priority: Priority = Priority.OTHER) -> dict[str, Values]:
        """Read the status of every amplifier, by name; repeated while an amplifier does not reply.

        Raises LinkError once an amplifier is lost.
        """
        readings = []
        for amplifier in self.amplifiers.values():
            read = partial(amplifier.read_status, priority)
            readings.append(self.members.retried(amplifier, read))
        statuses = await self._all(readings)
        return dict(zip(self.amplifiers, statuses, strict=True))

    async def close(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp to silence [s], confirm it by reading back, and disarm; may be called twice.

        A failure stops all amplifiers and is logged. The owner of the lines closes them.
        """
        was_armed = self.is_armed
        now = threads.now()
        self._leave_armed()
        self.state = GroupState.CLOSED
        # An amplifier that does not reply by then can only be stopped.
        self.members.gives_up_at = min(self.members.gives_up_at, now + CONFIRM_TIMEOUT)
        async with self._closing:
            amplifiers = []
            for amplifier in self.amplifiers.values():
                may_reply = was_armed or not is_lost(amplifier) or _may_play(amplifier, now)
                if amplifier.may_be_armed and may_reply:
                    amplifiers.append(amplifier)
            try:
                if amplifiers:
                    await self.members.start_disarming(self._disarm, amplifiers, ramp)
            except DriverError as error:
                _logger.error("amplifiers: stopped, because closing failed: %s", error)
            if self.members.disarming:  # no line may be closed before that has ended
                await asyncio.wait({*self.members.disarming})

    def _leave_armed(self) -> None:
        """Change from ARMED to DISARMED, so that nothing more is played."""
        self.members.start_epoch()
        if self.is_armed:
            self.state = GroupState.DISARMED

    def _lose(self, error: BaseException) -> None:
        """Enter the state LOST, which plays nothing; name all lost amplifiers in a LinkError."""
        if isinstance(error, LinkError):
            error.lost = tuple(self.members.lost_by)
        if self.state is not GroupState.CLOSED:
            self.state = GroupState.LOST

    async def _all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error.

        An error that shows the loss of an amplifier leads to the state LOST.
        """
        try:
            return await self.members.all(requests)
        except LinkError as error:
            if not self.members.is_degraded_only(error):
                self._lose(error)
            raise


def _may_play(amplifier: Amplifier, now: float) -> bool:
    """Whether a mute amplifier on a working line may still play."""
    return amplifier.line.loss is None and amplifier.what_may_play().may_play_until > now
