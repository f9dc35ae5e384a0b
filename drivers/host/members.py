"""The amplifiers of a group: which reply, which are lost, and what they play together.

A set is staged on all amplifiers that it names, then committed at one moment, or on none. A token
is newer than another by less than half of 2^16 (RFC 1982): an amplifier that was left out of 40 000
sets would take the next one for an older one. It commits one that changes nothing before.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from typing import Any, TypeVar

from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    LinkTimeout,
    Preempted,
)
from drivers.host.amplifier import Amplifier
from drivers.host.dialogue import Staged
from drivers.host.jobs import JointStart, Priority
from drivers.host.ledger import is_silence
from drivers.host.line import Line
from drivers.host.stop import Stopped
from drivers.playing.contents import Layer
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, token_after
from drivers.protocol.table import LATCHED, STATES, name_of
from drivers.protocol.timing import STOP_RAMP
from registry import clock

INTERVAL = 1 << 12
"""Tokens after which the gaps are looked at again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16
_T = TypeVar("_T")


@dataclass(frozen=True)
class Played:
    """What amplifiers play of a set, by name, as they have achieved it; token: of the set.

    sent_at [s]: when the last commit went out.
    """

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    sent_at: float


class GroupState(Enum):
    """State of all amplifiers together: CLOSED until opened and in the end, LOST by a LinkError.

    STOPPED: disarmed by a stop, which is to be cleared before they are armed.
    """

    CLOSED = auto()
    DISARMED = auto()
    STOPPED = auto()
    ARMED = auto()
    LOST = auto()


