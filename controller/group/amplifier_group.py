"""All amplifiers of a rig as one: they play together or not at all."""

import asyncio
import logging
from collections.abc import Awaitable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum, auto
from typing import Any, TypeVar

from controller.group.quick_stops import QuickStops
from controller.group.read_back_monitor import ReadBackMonitor
from controller.group.synchronized_play import SynchronizedPlay
from controller.group.tasks import gather_all, run_to_completion
from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.errors import CommandError, CommandRefused, DriverError, LinkError
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.link.turns import PATIENCE, Preempted
from drivers.operation.watchdog import check_watchdog
from drivers.protocol.messages import Achieved, AmplifierState

# How often, and how far apart [s], zero is looked for after the closing ramp has ended.
_READ_BACKS = 5
_READ_BACK_PAUSE = 0.010

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


class Phase(Enum):
    """How the amplifiers stand: CLOSED until opened and in the end, LOST after a LinkError."""

    CLOSED = auto()
    DISARMED = auto()
    ARMED = auto()
    LOST = auto()


class AmplifierGroup:
    """Amplifiers by their names in the rig, not yet open.

    A pattern with one ERA missing is another pattern: whatever goes wrong with one amplifier, all
    are stopped, before the error is raised. Nothing arms again by itself. Stopping is seen through
    to its end, also where the caller is cancelled meanwhile.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.phase = Phase.CLOSED
        self._amplifiers = dict(amplifiers)
        self._stops = QuickStops(self._amplifiers.values())
        self._joint = SynchronizedPlay(
            self._amplifiers,
            goes_on=lambda: self.phase is Phase.ARMED and not self._is_aborting_unsent,
        )
        self._closing = asyncio.Lock()  # who closes again must not hang up on who still silences
        self._silencings = 0  # how often they were disarmed, stopped or closed
        self._being_silenced = 0  # by how many who stop or disarm them just now
        self._may_be_armed = False  # since they were opened
        self._read_backs = ReadBackMonitor()
        self._limit: asyncio.Timeout | None = None  # of a play or heartbeat that is under way

    @property
    def last_sent(self) -> float:
        """When the last byte of the last set went out to any, by the event loop's clock [s]."""
        return self._joint.last_sent

    @property
    def is_set_incomplete(self) -> bool:
        """Whether a set may have been committed by some of them only."""
        return self._joint.is_set_incomplete

    @property
    def loading_time(self) -> float:
        """How long [s] it took to load the last envelopes."""
        return self._joint.loading_time

    @property
    def _is_aborting_unsent(self) -> bool:
        """Whether what is under way is to be given up."""
        return self._limit is not None and self._limit.when() is not None

    @property
    def _all(self) -> Iterable[Amplifier]:
        return self._amplifiers.values()

    async def open(self) -> None:
        """Open all; raises LinkError, and then none stays open.

        Also CommandError, for a wire that is too slow for the amplifiers' watchdog.
        """
        try:
            await gather_all(amplifier.open() for amplifier in self._all)
            for amplifier in self._all:
                check_watchdog(WATCHDOG, amplifier.round_trip())
        except BaseException:
            await self._close_wires()
            raise
        self.phase = Phase.DISARMED
        self._may_be_armed = False

    async def arm(self) -> None:
        """High voltage on, level zero: on all, or none stays armed."""
        if self.phase in (Phase.CLOSED, Phase.LOST):
            raise CommandError(
                "the amplifiers cannot be armed: they are closed, or one of them was lost; "
                "close what is left and open all again"
            )
        if self._being_silenced:  # the order of the frames would decide how it ends
            raise CommandRefused(
                "the amplifiers are just being stopped or disarmed; arm again if that is still "
                "wanted"
            )
        before = self._silencings
        self._may_be_armed = True
        try:
            await self._together(amplifier.arm() for amplifier in self._all)
            if self._silencings != before:
                raise CommandRefused(
                    "the amplifiers were disarmed, stopped or closed while they were being armed, "
                    "and stay disarmed; arm again if that is still wanted"
                )
        except BaseException:
            self._leave_armed()
            await run_to_completion(self._each(amplifier.disarm() for amplifier in self._all))
            raise
        self._read_backs.forget()
        self._joint.begin()
        self.phase = Phase.ARMED

    async def play(
        self,
        commands: Mapping[str, SafeCommandSet],
        *,
        envelopes: Mapping[str, Sequence[SafeEnvelope]] | None = None,
    ) -> dict[str, Achieved] | None:
        """Have every amplifier play its set; what they make of it, by name.

        envelopes: to be loaded before. None if they were disarmed, stopped or closed meanwhile, or
        `abort_unsent` ended it. Raises DriverError.
        """
        self._read_backs.forget()
        achieved = await self._or_stop(
            self._on_the_link(self._joint.play(commands, envelopes or {}))
        )
        if achieved is not None:
            self._read_backs.expect(commands, achieved, now=clock.now())
        return achieved

    async def heartbeat(self) -> bool:
        """Feed the watchdogs; raises DriverError.

        An amplifier that is not enabled any more is refused, as is one whose levels have differed
        from the commanded ones for 100 ms.

        False where `play` would give None.
        """
        return await self._or_stop(self._beat()) is not None

    def abort_unsent(self) -> None:
        """Let a `play` or `heartbeat` that is under way end within 8 ms, answered or not.

        Nothing more is asked for it meanwhile, but for silence, and nothing is asked again.
        """
        if self._limit is not None and not self._is_aborting_unsent:
            self._limit.reschedule(clock.now() + PATIENCE)
            for amplifier in self._all:
                amplifier.abort_unsent()

    async def disarm(self) -> None:
        """Silent along a short ramp, then high voltage off."""
        self._leave_armed()
        try:
            with self._silencing():
                await self._together(amplifier.disarm() for amplifier in self._all)
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Quick stop of every amplifier that can be reached; latched until `clear`.

        All who ask while one is being stopped have it stopped once more, together.
        """
        self._leave_armed()
        with self._silencing():
            await run_to_completion(self._each(self._stops.request()))

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause is gone."""
        try:
            await self._together(amplifier.clear() for amplifier in self._all)
        except LinkError:
            await self.stop()
            raise

    async def close(self, silence: Mapping[str, SafeCommandSet]) -> None:
        """Play silence, confirm it by reading back, disarm and close; safe to call twice."""
        armed = self.phase is Phase.ARMED
        self._leave_armed()
        self.phase = Phase.CLOSED
        async with self._closing:
            await self._close(silence, armed=armed)

    async def _close(self, silence: Mapping[str, SafeCommandSet], *, armed: bool) -> None:
        """Silence what was armed, and close; one after the other."""
        try:
            if armed:
                await self._wind_down(silence)
            elif self._may_be_armed:
                reachable = [amplifier for amplifier in self._all if not amplifier.is_lost]
                await run_to_completion(self._each(amplifier.disarm() for amplifier in reachable))
        except BaseException as error:
            await self.stop()
            if not isinstance(error, DriverError):
                raise
            _logger.error("the amplifiers could not be silenced in order: %s", error)
        finally:
            await self._close_wires()

    async def _wind_down(self, silence: Mapping[str, SafeCommandSet]) -> None:
        """Silence, proof of it, and high voltage off."""
        await gather_all(self._amplifiers[name].apply(safe) for name, safe in silence.items())
        await asyncio.sleep(max(safe.ramp for safe in silence.values()))
        for _ in range(_READ_BACKS):
            statuses = await self._on_the_link(self._joint.statuses())
            if not any(level for status in statuses.values() for level in status.levels):
                break
            await asyncio.sleep(_READ_BACK_PAUSE)
        else:
            raise CommandRefused("an amplifier reports a level after it was told to be silent")
        await gather_all(amplifier.disarm() for amplifier in self._all)

    async def _beat(self) -> bool:
        """A heartbeat to every amplifier; True, or CommandRefused from one that is not enabled."""
        replies = await self._together(amplifier.heartbeat() for amplifier in self._all)
        for name, status in zip(self._amplifiers, replies, strict=True):
            if status.state is not AmplifierState.OPERATION_ENABLED:
                raise CommandRefused(
                    f"amplifier {name} is in {status.state.name}, fault {status.fault.name}; "
                    "all were stopped: clear and arm again"
                )
            self._read_backs.check(name, status, now=clock.now())
        return True

    async def _or_stop(self, exchange: Coroutine[Any, Any, _T]) -> _T | None:
        """What the control loop wants of the amplifiers; if anything goes wrong, stop all of them.

        None if `abort_unsent` ended it, or if it failed for they were disarmed, stopped or closed.
        """
        try:
            return await self._unless_aborted(exchange)
        except Exception as error:
            if isinstance(error, DriverError) and self.phase not in (Phase.ARMED, Phase.LOST):
                return None
            await self.stop()
            raise

    async def _unless_aborted(self, exchange: Coroutine[Any, Any, _T]) -> _T | None:
        limit = asyncio.timeout(None)
        try:
            async with limit as self._limit:
                return await exchange
        except Preempted:
            if limit.when() is None:
                raise
            return None
        except TimeoutError as error:
            if limit.expired() and not isinstance(error, LinkError):  # a LinkTimeout is both
                return None
            raise
        finally:
            self._limit = None

    async def _together(self, requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
        """Wait for the replies of all."""
        return await self._on_the_link(gather_all(requests))

    async def _on_the_link(self, exchange: Coroutine[Any, Any, _T]) -> _T:
        """Ask amplifiers something; after a lost link nothing is played any more."""
        try:
            return await exchange
        except LinkError:
            if self.phase is not Phase.CLOSED:
                self.phase = Phase.LOST
            raise

    async def _each(self, requests: Iterable[Awaitable[object]]) -> None:
        """Do something with every amplifier that can be reached; failures are only logged."""
        for result in await asyncio.gather(*requests, return_exceptions=True):
            if isinstance(result, Exception):
                _logger.warning("an amplifier did not follow: %s", result)

    async def _close_wires(self) -> None:
        """Close every wire, whatever the others say."""
        await run_to_completion(self._each(amplifier.close() for amplifier in self._all))

    @contextmanager
    def _silencing(self) -> Iterator[None]:
        """Nobody can arm meanwhile."""
        self._being_silenced += 1
        try:
            yield
        finally:
            self._being_silenced -= 1

    def _leave_armed(self) -> None:
        """Nothing more is played from here on; lost or closed amplifiers stay that."""
        self._silencings += 1
        if self.phase is Phase.ARMED:
            self.phase = Phase.DISARMED
