"""All amplifiers of a rig as one: they play together or not at all."""

import asyncio
import logging
from collections.abc import Coroutine, Iterable, Mapping
from enum import Enum, auto
from typing import Any, TypeVar

from drivers.amplifier import Amplifier
from drivers.errors import CommandError, CommandRefused, DriverError, LinkError
from drivers.guard import SafeCommand
from drivers.protocol.messages import Achieved, State, Status

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
    are stopped, before the error is raised. Nothing arms again by itself.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.phase = Phase.CLOSED
        self._amplifiers = dict(amplifiers)

    @property
    def last_sent(self) -> float:
        """When the last byte went out to any of them, on time.monotonic() [s]."""
        return max(amplifier.last_sent for amplifier in self._amplifiers.values())

    async def open(self) -> None:
        """Open all; raises LinkError, and then none stays open."""
        try:
            await _all(amplifier.open() for amplifier in self._amplifiers.values())
        except BaseException:
            await self._close_wires()
            raise
        self.phase = Phase.DISARMED

    async def arm(self) -> None:
        """High voltage on, level zero: on all, or none stays armed."""
        if self.phase in (Phase.CLOSED, Phase.LOST):
            raise CommandError(
                "the amplifiers cannot be armed: they are closed, or one of them was lost; "
                "close what is left and open all again"
            )
        try:
            await self._together(amplifier.arm() for amplifier in self._amplifiers.values())
        except BaseException:
            await self._each(amplifier.disarm() for amplifier in self._amplifiers.values())
            raise
        self.phase = Phase.ARMED

    async def play(self, commands: Mapping[str, SafeCommand]) -> dict[str, Achieved] | None:
        """Have every amplifier play its set; what they make of it, by name.

        None if they were disarmed, stopped or closed meanwhile. Raises DriverError.
        """
        try:
            return await self._play(commands)
        except DriverError as error:
            await self._stop_unless_over(error)
            return None

    async def heartbeat(self) -> None:
        """Feed the watchdogs and see that every amplifier still is enabled; raises DriverError."""
        try:
            replies = await self._together(
                amplifier.heartbeat() for amplifier in self._amplifiers.values()
            )
            for name, status in zip(self._amplifiers, replies, strict=True):
                if status.state is not State.OPERATION_ENABLED:
                    raise CommandRefused(
                        f"amplifier {name} is in {status.state.name}, fault {status.fault.name}; "
                        "all were stopped: clear and arm again"
                    )
        except DriverError as error:
            await self._stop_unless_over(error)

    async def disarm(self) -> None:
        """Silent along a short ramp, then high voltage off."""
        self._leave_armed()
        await self._together(amplifier.disarm() for amplifier in self._amplifiers.values())

    async def stop(self) -> None:
        """Quick stop of every amplifier that can be reached; latched until `clear`."""
        self._leave_armed()
        await self._each(amplifier.stop() for amplifier in self._amplifiers.values())

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause is gone."""
        await self._together(amplifier.clear() for amplifier in self._amplifiers.values())

    async def close(self, silence: Mapping[str, SafeCommand]) -> None:
        """Play silence, confirm it by reading back, disarm and close; safe to call twice."""
        armed = self.phase is Phase.ARMED
        self.phase = Phase.CLOSED
        try:
            if armed:
                await self._wind_down(silence)
        except DriverError as error:
            _logger.error("the amplifiers could not be silenced in order: %s", error)
            await self._each(amplifier.stop() for amplifier in self._amplifiers.values())
        finally:
            await self._close_wires()

    async def _play(self, commands: Mapping[str, SafeCommand]) -> dict[str, Achieved] | None:
        if len(commands) == 1:
            ((name, safe),) = commands.items()
            (single,) = await self._together([self._amplifiers[name].apply(safe)])
            return {name: single}
        await self._together(self._amplifiers[name].stage(safe) for name, safe in commands.items())
        if self.phase is not Phase.ARMED:
            return None  # a commit now would undo the silence that came in between
        achieved = await self._together(
            self._amplifiers[name].commit(safe.token) for name, safe in commands.items()
        )
        for name, status in (await self._statuses()).items():
            if status.token != commands[name].token:
                raise CommandRefused(
                    f"amplifier {name} plays set {status.token} instead of {commands[name].token}"
                )
        return dict(zip(commands, achieved, strict=True))

    async def _wind_down(self, silence: Mapping[str, SafeCommand]) -> None:
        """Silence, proof of it, and high voltage off."""
        await _all(self._amplifiers[name].apply(safe) for name, safe in silence.items())
        await asyncio.sleep(max(safe.ramp for safe in silence.values()))
        for _ in range(_READ_BACKS):
            statuses = await self._statuses()
            if not any(level for status in statuses.values() for level in status.levels):
                break
            await asyncio.sleep(_READ_BACK_PAUSE)
        else:
            raise CommandRefused("an amplifier reports a level after it was told to be silent")
        await _all(amplifier.disarm() for amplifier in self._amplifiers.values())

    async def _stop_unless_over(self, error: DriverError) -> None:
        """Stop all for an error and raise it, unless it comes of having stopped already."""
        if self.phase is Phase.ARMED:
            await self.stop()
            raise error
        if self.phase is Phase.LOST:
            raise error

    async def _statuses(self) -> dict[str, Status]:
        """The status of every amplifier, by name."""
        statuses = await self._together(
            amplifier.status() for amplifier in self._amplifiers.values()
        )
        return dict(zip(self._amplifiers, statuses, strict=True))

    async def _together(self, requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
        """Wait for the replies of all; a lost link stops the others before it is raised."""
        try:
            return await _all(requests)
        except LinkError:
            if self.phase is not Phase.CLOSED:
                self.phase = Phase.LOST
            await self._each(amplifier.stop() for amplifier in self._amplifiers.values())
            raise

    async def _each(self, requests: Iterable[Coroutine[Any, Any, object]]) -> None:
        """Do something with every amplifier that can be reached; failures are only logged."""
        for result in await asyncio.gather(*requests, return_exceptions=True):
            if isinstance(result, Exception):
                _logger.warning("an amplifier did not follow: %s", result)

    async def _close_wires(self) -> None:
        """Close every wire, whatever the others say."""
        await self._each(amplifier.close() for amplifier in self._amplifiers.values())

    def _leave_armed(self) -> None:
        """Nothing more is played from here on; lost or closed amplifiers stay that."""
        if self.phase is Phase.ARMED:
            self.phase = Phase.DISARMED


async def _all(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Wait for all, then raise the gravest of what they raised: a lost link before a refusal."""
    results = await asyncio.gather(*requests, return_exceptions=True)
    failures = [result for result in results if isinstance(result, BaseException)]
    if failures:
        raise next((error for error in failures if isinstance(error, LinkError)), failures[0])
    return [result for result in results if not isinstance(result, BaseException)]
