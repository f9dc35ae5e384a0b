"""All amplifiers of a plate: they play together or not at all."""

import asyncio
import logging
import math
import random
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from typing import Any, TypeGuard, TypeVar

from drivers import clock
from drivers.contents import Layer, is_silence
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    LinkTimeout,
    Preempted,
)
from drivers.host.amplifier import (
    DISARM_RAMP,
    PART_BYTES,
    STOP_RAMP,
    WATCHDOG,
    Amplifier,
    Stopped,
)
from drivers.host.comparison import name_of
from drivers.host.dialogue import Staged
from drivers.host.jobs import Priority
from drivers.host.joint_start import JointStart
from drivers.host.line import Line
from drivers.host.stopping import Stopping
from drivers.host.timing import check_watchdog
from drivers.host.token_gaps import INTERVAL, close_gaps
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import QUANTITIES, STATES
from drivers.protocol.tokens import token_after

_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
_MAX_STATUS_LOAD = 0.05  # of the line's time, for statuses that show whether the watchdog runs down
_T = TypeVar("_T")
_SESSION, _TOKEN = QUANTITIES["session"], QUANTITIES["token"]
_ENABLED = STATES["OPERATION_ENABLED"]
_logger = logging.getLogger(__name__)


class GroupState(Enum):
    """State of all amplifiers together: CLOSED until opened and in the end, LOST by a LinkError."""

    CLOSED = auto()
    DISARMED = auto()
    ARMED = auto()
    LOST = auto()


@dataclass(frozen=True)
class Played:
    """What amplifiers play of a set, by name, as they have achieved it; token: of the set.

    sent_at [s]: when the last commit went out.
    """

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    sent_at: float


