"""All amplifiers of a rig as one: they play together or not at all."""

import asyncio
import logging
from collections.abc import Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum, auto
from functools import partial
from typing import Any, TypeVar

from controller.read_backs import ReadBacks
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.errors import CommandError, CommandRefused, DriverError, LinkError
from drivers.guard import SafeCommand, SafeEnvelope
from drivers.protocol.messages import Achieved, State, Status
from drivers.simultaneous import at_one_moment
from drivers.turns import PATIENCE
from drivers.watchdog import check_watchdog

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
        self.loading_time = 0.0  # s; that of the last envelopes
        self.is_torn = False  # whether a set may have been committed by some of them only
        self._amplifiers = dict(amplifiers)
        self._closing = asyncio.Lock()  # who closes again must not hang up on who still silences
        self._silencings = 0  # how often they were disarmed, stopped or closed
        self._being_silenced = 0  # by how many who stop or disarm them just now
        self._may_be_armed = False  # since they were opened
        self._read_backs = ReadBacks()
        self._limit: asyncio.Timeout | None = None  # of a play or heartbeat that is under way

    @property
    def last_sent(self) -> float:
        """When the last byte went out to any of them, on time.monotonic() [s]."""
        return max(amplifier.last_sent for amplifier in self._all)

    @property
    def _all(self) -> Iterable[Amplifier]:
        return self._amplifiers.values()

    async def open(self) -> None:
        """Open all; raises LinkError, and then none stays open.

        Also CommandError, for a wire that is too slow for the amplifiers' watchdog.
        """
        try:
            await _gathered(amplifier.open() for amplifier in self._all)
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
            await _to_the_end(self._each(amplifier.disarm() for amplifier in self._all))
            raise
        self._read_backs.forget()
        self.is_torn = False
        self.phase = Phase.ARMED

    async def play(
        self,
        commands: Mapping[str, SafeCommand],
        *,
        envelopes: Mapping[str, Sequence[SafeEnvelope]] | None = None,
    ) -> dict[str, Achieved] | None:
        """Have every amplifier play its set; what they make of it, by name.

        envelopes: to be loaded before. None if they were disarmed, stopped or closed meanwhile, or
        `hurry` ended it. Raises DriverError.
        """
        self._read_backs.forget()
        achieved = await self._or_stop(self._play(commands, envelopes or {}))
        if achieved is not None:
            now = asyncio.get_running_loop().time()
            self._read_backs.expect(commands, achieved, now=now)
        return achieved

    async def heartbeat(self) -> bool:
        """Feed the watchdogs; raises DriverError.

        An amplifier that is not enabled any more is refused, as is one whose levels have differed
        from the commanded ones for 100 ms.

        False where `play` would give None.
        """
        return await self._or_stop(self._beat()) is not None

    def hurry(self) -> None:
        """Let a `play` or `heartbeat` that is under way end within 8 ms, answered or not."""
        if self._limit is not None and self._limit.when() is None:
            self._limit.reschedule(asyncio.get_running_loop().time() + PATIENCE)

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
        """Quick stop of every amplifier that can be reached; latched until `clear`."""
        self._leave_armed()
        with self._silencing():
            await _to_the_end(self._each(amplifier.stop() for amplifier in self._all))

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause is gone."""
        try:
            await self._together(amplifier.clear() for amplifier in self._all)
        except LinkError:
            await self.stop()
            raise

    async def close(self, silence: Mapping[str, SafeCommand]) -> None:
        """Play silence, confirm it by reading back, disarm and close; safe to call twice."""
        armed = self.phase is Phase.ARMED
        self._leave_armed()
        self.phase = Phase.CLOSED
        async with self._closing:
            await self._close(silence, armed=armed)

    async def _close(self, silence: Mapping[str, SafeCommand], *, armed: bool) -> None:
        """Silence what was armed, and close; one after the other."""
        try:
            if armed:
                await self._wind_down(silence)
            elif self._may_be_armed:
                reachable = [amplifier for amplifier in self._all if not amplifier.lost]
                await _to_the_end(self._each(amplifier.disarm() for amplifier in reachable))
        except BaseException as error:
            await self.stop()
            if not isinstance(error, DriverError):
                raise
            _logger.error("the amplifiers could not be silenced in order: %s", error)
        finally:
            await self._close_wires()

    async def _play(
        self,
        commands: Mapping[str, SafeCommand],
        envelopes: Mapping[str, Sequence[SafeEnvelope]],
    ) -> dict[str, Achieved] | None:
        if any(envelopes.values()):
            begin = asyncio.get_running_loop().time()
            await self._together(self._load(name, each) for name, each in envelopes.items())
            self.loading_time = asyncio.get_running_loop().time() - begin
            if self.phase is not Phase.ARMED:
                return None  # whatever is played now would undo the silence that came in between
        if len(commands) == 1 or all(safe.is_silent for safe in commands.values()):
            # One has nobody to wait for, and silence waits for nobody.
            applied = await self._together(
                self._amplifiers[name].apply(safe) for name, safe in commands.items()
            )
            self.is_torn = False
            return dict(zip(commands, applied, strict=True))
        achieved = await self._together(
            self._amplifiers[name].stage(safe) for name, safe in commands.items()
        )
        if self.phase is not Phase.ARMED:
            return None  # a commit now would undo the silence that came in between
        self.is_torn = True
        await self._together(self._commits(commands))
        for name, status in (await self._statuses()).items():
            if status.token != commands[name].token:
                raise CommandRefused(
                    f"amplifier {name} plays set {status.token} instead of {commands[name].token}"
                )
        self.is_torn = False
        return dict(zip(commands, achieved, strict=True))

    async def _load(self, name: str, envelopes: Sequence[SafeEnvelope]) -> None:
        for envelope in envelopes:
            if self.phase is not Phase.ARMED:
                return  # nothing will be played
            await self._amplifiers[name].load_envelope(envelope)

    def _commits(self, sets: Mapping[str, SafeCommand]) -> Iterable[Coroutine[Any, Any, object]]:
        """Commit everything that is staged, to arrive at one moment; once where a bus is shared."""
        together: dict[tuple[str, int], list[Amplifier]] = {}
        for name, safe in sets.items():
            amplifier = self._amplifiers[name]
            together.setdefault((amplifier.bus or name, safe.token), []).append(amplifier)
        return at_one_moment(
            [
                (first, partial(first.commit_on_bus if others else first.commit, token))
                for (_, token), (first, *others) in together.items()
            ]
        )

    async def _wind_down(self, silence: Mapping[str, SafeCommand]) -> None:
        """Silence, proof of it, and high voltage off."""
        await _gathered(self._amplifiers[name].apply(safe) for name, safe in silence.items())
        await asyncio.sleep(max(safe.ramp for safe in silence.values()))
        for _ in range(_READ_BACKS):
            statuses = await self._statuses()
            if not any(level for status in statuses.values() for level in status.levels):
                break
            await asyncio.sleep(_READ_BACK_PAUSE)
        else:
            raise CommandRefused("an amplifier reports a level after it was told to be silent")
        await _gathered(amplifier.disarm() for amplifier in self._all)

    async def _beat(self) -> bool:
        """A heartbeat to every amplifier; True, or CommandRefused from one that is not enabled."""
        replies = await self._together(amplifier.heartbeat() for amplifier in self._all)
        for name, status in zip(self._amplifiers, replies, strict=True):
            if status.state is not State.OPERATION_ENABLED:
                raise CommandRefused(
                    f"amplifier {name} is in {status.state.name}, fault {status.fault.name}; "
                    "all were stopped: clear and arm again"
                )
            self._read_backs.check(name, status, now=asyncio.get_running_loop().time())
        return True

    async def _or_stop(self, exchange: Coroutine[Any, Any, _T]) -> _T | None:
        """What the control loop wants of the amplifiers; if anything goes wrong, stop all of them.

        None if `hurry` ended it, or if it failed for they were disarmed, stopped or closed.
        """
        try:
            return await self._unless_hurried(exchange)
        except Exception as error:
            if isinstance(error, DriverError) and self.phase not in (Phase.ARMED, Phase.LOST):
                return None
            await self.stop()
            raise

    async def _unless_hurried(self, exchange: Coroutine[Any, Any, _T]) -> _T | None:
        limit = asyncio.timeout(None)
        try:
            async with limit as self._limit:
                return await exchange
        except TimeoutError as error:
            if limit.expired() and not isinstance(error, LinkError):  # a LinkTimeout is both
                return None
            raise
        finally:
            self._limit = None

    async def _statuses(self) -> dict[str, Status]:
        """The status of every amplifier, by name."""
        statuses = await self._together(amplifier.status() for amplifier in self._all)
        return dict(zip(self._amplifiers, statuses, strict=True))

    async def _together(self, requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
        """Wait for the replies of all; after a lost link nothing is played any more."""
        try:
            return await _gathered(requests)
        except LinkError:
            if self.phase is not Phase.CLOSED:
                self.phase = Phase.LOST
            raise

    async def _each(self, requests: Iterable[Coroutine[Any, Any, object]]) -> None:
        """Do something with every amplifier that can be reached; failures are only logged."""
        for result in await asyncio.gather(*requests, return_exceptions=True):
            if isinstance(result, Exception):
                _logger.warning("an amplifier did not follow: %s", result)

    async def _close_wires(self) -> None:
        """Close every wire, whatever the others say."""
        await _to_the_end(self._each(amplifier.close() for amplifier in self._all))

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


async def _gathered(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Wait for all, then raise the gravest of what they raised: a lost link before a refusal.

    A single one goes out at once, without a turn of the event loop in between.
    """
    pending = list(requests)
    if len(pending) == 1:
        return [await pending[0]]
    results = await asyncio.gather(*pending, return_exceptions=True)
    failures = [result for result in results if isinstance(result, BaseException)]
    if failures:
        raise next((error for error in failures if isinstance(error, LinkError)), failures[0])
    return [result for result in results if not isinstance(result, BaseException)]


async def _to_the_end(work: Coroutine[Any, Any, None]) -> None:
    """See work through, also where the caller is cancelled meanwhile; that is raised afterwards."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise
