"""All amplifiers of a plate: they play together or not at all."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from drivers.contents import Layer
from drivers.errors import CommandRefused, LinkError, Preempted
from drivers.host.amplifier import DISARM_RAMP, STOP_RAMP, WATCHDOG, Amplifier, Staged, Stopped
from drivers.host.line import Line
from drivers.protocol.definition import token_after
from drivers.protocol.records import Values
from drivers.protocol.table import QUANTITIES

_T = TypeVar("_T")
_SESSION, _TOKEN = QUANTITIES["session"], QUANTITIES["token"]


class Group:
    """Amplifiers by name. A failure of one stops all of them; nothing arms by itself.

    draw: of session numbers and of the first token, so that none of an earlier host is repeated.
    """

    def __init__(
        self,
        amplifiers: Mapping[str, Amplifier],
        *,
        draw: Callable[[int, int], int] = random.randint,
    ) -> None:
        self.amplifiers = dict(amplifiers)
        self.is_armed = False
        self._draw = draw
        self._token = draw(_TOKEN.minimum, _TOKEN.maximum)
        self._silences = 0  # stops and disarms so far

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed; raises LinkError."""
        await _all(amplifier.open() for amplifier in self.amplifiers.values())

    async def arm(self, watchdog: float = WATCHDOG) -> None:
        """Switch the high voltage on at level zero on all amplifiers; watchdog [s].

        None stays armed if one fails. One session, so that a broadcast reaches all of a line.
        """
        for amplifier in self.amplifiers.values():
            amplifier.check_other_host()  # before a disarm of what failed would end its vibration
        before = self._silences
        session = self._draw(_SESSION.minimum, _SESSION.maximum)
        try:
            await _all(each.arm(session, watchdog) for each in self.amplifiers.values())
            if self._silences != before:
                raise Preempted("a stop or disarm came first; arm again if that is still wanted")
        except BaseException:
            await self.disarm(STOP_RAMP)
            raise
        self.is_armed = True

    async def apply(self, layers: Mapping[str, Sequence[Layer]]) -> Mapping[str, Staged]:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused. What goes wrong after the first
        commit stops all amplifiers.
        """
        before = self._silences
        self._token = token = token_after(self._token)
        staged = await _all(
            self.amplifiers[name].stage(token, several) for name, several in layers.items()
        )
        if self._silences != before or not self.is_armed:
            raise Preempted("a stop or disarm came first")
        try:
            statuses = await self._commit([*layers], token)
            for name, status in zip(layers, statuses, strict=True):
                if status["token"] != token:
                    raise CommandRefused(
                        f"amplifier {name}: token must be {token}, got {status['token']}"
                    )
        except BaseException:
            if self._silences == before:
                await self.stop()
            raise
        return dict(zip(layers, staged, strict=True))

    async def beat(self) -> None:
        """Feed the watchdog of every amplifier; what fails stops all of them."""
        before = self._silences
        try:
            await _all(amplifier.ping() for amplifier in self.amplifiers.values())
        except BaseException:
            if self._silences == before:
                await self.stop()
            raise

    async def silence(self, ramp: float) -> None:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed."""
        await _all(amplifier.silence(ramp) for amplifier in self.amplifiers.values())

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, on every amplifier that replies."""
        self.is_armed = False
        self._silences += 1
        results = await asyncio.gather(
            *(amplifier.disarm(ramp) for amplifier in self.amplifiers.values()),
            return_exceptions=True,
        )
        for result in results:
            if isinstance(result, BaseException):
                raise result

    async def stop(self, ramp: float = STOP_RAMP) -> Mapping[str, Stopped]:
        """Stop every amplifier along a ramp [s], latched; what became of it, by name.

        It goes on to its end if its caller is cancelled.
        """
        self.is_armed = False
        self._silences += 1
        task = asyncio.gather(*(each.stop(ramp) for each in self.amplifiers.values()))
        stopped = await asyncio.shield(task)
        return dict(zip(self.amplifiers, stopped, strict=True))

    async def clear(self) -> None:
        """Acknowledge the stops of all amplifiers; raises CommandRefused."""
        await _all(amplifier.clear() for amplifier in self.amplifiers.values())

    async def _commit(self, names: Sequence[str], token: int) -> list[Values]:
        """Commit on every line at one moment, by one broadcast where several share it."""
        by_line: dict[Line, list[Amplifier]] = {}
        for name in names:
            by_line.setdefault(self.amplifiers[name].line, []).append(self.amplifiers[name])
        requests: dict[Amplifier, Awaitable[Values]] = {}
        for line, several in by_line.items():
            if len(several) > 1 and line.is_free:
                line.broadcast("Commit", {"session": several[0].session, "token": token})
                requests.update((each, _status_of(each, token)) for each in several)
            else:
                requests.update((each, each.commit(token)) for each in several)
        order = [self.amplifiers[name] for name in names]
        return await _all(_awaited(requests[each]) for each in order)

    @property
    def may_play_until(self) -> float:
        """When the watchdog of every amplifier must have silenced it [s], if nothing feeds it."""
        return max(each.feeding.may_play_until for each in self.amplifiers.values())


async def _status_of(amplifier: Amplifier, token: int) -> Values:
    """Read the status after a broadcast, and commit again where that was lost."""
    status = await amplifier.read_status()
    return status if status["token"] == token else await amplifier.commit(token)


async def _awaited(request: Awaitable[_T]) -> _T:
    return await request


async def _all(requests: "Any") -> list[Any]:
    """Await all requests to their ends, then raise the first error, a lost link before others."""
    coroutines: list[Coroutine[Any, Any, Any]] = [*requests]
    if len(coroutines) == 1:
        return [await coroutines[0]]
    results = await asyncio.gather(*coroutines, return_exceptions=True)
    errors = [each for each in results if isinstance(each, BaseException)]
    if errors:
        raise next((each for each in errors if isinstance(each, LinkError)), errors[0])
    return results