class Group:
    """Amplifiers by name, their lines open. A failure of one stops all; nothing arms by itself.

    A stop runs to completion even if its caller is cancelled. watchdog [s]: of armed amplifiers.
    draw: of session numbers and of the first token, so that none of an earlier host is repeated.
    """

    def __init__(
        self,
        amplifiers: Mapping[str, Amplifier],
        *,
        watchdog: float = WATCHDOG,
        draw: Callable[[int, int], int] = random.randint,
    ) -> None:
        self.amplifiers = dict(amplifiers)
        self.state = GroupState.CLOSED
        self.is_set_incomplete = False
        """Whether possibly only some amplifiers have committed the last set."""
        self._watchdog = watchdog
        self._draw = draw
        self._token = draw(_TOKEN.minimum, _TOKEN.maximum)
        self._stopping = Stopping(self.amplifiers)
        self._arming = asyncio.Lock()  # a second arm waits for the first
        self._closing = asyncio.Lock()  # a second close waits for the first
        self._silences = 0  # stops, disarms and closes so far
        self._silencing = 0  # stops and disarms in progress
        self._stops = self._cleared = 0  # stops so far, and at the last clear
        self._may_be_armed = False  # since the amplifiers were opened
        self._limit: asyncio.Timeout | None = None  # of an exchange in progress
        self._running_read_at: dict[str, float] = {}
        self._readings: dict[str, asyncio.Future[Values]] = {}  # of amplifiers that do not reply

    @property
    def is_armed(self) -> bool:
        """Whether layers may be played."""
        return self.state is GroupState.ARMED

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
    def last_sent_at(self) -> float:
        """When [s] a set or silence was last sent to any amplifier."""
        return max((each.played_at for each in self.amplifiers.values()), default=-math.inf)

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed.

        Raises LinkError, and CommandError for a wire that is too slow for the watchdog.
        """
        stops = self._stops  # each amplifier says itself what it has latched before
        await self._all(amplifier.open() for amplifier in self.amplifiers.values())
        for amplifier in self.amplifiers.values():
            check_watchdog(self._watchdog, round_trip_of(amplifier))
        self.state = GroupState.DISARMED
        self._may_be_armed = False
        self._cleared = stops

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        One session, so that a broadcast reaches all of a line. If all are armed, also by a request
        that came first, nothing changes.
        """
        before = self._silences
        async with self._arming:
            if self.state in (GroupState.CLOSED, GroupState.LOST):
                raise CommandError(
                    f"amplifiers must be open to be armed, got {self.state.name}; close and open "
                    "all of them again"
                )
            if self._stops > self._cleared:  # an amplifier that restarted does not know
                raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
            if self._silencing:  # the result would depend on the order of frames
                raise CommandRefused(
                    "amplifiers are being stopped or disarmed; arm again if that is still wanted"
                )
            self._check_not_silenced(before)
            if self.is_armed:
                statuses = await self._read(Priority.ARM)
                self._check_not_silenced(before)
                if all(each["state"] == _ENABLED for each in statuses.values()):
                    return
                before = await self._disarm_rest()
            for amplifier in self.amplifiers.values():
                amplifier.check_other_host()  # before a disarm of what failed ends its vibration
            await self._arm(before)

    async def _disarm_rest(self) -> int:
        """Disarm those that still are, when others no longer are; the count of silences then."""
        self._leave_armed()
        before = self._silences
        with self._silences_in_progress():
            await _to_completion(self._disarm([*self.amplifiers.values()], STOP_RAMP))
        self._check_not_silenced(before)
        return before

    async def _arm(self, before: int) -> None:
        """Arm all amplifiers; before: count of silences at the request."""
        self._may_be_armed = True
        session = self._draw(_SESSION.minimum, _SESSION.maximum)
        members = [*self.amplifiers.values()]
        arming = asyncio.gather(
            *(each.arm(session, self._watchdog) for each in members), return_exceptions=True
        )
        try:
            with self._detecting_loss():
                results = await asyncio.shield(arming)
                self._raise_worst(results)
            self._check_not_silenced(before)
        except BaseException as error:
            with self._silences_in_progress():
                await _to_completion(self._disarm_armed(members, arming))
            if isinstance(error, DriverError):
                self._check_not_silenced(before)
            if isinstance(error, LinkTimeout) and self._is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            if self.lost_by:
                self.state = GroupState.LOST
            raise
        self.is_set_incomplete = False
        self.state = GroupState.ARMED

    async def _disarm_armed(
        self, members: Sequence[Amplifier], arming: "asyncio.Future[list[Any]]"
    ) -> None:
        """Disarm what may have been armed by this; one that has refused may be another host's."""
        results = await arming
        disarmed = await asyncio.gather(
            *(
                self._retried(each, partial(each.disarm, STOP_RAMP))
                for each, result in zip(members, results, strict=True)
                if not isinstance(result, CommandRefused)
                or isinstance(result, Preempted)
                or result.may_play
            ),
            return_exceptions=True,
        )
        failures = [each for each in disarmed if isinstance(each, BaseException)]
        if not all(isinstance(each, LinkError) for each in failures):  # a mute one stops none
            await self.stop()

    def _check_not_silenced(self, before: int) -> None:
        if self._silences != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed while arming, and stay disarmed; "
                "arm again if that is still wanted"
            )

    async def apply(self, layers: Mapping[str, Sequence[Layer]]) -> Played:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused; silence alone is not staged. One
        that is no longer armed does not refuse a set: it stops all.
        Raises Preempted where a stop, disarm or `abort_exchange` came first, and LinkDegraded where
        one does not reply: then it is unknown whether the set plays. What else fails stops all
        amplifiers before it is raised.
        """
        self._check_armed()
        done = await self._exchange(self._apply(layers))
        if isinstance(done, CommandRefused):
            raise done
        return done

    async def _apply(self, layers: Mapping[str, Sequence[Layer]]) -> Played | CommandRefused:
        """Stage and commit; a refusal before the first commit is returned."""
        before = self._silences
        if self._token % INTERVAL == 0:
            self._token = await close_gaps(self.amplifiers.values(), self._token)
        self._token = token = token_after(self._token)
        is_silent = all(map(is_silence, layers.values()))
        results = await asyncio.gather(
            *(
                self.amplifiers[name].stage(token, several, now=is_silent)
                for name, several in layers.items()
            ),
            return_exceptions=True,
        )
        refusals = {
            name: result
            for name, result in zip(layers, results, strict=True)
            if _is_of_set(result) and not isinstance(result, Preempted)
        }
        others = [result for result in results if not _is_of_set(result)]
        if is_silent or not refusals or any(isinstance(each, BaseException) for each in others):
            self._raise_worst(results)
        if refusals:
            return _merged(refusals)
        staged = [each for each in results if isinstance(each, Staged)]
        if not is_silent:
            if self._silences != before:
                raise Preempted("a stop or disarm came first")
            self.is_set_incomplete = len(layers) > 1
            until = min(one.until for one in staged)
            statuses = await self._commit([*layers], token, until)
            for name, status, one in zip(layers, statuses, staged, strict=True):
                _check_plays(name, status, one)
        self.is_set_incomplete = False
        sent_at = max(self.amplifiers[name].played_at for name in layers)
        achieved = await self._all(
            _achieved(self.amplifiers[name], one) for name, one in zip(layers, staged, strict=True)
        )
        return Played(token, dict(zip(layers, achieved, strict=True)), sent_at)

    async def silence(self, ramp: float) -> float:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed.

        Returns when [s] the last request went out. Raises as `apply`.
        """
        self._check_armed()
        await self._exchange(
            self._all(amplifier.silence(ramp) for amplifier in self.amplifiers.values())
        )
        self.is_set_incomplete = False
        return self.last_sent_at

    async def beat(self) -> None:
        """Feed the watchdog of every amplifier that replies; raises as `apply`.

        Of one that does not reply the status is read meanwhile; one that replies again must still
        play its set.
        """
        self._check_armed()
        await self._exchange(self._all(map(self._beat, self.amplifiers.values())))

    async def _beat(self, amplifier: Amplifier) -> None:
        if is_lost(amplifier):
            raise LinkTimeout(amplifier.line.loss or amplifier.silence_cause)
        if amplifier.silence_cause is None:
            await self._read_running(amplifier)
            if not self.is_armed:
                raise Preempted("a stop or disarm came first")
            await amplifier.ping()
            return
        reading = self._readings.get(amplifier.name)
        if reading is None or reading.done():
            reading = asyncio.ensure_future(amplifier.read_status(Priority.HEARTBEAT))
            reading.add_done_callback(_seen)
            self._readings[amplifier.name] = reading

    async def _read_running(self, amplifier: Amplifier) -> None:
        """Read a status just before the watchdog is fed, unless the wire is too slow for that."""
        pause = round_trip_of(amplifier) / _MAX_STATUS_LOAD
        last, now = self._running_read_at.get(amplifier.name), clock.now()
        if last is None or now - last >= pause:
            self._running_read_at[amplifier.name] = now
            await amplifier.read_status(Priority.HEARTBEAT)

    def abort_exchange(self) -> None:
        """End an `apply`, `silence` or `beat` in progress, so that silence can be sent next.

        What was not sent is not sent any more; a request on the wire is waited for at most 8 ms.
        """
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(clock.now())

    def _check_armed(self) -> None:
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")

    async def _exchange(self, exchange: Coroutine[Any, Any, _T]) -> _T:
        """Run an exchange of the control loop; any unexplained failure stops all amplifiers."""
        before = self._silences
        limit = asyncio.timeout(None)
        try:
            try:
                with self._detecting_loss():
                    async with limit as self._limit:
                        return await exchange
            finally:
                self._limit = None
        except Exception as error:
            if limit.expired() and (isinstance(error, TimeoutError | Preempted)):
                raise Preempted("given up, since silence comes first") from error
            if self._is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            is_explained = self._silences != before and self.state is not GroupState.LOST
            if is_explained and isinstance(error, DriverError):
                raise Preempted("a stop or disarm came first") from error
            self._leave_armed()
            self._stops += 1
            with self._silences_in_progress():  # those that are lost are not waited for
                await _to_completion(self._stopping.stop(STOP_RAMP, waits_for=self._reachable))
            raise

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, read back from every amplifier.

        It goes on to its end if its caller is cancelled. Where one fails all are stopped.
        """
        self._leave_armed()
        with self._silences_in_progress():
            await _to_completion(self._disarm([*self.amplifiers.values()], ramp))

    async def _disarm(self, members: Sequence[Amplifier], ramp: float) -> None:
        try:
            await self._all(self._retried(each, partial(each.disarm, ramp)) for each in members)
        except BaseException:
            await self.stop()
            raise

    async def stop(self, ramp: float = STOP_RAMP) -> Mapping[str, Stopped]:
        """Stop every amplifier along a ramp [s], lost ones too; latched until `clear`.

        Returns what became of each, by name. It goes on to its end if its caller is cancelled.
        """
        self._leave_armed()
        self._stops += 1
        with self._silences_in_progress():
            return await _to_completion(self._stopping.stop(ramp))

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone.

        Raises Preempted while amplifiers are being stopped or disarmed: nothing precedes that.
        """
        if self._silencing:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        count = self._stops
        try:
            await self._all(amplifier.clear() for amplifier in self.amplifiers.values())
        except LinkError:
            await self.stop()
            raise
        except CommandRefused as error:
            if self._stops != count:  # the stop of now is another one
                raise Preempted("a stop came first; find the cause, then clear again") from error
            raise
        self._cleared = count

    async def statuses(self) -> dict[str, Values]:
        """Read the status of every amplifier, by name; again while one does not reply.

        Raises LinkError once that one is lost.
        """
        return await self._read(Priority.OTHER)

    async def _read(self, priority: Priority) -> dict[str, Values]:
        statuses = await self._all(
            self._retried(each, partial(each.read_status, priority))
            for each in self.amplifiers.values()
        )
        return dict(zip(self.amplifiers, statuses, strict=True))

    async def close(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, confirm it by reading back, and disarm; may be called twice.

        A failure stops all amplifiers and is logged. The lines are left to their owner.
        """
        is_armed = self.is_armed
        self._leave_armed()
        self.state = GroupState.CLOSED
        async with self._closing:
            members = [each for each in self.amplifiers.values() if is_armed or not is_lost(each)]
            if not self._may_be_armed:
                return
            try:
                with self._silences_in_progress():
                    await _to_completion(self._disarm(members, ramp))
                self._may_be_armed = False
            except DriverError as error:
                _logger.error("amplifiers: stopped, because closing failed: %s", error)

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
        return await self._all(_awaited(requests[each]) for each in order)

    def _leave_armed(self) -> None:
        """Leave ARMED for DISARMED, if armed, so that nothing more is played."""
        self._silences += 1
        if self.is_armed:
            self.state = GroupState.DISARMED

    @contextmanager
    def _silences_in_progress(self) -> Iterator[None]:
        """Refuse arming and clearing meanwhile."""
        self._silencing += 1
        try:
            yield
        finally:
            self._silencing -= 1

    @contextmanager
    def _detecting_loss(self) -> Iterator[None]:
        """Enter the state LOST on a lost link, in which nothing is played."""
        try:
            yield
        except LinkError as error:
            if not self._is_degraded_only(error) and self.state is not GroupState.CLOSED:
                self.state = GroupState.LOST
            raise

    def _is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error says no more than that an amplifier does not reply for now."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    @property
    def _reachable(self) -> list[str]:
        return [name for name, each in self.amplifiers.items() if each.silence_cause is None]

    async def _retried(self, amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
        """Repeat a request until it is answered or the amplifier is lost."""
        while True:
            try:
                return await request()
            except LinkTimeout:
                if is_lost(amplifier):
                    raise
                await asyncio.sleep(_REPEAT_INTERVAL)

    async def _all(self, requests: Any) -> list[Any]:
        """Await all requests to their ends, then raise the most severe error."""
        coroutines: list[Coroutine[Any, Any, Any]] = [*requests]
        with self._detecting_loss():
            if len(coroutines) == 1:  # without a further iteration of the event loop
                return [await coroutines[0]]
            results = await asyncio.gather(*coroutines, return_exceptions=True)
            self._raise_worst(results)
            return results

    def _raise_worst(self, results: Sequence[object]) -> None:
        """Raise the most severe error of results: a lost link first, a degraded one last."""
        errors = [each for each in results if isinstance(each, BaseException)]
        if errors:
            raise min(errors, key=self._severity)

    def _severity(self, error: BaseException) -> int:
        if self._is_degraded_only(error):
            return 2
        return 0 if isinstance(error, LinkError) else 1


def is_lost(amplifier: Amplifier) -> bool:
    """Whether it cannot be reached: its line is gone, or it is mute beyond its watchdog."""
    is_over = clock.now() >= amplifier.feeding.may_play_until
    return amplifier.line.loss is not None or (amplifier.silence_cause is not None and is_over)


def round_trip_of(amplifier: Amplifier) -> float:
    """Return how long the longest exchange with an amplifier takes on its wire [s]."""
    return amplifier.line.wire.round_trip("Set", PART_BYTES)


def _is_of_set(result: object) -> TypeGuard[CommandRefused]:
    """Whether a set was refused, by an amplifier that may play another one."""
    return isinstance(result, CommandRefused) and not result.is_disarmed


def _merged(refusals: Mapping[str, CommandRefused]) -> CommandRefused:
    """Join refusals by amplifier; `until` is known only if all of them pass by themselves."""
    moments = [refusal.until for refusal in refusals.values()]
    known = [moment for moment in moments if moment is not None]
    return CommandRefused(
        "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
        channel=next(iter(refusals.values())).channel,
        until=max(known) if len(known) == len(moments) else None,
    )


def _commit_of(several: Sequence[Amplifier], token: int) -> Values:
    """Return the commit of all amplifiers of a line; raises unless each may play its set now."""
    for amplifier in several:
        amplifier.check_admitted(token)
    return {"session": several[0].session, "token": token}


def _seen(sent: "asyncio.Future[Values]") -> None:
    """Retrieve an error that nobody awaits: what each amplifier says afterwards decides."""
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
    if status["token"] != staged.token or status["state"] != _ENABLED:
        raise CommandRefused(
            f"amplifier {name}: token must be {staged.token} while armed, got {status['token']} in "
            f"state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: Staged) -> tuple[LayerSet, ...]:
    """Return the layers of a set that plays: as they were sent where they are played exactly."""
    if staged.is_exact:
        return staged.layers
    return tuple([await amplifier.read_achieved(one) for one in staged.layers])


async def _status_of(amplifier: Amplifier, token: int) -> Values:
    """Read the status after a broadcast, and commit again where that was lost."""
    status = await amplifier.read_status(Priority.SET)
    return status if status["token"] == token else await amplifier.commit(token)


async def _awaited(request: Awaitable[_T]) -> _T:
    return await request


async def _to_completion(work: Coroutine[Any, Any, _T]) -> _T:
    """Await work, however often the caller is cancelled meanwhile; re-raise that at the end."""
    task = asyncio.ensure_future(work)
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        raise cancellation
    return task.result()
