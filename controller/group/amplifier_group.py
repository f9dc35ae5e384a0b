"""All amplifiers of a rig as one: they play together or not at all."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import Enum, auto
from functools import partial
from typing import Any, TypeVar

from controller.group.quick_stops import QuickStops
from controller.group.synchronized_play import Played, SynchronizedPlay
from controller.group.tasks import gather_all, retry_while_degraded, run_to_completion
from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Preempted,
)
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.line.priority import PREEMPTION_GRACE
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.silence import StopOutcome
from drivers.operation.watchdog import check_watchdog
from drivers.protocol.definition import random_session
from drivers.protocol.messages import AmplifierState

# How often, and how far apart [s], levels are read back after the closing ramp has ended.
_READ_BACKS = 5
_READ_BACK_INTERVAL = 0.010

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


class GroupState(Enum):
    """State of all amplifiers together: CLOSED until opened and in the end, LOST by a LinkError."""

    CLOSED = auto()
    DISARMED = auto()
    ARMED = auto()
    LOST = auto()


class AmplifierGroup:
    """Amplifiers by their names in the rig, not yet open.

    A pattern with one ERA missing is another pattern, so a failure of one amplifier stops all of
    them before the error is raised. Nothing arms again by itself. A stop runs to completion even if
    its caller is cancelled. watchdog [s]: of armed amplifiers.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier], *, watchdog: float = WATCHDOG) -> None:
        self.state = GroupState.CLOSED
        self._watchdog = watchdog
        self._amplifiers = dict(amplifiers)
        self._checked = {
            name: CheckedAmplifier(amplifier, f"amplifier {name}")
            for name, amplifier in self._amplifiers.items()
        }
        self._playback = SynchronizedPlay(self._checked)
        self._quick_stops = QuickStops(self._amplifiers)
        self._arming = asyncio.Lock()  # a second arm waits for the first
        self._closing = asyncio.Lock()  # a second close waits for the first
        self._silence_count = 0  # disarms, stops and closes so far
        self._silencing_count = 0  # disarms and stops in progress
        self._stop_count = self._cleared_count = 0  # stops so far, and at the last clear
        self._may_be_armed = False  # since the amplifiers were opened
        self._limit: asyncio.Timeout | None = None  # of a play or heartbeat in progress

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        return tuple(name for name, each in self._amplifiers.items() if each.is_degraded)

    @property
    def is_set_incomplete(self) -> bool:
        """Whether possibly only some amplifiers have committed the last set."""
        return self._playback.is_set_incomplete

    @property
    def last_sent_at(self) -> float:
        """When [s] a request was last sent to any amplifier."""
        return max(amplifier.last_sent_at for amplifier in self._all)

    async def open(self) -> None:
        """Open all amplifiers, or none of them if one fails.

        Raises LinkError, and CommandError for a wire that is too slow for the watchdog.
        """
        try:
            await gather_all(amplifier.open() for amplifier in self._all)
            for amplifier in self._all:
                check_watchdog(self._watchdog, amplifier.round_trip())
        except BaseException:
            await self._close_wires()
            raise
        self.state = GroupState.DISARMED
        self._may_be_armed = False
        self._cleared_count = self._stop_count  # each amplifier says itself what it has latched

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        If all are armed, also by a request that came first, nothing changes.
        """
        before = self._silence_count
        async with self._arming:
            self._check_open()
            if self._stop_count > self._cleared_count:  # an amplifier that restarted does not know
                raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
            if self._silencing_count:  # the result would depend on the order of frames
                raise CommandRefused(
                    "amplifiers are being stopped or disarmed; arm again if that is still wanted"
                )
            self._check_not_silenced(before)
            if self.state is GroupState.ARMED:
                statuses = await self._gather(amplifier.status() for amplifier in self._all)
                self._check_not_silenced(before)
                if all(each.state is AmplifierState.OPERATION_ENABLED for each in statuses):
                    return
                before = await self._disarm_rest()
            await self._arm(before)

    async def _disarm_rest(self) -> int:
        """Disarm those that still are, when others no longer are; the count of silences then."""
        self._leave_armed()
        before = self._silence_count
        with self._silencing():
            await self._gather(amplifier.disarm(0.0) for amplifier in self._all)
        self._check_not_silenced(before)
        return before

    async def _arm(self, before: int) -> None:
        """Arm all amplifiers; before: count of silences at the request."""
        self._may_be_armed = True
        session = random_session()  # one for all, so that a broadcast reaches them
        try:
            await self._gather(
                each.arm(self._watchdog, session=session) for each in self._checked.values()
            )
            self._check_not_silenced(before)
        except BaseException:
            with self._silencing():
                await self._finish(
                    retry_while_degraded(amplifier.disarm) for amplifier in self._all
                )
            raise
        self._playback.forget()
        self.state = GroupState.ARMED

    def _check_open(self) -> None:
        if self.state in (GroupState.CLOSED, GroupState.LOST):
            raise CommandError(
                f"amplifiers must be open to be armed, got {self.state.name}; close and open all "
                "of them again"
            )

    def _check_not_silenced(self, before: int) -> None:
        if self._silence_count != before:
            raise CommandRefused(
                "amplifiers were disarmed, stopped or closed while arming, and stay disarmed; "
                "arm again if that is still wanted"
            )

    async def play(
        self,
        sets: Mapping[str, SafeCommandSet],
        *,
        envelopes: Mapping[str, Sequence[SafeEnvelope]] | None = None,
        load_until: float = math.inf,
    ) -> Played | None:
        """Play a set on every amplifier, by name, after loading the envelopes, until a time [s].

        None if a disarm, stop or close came meanwhile, after `abort_exchange`, or on a degraded
        link: then it is unknown whether the set plays. Raises DriverError.
        """
        return await self._exchange(
            self._playback.play(
                sets, envelopes or {}, may_play=self._may_play, load_until=load_until
            )
        )

    async def heartbeat(self) -> bool:
        """Feed the watchdogs; False where `play` would return None.

        On a degraded link the status is read instead; an amplifier that replies again must still
        play its set. Raises DriverError, also for an amplifier that is no longer enabled or
        whose replies contradict requests twice in a row.
        """
        return await self._exchange(self._heartbeat()) is not None

    def abort_exchange(self) -> None:
        """End a `play` or `heartbeat` in progress, with or without its replies.

        It takes at most PREEMPTION_GRACE. Only silence is sent meanwhile, and nothing is repeated.
        """
        if self._limit is not None and not self._is_aborting:
            self._limit.reschedule(clock.now() + PREEMPTION_GRACE)
            for amplifier in self._all:
                amplifier.abort_unsent()

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        self._leave_armed()
        try:
            with self._silencing():
                await self._gather(
                    retry_while_degraded(amplifier.disarm) for amplifier in self._all
                )
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> Mapping[str, StopOutcome]:
        """Quick-stop every amplifier, lost ones too; latched until `clear`, also if they restart.

        Returns what is known of the silence of each, by name. Concurrent requests share one further
        stop.
        """
        self._leave_armed()
        self._stop_count += 1
        with self._silencing():
            return await run_to_completion(self._quick_stops.stop())

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone.

        Raises Preempted while amplifiers are being stopped or disarmed: nothing precedes that.
        """
        if self._silencing_count:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        count = self._stop_count
        try:
            await self._gather(amplifier.clear() for amplifier in self._all)
        except LinkError:
            await self.stop()
            raise
        self._cleared_count = count

    async def close(self, silence: Mapping[str, SafeCommandSet]) -> None:
        """Play silence, confirm it by read-back, disarm and close; may be called twice."""
        is_armed = self.state is GroupState.ARMED
        self._leave_armed()
        self.state = GroupState.CLOSED
        async with self._closing:
            try:
                if is_armed:
                    await self._wind_down(silence)
                elif self._may_be_armed:
                    reachable = [amplifier for amplifier in self._all if not amplifier.is_lost]
                    await self._finish(retry_while_degraded(each.disarm) for each in reachable)
            except BaseException as error:
                await self.stop()
                if not isinstance(error, DriverError):
                    raise
                _logger.error("amplifiers: stopped, because closing failed: %s", error)
            finally:
                await self._close_wires()

    async def _wind_down(self, silence: Mapping[str, SafeCommandSet]) -> None:
        """Play silence, wait until every amplifier reports level zero, and disarm."""
        await gather_all(
            retry_while_degraded(partial(self._amplifiers[name].apply, safe))
            for name, safe in silence.items()
        )
        await asyncio.sleep(max(safe.ramp for safe in silence.values()))
        for _ in range(_READ_BACKS):
            statuses = await self._gather(retry_while_degraded(each.status) for each in self._all)
            if not any(level for status in statuses for level in status.levels):
                break
            await asyncio.sleep(_READ_BACK_INTERVAL)
        else:
            raise CommandRefused("an amplifier reports a level above zero after silence was played")
        await gather_all(retry_while_degraded(amplifier.disarm) for amplifier in self._all)

    async def _heartbeat(self) -> bool:
        """Send a heartbeat to every amplifier; always True."""
        await self._gather(
            _heartbeat(checked, self._may_play) for checked in self._checked.values()
        )
        return True

    async def _exchange(self, exchange: Coroutine[Any, Any, _T]) -> _T | None:
        """Run an exchange of the control loop; any failure stops all amplifiers.

        None after `abort_exchange`, or if it failed because of a disarm, stop or close.
        """
        limit = asyncio.timeout(None)
        try:
            try:
                with self._detecting_loss():
                    async with limit as self._limit:
                        return await exchange
            finally:
                self._limit = None
        except Exception as error:
            is_timeout = isinstance(error, TimeoutError) and limit.expired()
            if isinstance(error, Preempted) and limit.when() is not None:
                return None
            if is_timeout and not isinstance(error, LinkError):  # a LinkTimeout is both
                return None
            if isinstance(error, LinkDegraded):
                return None
            if isinstance(error, DriverError) and self.state not in (
                GroupState.ARMED,
                GroupState.LOST,
            ):
                return None
            self._leave_armed()
            with self._silencing():  # lost amplifiers are stopped, too, but not waited for
                await run_to_completion(self._quick_stops.stop(waits_for_lost=False))
            raise

    async def _gather(self, requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
        """Await the replies of all amplifiers."""
        with self._detecting_loss():
            return await gather_all(requests)

    async def _finish(self, requests: Iterable[Awaitable[object]]) -> None:
        """Run requests to completion, even if the caller is cancelled; only log failures."""
        await run_to_completion(_log_failures(requests))

    async def _close_wires(self) -> None:
        await self._finish(amplifier.close() for amplifier in self._all)

    @property
    def _all(self) -> Iterable[Amplifier]:
        return self._amplifiers.values()

    @property
    def _is_aborting(self) -> bool:
        return self._limit is not None and self._limit.when() is not None

    def _may_play(self) -> bool:
        return self.state is GroupState.ARMED and not self._is_aborting

    @contextmanager
    def _detecting_loss(self) -> Iterator[None]:
        """Enter the state LOST on a lost link, in which nothing is played."""
        try:
            yield
        except LinkDegraded:
            raise
        except LinkError:
            if self.state is not GroupState.CLOSED:
                self.state = GroupState.LOST
            raise

    @contextmanager
    def _silencing(self) -> Iterator[None]:
        """Refuse arming meanwhile."""
        self._silencing_count += 1
        try:
            yield
        finally:
            self._silencing_count -= 1

    def _leave_armed(self) -> None:
        """Leave ARMED for DISARMED, if armed, so that nothing more is played."""
        self._silence_count += 1
        if self.state is GroupState.ARMED:
            self.state = GroupState.DISARMED


async def _heartbeat(checked: CheckedAmplifier, may_feed: Callable[[], bool]) -> None:
    """Send a heartbeat unless its link is degraded or `may_feed` is false."""
    with suppress(LinkDegraded):
        await checked.heartbeat(may_feed=may_feed)


async def _log_failures(requests: Iterable[Awaitable[object]]) -> None:
    for result in await asyncio.gather(*requests, return_exceptions=True):
        if isinstance(result, Exception):
            _logger.warning("amplifiers: request failed: %s", result)