class Members:
    """Amplifiers by name, the sets of all of them under tokens from a first one on, and stops."""

    def __init__(self, amplifiers: Mapping[str, Amplifier], token: int) -> None:
        self.amplifiers = dict(amplifiers)
        self.state = GroupState.CLOSED
        self.token = token
        """Of the last set."""
        self.is_set_incomplete = False
        """Whether possibly only some amplifiers have committed the last set."""
        self.epoch = 0
        """Stops, disarms and closes so far: nothing from before arms, plays or feeds after one."""
        self._limit: asyncio.Timeout | None = None  # of an exchange in progress

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        return tuple(
            name
            for name, each in self.amplifiers.items()
            if each.silence_cause is not None and not is_lost(each)
        )

    @property
    def lost_by(self) -> Mapping[str, str]:
        """Causes by name of amplifiers that must be silent without a reply, or without a line."""
        return {
            name: each.line.loss or each.silence_cause or ""
            for name, each in self.amplifiers.items()
            if is_lost(each)
        }

    @property
    def lost_from(self) -> float:
        """When [s] the next beat stops all, since one that does not reply must be silent."""
        first = math.inf
        for each in self.amplifiers.values():
            if each.silence_cause is not None:
                first = min(first, each.feeding.lost_from)
        return first

    @property
    def last_sent_at(self) -> float:
        """When [s] a set or silence was last sent to any amplifier."""
        return max((each.played_at for each in self.amplifiers.values()), default=-math.inf)

    @property
    def is_open(self) -> bool:
        """Whether all reply as far as is known: neither closed nor lost."""
        return self.state not in (GroupState.CLOSED, GroupState.LOST)

    @property
    def is_armed(self) -> bool:
        """Whether layers may be played."""
        return self.state is GroupState.ARMED

    @property
    def by_need(self) -> list[str]:
        """All names, first that of the one that was fed longest ago: replies may come late."""
        return sorted(self.amplifiers, key=lambda name: self.amplifiers[name].feeding.since)

    def lose(self) -> None:
        """Enter the state LOST, in which nothing is played."""
        if self.state is not GroupState.CLOSED:
            self.state = GroupState.LOST

    def stop(
        self, ramp: float = STOP_RAMP, *, waits_for: Sequence[str] | None = None
    ) -> Coroutine[Any, Any, Mapping[str, Stopped]]:
        """Stop every amplifier along a ramp [s]."""
        raise NotImplementedError

    def is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error says no more than that an amplifier does not reply for now."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    def note(self, error: BaseException) -> None:
        """Note an error of a request: it may show that an amplifier is lost."""
        if isinstance(error, LinkError) and not self.is_degraded_only(error):
            error.lost = tuple(self.lost_by)
            self.lose()

    def check_none_since(self, before: int) -> None:
        """Raise Preempted if a stop, disarm or close has come since an epoch."""
        if self.epoch != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    async def all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error."""
        try:
            if len(requests) == 1:  # without a further iteration of the event loop
                return [await requests[0]]
            return self.checked(await asyncio.gather(*requests, return_exceptions=True))
        except LinkError as error:
            self.note(error)
            raise

    def checked(self, results: Sequence[_T | BaseException]) -> list[_T]:
        """Return results; raises the most severe error.

        A lost link is first; last are what others have preempted and, after it, a degraded link.
        """
        good: list[_T] = []
        errors: list[BaseException] = []
        for each in results:
            if isinstance(each, BaseException):
                errors.append(each)
            else:
                good.append(each)
        if errors:
            raise min(errors, key=self._severity)
        return good

    def _severity(self, error: BaseException) -> int:
        if self.is_degraded_only(error):
            return 3
        if isinstance(error, Preempted):  # by the cause, which is to be told
            return 2
        return 0 if isinstance(error, LinkError) else 1

    def apply(self, layers: Mapping[str, Sequence[Layer]]) -> Coroutine[Any, Any, Played]:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused; silence alone is not staged. One
        that is no longer armed does not refuse a set: it stops all.
        Raises Preempted where a stop, disarm or `abort_exchange` came first, and LinkDegraded where
        one does not reply: then it is unknown whether the set plays. What else fails stops all
        amplifiers before it is raised.
        """
        return self._exchange(partial(self._play, layers))

    async def silence(self, ramp: float) -> float:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed.

        Returns when [s] the last request went out. Raises as `apply`.
        """
        await self._exchange(lambda: self._silence(ramp))
        return self.last_sent_at

    async def _silence(self, ramp: float) -> None:
        # On a line that they share none waits for one that does not reply: that comes last.
        members = [self.amplifiers[name] for name in self.by_need]
        members.sort(key=lambda each: each.silence_cause is not None)
        await self.all([each.silence(ramp) for each in members])
        self.is_set_incomplete = False

    def abort_exchange(self) -> None:
        """End an `apply`, `silence` or `beat` in progress, so that silence can be sent next.

        What was not sent is not sent any more; a request on the wire is waited for at most 8 ms.
        """
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(clock.now())

    async def _exchange(self, exchange: Callable[[], Awaitable[_T | DriverError]]) -> _T:
        """Run an exchange of the control loop; any unexplained failure stops all amplifiers.

        An error that it returns stops none.
        """
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")
        before = self.epoch
        limit = asyncio.timeout(None)
        try:
            try:
                async with limit as self._limit:
                    done = await exchange()
            finally:
                self._limit = None
        except Exception as error:
            self.note(error)
            is_lost = isinstance(error, LinkTimeout) and self.state is GroupState.LOST
            if limit.expired() and isinstance(error, TimeoutError | Preempted) and not is_lost:
                raise Preempted("given up, since silence comes first") from error
            if self.is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            is_explained = self.epoch != before and self.state is not GroupState.LOST
            if is_explained and isinstance(error, DriverError):
                raise Preempted("a stop or disarm came first") from error
            replying = [name for name, each in self.amplifiers.items() if not each.silence_cause]
            await self.stop(waits_for=replying)
            if is_lost:  # also where it was degraded when this began
                raise LinkTimeout(next(iter(self.lost_by.values()), str(error))) from error
            raise
        if isinstance(done, DriverError):
            raise done
        return done

    async def _play(self, layers: Mapping[str, Sequence[Layer]]) -> Played | DriverError:
        """Stage and commit layers by amplifier; a refusal before the first commit is returned.

        Preempted where a commit that was lost is too late to be repeated: then all are silent.
        """
        before = self.epoch
        if self.token % INTERVAL == 0:
            await self._close_gaps()
        self.token = token = token_after(self.token)
        is_silent = all(map(is_silence, layers.values()))
        staging: list[Awaitable[Staged]] = []
        layers = {name: layers[name] for name in self.by_need if name in layers}
        for name, of_one in layers.items():
            staging.append(self.amplifiers[name].stage(token, of_one, now=is_silent))
        results: list[Staged | BaseException]
        if len(staging) == 1:  # as in `all`
            try:
                results = [await staging[0]]
            except DriverError as error:
                results = [error]
        else:
            results = await asyncio.gather(*staging, return_exceptions=True)
        refusals: dict[str, CommandRefused] = {}
        has_failed = is_silent
        for name, result in zip(layers, results, strict=True):
            if isinstance(result, CommandRefused) and not result.is_disarmed:
                if not isinstance(result, Preempted):
                    refusals[name] = result
            elif isinstance(result, BaseException):
                has_failed = True
        if refusals and not has_failed:
            return _merged(refusals)
        staged = dict(zip(layers, self.checked(results), strict=True))
        if not is_silent:
            self.check_none_since(before)
            self.is_set_incomplete = len(layers) > 1
            began = clock.now()
            try:
                await self._commit(staged)
            except CommandRefused as refusal:
                if refusal.until is None or self.epoch != before:
                    raise
                # Too late for what the ledgers have admitted.
                if any(self.amplifiers[name].played_at >= began for name in staged):
                    await self._silence(STOP_RAMP)
                    return Preempted(str(refusal))
                self.is_set_incomplete = False
                return refusal
        self.is_set_incomplete = False
        played: dict[str, tuple[LayerSet, ...]] = {}
        inexact: list[str] = []
        sent_at = -math.inf
        for name, one in staged.items():
            played[name], sent_at = one.layers, max(sent_at, self.amplifiers[name].played_at)
            if not one.is_exact:
                inexact.append(name)
        if inexact:
            reading = [_achieved(self.amplifiers[name], staged[name]) for name in inexact]
            played.update(zip(inexact, await self.all(reading), strict=True))
        return Played(token, played, sent_at)

    async def _commit(self, staged: Mapping[str, Staged]) -> None:
        """Commit on every line at one moment, by one broadcast where amplifiers share it.

        Raises CommandRefused where one does not play its set then.
        """
        token, until = self.token, math.inf
        by_line: dict[Line, list[str]] = {}
        for name, one in staged.items():
            by_line.setdefault(self.amplifiers[name].line, []).append(name)
            until = min(until, one.until)
        start = None
        if len(by_line) > 1:
            start = JointStart(len(by_line), until=until)
        requests: dict[str, Awaitable[Values]] = {}
        broadcasts: list[Awaitable[Values]] = []
        for line, sharing in by_line.items():
            if len(sharing) == 1:
                requests[sharing[0]] = self.amplifiers[sharing[0]].commit(token, start=start)
                continue
            make = partial(_commit_of, [self.amplifiers[name] for name in sharing], token)
            sent = line.submit(None, Priority.SET, "Commit", {}, make=make, start=start)
            broadcasts.append(sent)
            for name in sharing:
                requests[name] = _status_of(self.amplifiers[name], token, sent)
        # With the broadcasts: one that waits is not sent where this is given up.
        statuses = await self.all([*requests.values(), *broadcasts])
        for name, status in zip(requests, statuses, strict=False):
            await _check_plays(self.amplifiers[name], status, token)

    async def _close_gaps(self) -> None:
        """Have amplifiers whose token is far behind commit a set that changes nothing."""
        unchanged = []
        for amplifier in self.amplifiers.values():
            committed = amplifier.committed  # 0: any is newer
            if committed > 0 and (self.token - committed) % _SPAN > _MAX_GAP:
                unchanged += [(amplifier, layer) for layer in _unchanged(amplifier)]
        if unchanged:
            self.token = token_after(self.token)
            sets = [each.stage(self.token, [layer], now=True) for each, layer in unchanged]
            await asyncio.gather(*sets)


def is_lost(amplifier: Amplifier) -> bool:
    """Whether it cannot be reached: its line is gone, or it is mute beyond its watchdog."""
    if amplifier.silence_cause is None or amplifier.line.loss is not None:
        return amplifier.line.loss is not None
    return clock.now() >= amplifier.feeding.lost_from


def _merged(refusals: Mapping[str, CommandRefused]) -> CommandRefused:
    """Join refusals by amplifier; `until` is known only if all of them pass by themselves."""
    known = [each.until for each in refusals.values() if each.until is not None]
    return CommandRefused(
        "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
        channel=next(iter(refusals.values())).channel,
        until=max(known) if len(known) == len(refusals) else None,
    )


def _commit_of(several: Sequence[Amplifier], token: int) -> Values:
    """Return the commit of all amplifiers of a line; raises unless each may have it now."""
    values = {"session": several[0].session, "token": token}
    for amplifier in several:
        amplifier.next_request("Commit", values, Priority.SET)
    return values


async def _check_plays(amplifier: Amplifier, status: Values, token: int) -> None:
    """Raise CommandRefused unless a status shows the token of a set, or the next one does.

    What its layers play is compared with every status.
    """
    if status["token"] != token and status["state"] not in LATCHED:
        status = await amplifier.commit(token)
    if status["token"] != token or status["state"] in LATCHED:
        raise CommandRefused(
            f"amplifier {amplifier.name}: token must be {token} while armed, got "
            f"{status['token']} in state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: Staged) -> tuple[LayerSet, ...]:
    """Read the layers of a set that plays, as the amplifier has achieved them."""
    return tuple([await amplifier.read_achieved(one, staged.token) for one in staged.layers])


async def _status_of(amplifier: Amplifier, token: int, sent: Awaitable[Values]) -> Values:
    """Read the status after a broadcast that was sent, and commit again where that was lost.

    By a heartbeat: where replies are late the watchdogs run meanwhile.
    """
    status = await amplifier.ping()
    if status["token"] == token:
        return status
    await sent
    return await amplifier.commit(token)


def _unchanged(amplifier: Amplifier) -> list[Layer]:
    """Return a layer that is silent, or renewed without end; none if all end soon by themselves."""
    playback = amplifier.ledger.playback
    changing = {due[1] for due in playback.dues}  # end by themselves, or start what waits
    for number in range(amplifier.capabilities["layers"]):
        if number not in playback.tokens:
            return [Layer(number)]
        if number not in changing:
            return [Layer(number, renew=True)]
    return []
