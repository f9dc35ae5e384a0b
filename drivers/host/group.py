"""All amplifiers of a plate: they play together or not at all."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from drivers.contents import Layer, is_silence
from drivers.errors import CommandRefused, LinkError, Preempted
from drivers.host.amplifier import DISARM_RAMP, STOP_RAMP, WATCHDOG, Amplifier, Stopped
from drivers.host.comparison import name_of
from drivers.host.dialogue import Staged
from drivers.host.jobs import Priority
from drivers.host.joint_start import JointStart
from drivers.host.line import Line
from drivers.host.token_gaps import INTERVAL, close_gaps
from drivers.protocol.records import Values
from drivers.protocol.table import QUANTITIES, STATES
from drivers.protocol.tokens import token_after

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

        None of those that this has armed stays so if one fails. One session, so that a broadcast
        reaches all of a line. If all are armed, nothing changes.
        """
        if self.is_armed:
            return
        for amplifier in self.amplifiers.values():
            amplifier.check_other_host()  # before a disarm of what failed would end its vibration
        before = self._silences
        session = self._draw(_SESSION.minimum, _SESSION.maximum)
        members = [*self.amplifiers.values()]
        task = asyncio.gather(
            *(each.arm(session, watchdog) for each in members), return_exceptions=True
        )
        try:
            results = await asyncio.shield(task)
            errors = [each for each in results if isinstance(each, BaseException)]
            if errors:
                raise errors[0]
            if self._silences != before:
                raise Preempted("a stop or disarm came first; arm again if that is still wanted")
        except BaseException:
            results = await task
            # One that has refused was not armed by this, but perhaps by another host.
            await self._disarm(
                each
                for each, result in zip(members, results, strict=True)
                if not isinstance(result, CommandRefused)
            )
            raise
        self.is_armed = True

    async def apply(self, layers: Mapping[str, Sequence[Layer]]) -> Mapping[str, Staged]:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused. A lost link, silence that fails,
        and what goes wrong after the first commit stop all amplifiers. Silence alone is not staged.
        """
        self._check_armed()
        before = self._silences
        if self._token % INTERVAL == 0:
            self._token = await close_gaps(self.amplifiers.values(), self._token)
        self._token = token = token_after(self._token)
        is_silent = all(map(is_silence, layers.values()))
        is_committing = is_silent
        try:
            staged = await _all(
                self.amplifiers[name].stage(token, several, now=is_silent)
                for name, several in layers.items()
            )
            if self._silences != before or not self.is_armed:
                raise Preempted("a stop or disarm came first")
            is_committing = True
            if not is_silent:
                until = min(one.until for one in staged)
                statuses = await self._commit([*layers], token, until)
                for name, status, one in zip(layers, statuses, staged, strict=True):
                    _check_plays(name, status, one)
        except BaseException as error:
            is_kept = isinstance(error, CommandRefused) and not is_committing
            if self._silences == before and not is_kept:
                await self.stop()
            raise
        return dict(zip(layers, staged, strict=True))

    async def beat(self) -> None:
        """Feed the watchdog of every amplifier; what fails stops all of them.

        Raises CommandRefused, and feeds nothing, unless they are armed.
        """
        self._check_armed()
        before = self._silences
        try:
            await _all(amplifier.ping() for amplifier in self.amplifiers.values())
        except BaseException:
            if self._silences == before:
                await self.stop()
            raise

    def _check_armed(self) -> None:
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")

    async def silence(self, ramp: float) -> None:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed."""
        await _all(amplifier.silence(ramp) for amplifier in self.amplifiers.values())

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, read back from every amplifier.

        It goes on to its end if its caller is cancelled. Where one fails all are stopped.
        """
        self.is_armed = False
        self._silences += 1
        await asyncio.shield(
            asyncio.ensure_future(self._disarm(self.amplifiers.values(), ramp=ramp))
        )

    async def _disarm(self, members: Iterable[Amplifier], *, ramp: float = STOP_RAMP) -> None:
        results = await asyncio.gather(
            *(amplifier.disarm(ramp) for amplifier in members), return_exceptions=True
        )
        errors = [each for each in results if isinstance(each, BaseException)]
        if errors:
            await self.stop()
            raise errors[0]

    async def stop(self, ramp: float = STOP_RAMP) -> Mapping[str, Stopped]:
        """Stop every amplifier along a ramp [s], latched; what became of it, by name.

        Those of one line by a broadcast first. It goes on to its end if its caller is cancelled.
        """
        self.is_armed = False
        self._silences += 1
        members = [*self.amplifiers.values()]
        for line in {each.line for each in members if len(each.line.members) > 1}:
            values = {"ramp": members[0].wire_ramp(ramp)}
            line.submit(None, Priority.STOP, "Stop", values).add_done_callback(_seen)
        task = asyncio.gather(*(each.stop(ramp) for each in members), return_exceptions=True)
        stopped = [
            Stopped(False, each.feeding.may_play_until, repr(result))
            if isinstance(result, BaseException)
            else result
            for each, result in zip(members, await asyncio.shield(task), strict=True)
        ]
        return dict(zip(self.amplifiers, stopped, strict=True))

    async def clear(self) -> None:
        """Acknowledge the stops of all amplifiers; raises CommandRefused."""
        await _all(amplifier.clear() for amplifier in self.amplifiers.values())

    async def _commit(self, names: Sequence[str], token: int, until: float) -> list[Values]:
        """Commit on every line at one moment, by one broadcast where several share it.

        until: latest time [s] at which all must be sent.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        for name in names:
            by_line.setdefault(self.amplifiers[name].line, []).append(self.amplifiers[name])
        start = JointStart(len(by_line), until) if len(by_line) > 1 else None
        requests: dict[Amplifier, Awaitable[Values]] = {}
        for line, several in by_line.items():
            if len(several) > 1:
                make = partial(_commit_of, several, token)
                sent = line.submit(None, Priority.SET, "Commit", {}, make=make, start=start)
                sent.add_done_callback(_seen)
                requests.update((each, _status_of(each, token)) for each in several)
            else:
                requests.update((each, each.commit(token, start=start)) for each in several)
        order = [self.amplifiers[name] for name in names]
        return await _all(_awaited(requests[each]) for each in order)


def _commit_of(several: Sequence[Amplifier], token: int) -> Values:
    """Return the commit of all amplifiers of a line; raises unless each may play its set now."""
    for amplifier in several:
        amplifier.check_admitted(token)
    return {"session": several[0].session, "token": token}


def _seen(sent: "asyncio.Future[Values]") -> None:
    """Retrieve the error of a broadcast: what each amplifier says afterwards decides."""
    if not sent.cancelled():
        sent.exception()


def _check_plays(name: str, status: Values, staged: Staged) -> None:
    """Raise CommandRefused unless a status shows that a set plays, in each of its layers."""
    for one in staged.layers:
        is_lasting = any(command.level > 0 for command in one.commands) and not one.after
        if is_lasting and status["tokens"][one.layer] != staged.token:
            got = status["tokens"][one.layer]
            raise CommandRefused(
                f"amplifier {name}: token of layer {one.layer} must be {staged.token}, got {got}"
            )
    if status["token"] != staged.token or status["state"] != STATES["OPERATION_ENABLED"]:
        raise CommandRefused(
            f"amplifier {name}: token must be {staged.token} while armed, got {status['token']} in "
            f"state {name_of(STATES, status['state'])}"
        )


async def _status_of(amplifier: Amplifier, token: int) -> Values:
    """Read the status after a broadcast, and commit again where that was lost."""
    status = await amplifier.read_status(Priority.SET)
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
