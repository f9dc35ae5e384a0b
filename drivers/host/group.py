"""All amplifiers of a plate: they play together or not at all."""

import asyncio
import logging
import math
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any, ParamSpec, TypeVar

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
from drivers.host.dialogue import Staged
from drivers.host.jobs import Priority
from drivers.host.line import GRACE, Line
from drivers.host.members import GroupState, Members, is_lost
from drivers.host.stop import Stopped, what_may_play
from drivers.playing.contents import Layer
from drivers.protocol.records import Values
from drivers.protocol.sets import token_after
from drivers.protocol.table import ENABLED, QUANTITIES
from drivers.protocol.timing import HEARTBEAT, STOP_RAMP, check_watchdog
from registry import clock

_T = TypeVar("_T")
_P = ParamSpec("_P")
_SESSION, _TOKEN = QUANTITIES["session"], QUANTITIES["token"]
_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
_STATUS_INTERVAL = 0.19  # s at least, between statuses that show if the watchdog runs down
_MAX_STATUS_LOAD = 0.05  # of the line's time, for these
_logger = logging.getLogger(__name__)


class Group(Members):
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
        super().__init__(amplifiers, draw(_TOKEN.minimum, _TOKEN.maximum))
        self._watchdog, self._restored = watchdog, restored
        self._draw = draw
        self._arming = asyncio.Lock()  # a second arm waits for the first
        self._closing = asyncio.Lock()  # a second close waits for the first
        self._silencing: set[asyncio.Future[Any]] = set()  # stops and disarms in progress
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}  # of stops
        self._running_due: dict[str, float] = {}  # statuses just before a heartbeat
        self._readings: dict[str, asyncio.Future[Values]] = {}  # of amplifiers that do not reply
        self._gives_up_at = math.inf  # s; nothing is repeated later, since all is being closed

    @property
    def is_silencing(self) -> bool:
        """Whether a stop or disarm goes on."""
        return bool(self._silencing)

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed.

        Raises LinkError, and CommandError for a wire that is too slow for the watchdog.
        """
        before, self._gives_up_at = self.epoch, math.inf
        await self.all([each.open() for each in self.amplifiers.values()])
        for amplifier in self.amplifiers.values():
            check_watchdog(self._watchdog, amplifier.exchange_time("Set"))
        # Each amplifier says itself what it has latched before.
        self.state = GroupState.DISARMED if self.epoch == before else GroupState.STOPPED

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        One session, so that a broadcast reaches all of a line. If all are armed, also by a request
        that came first, nothing changes. Raises DriverError, LinkDegraded where one only does not
        reply for now.
        """
        before = self.epoch
        async with self._arming:
            if not self.is_open:
                raise CommandError(
                    f"amplifiers must be open to be armed, got {self.state.name}; close and open "
                    "all of them again"
                )
            if self.state is GroupState.STOPPED:  # an amplifier that restarted does not know
                raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
            if self._silencing:  # the result would depend on the order of frames
                raise CommandRefused(
                    "amplifiers are being stopped or disarmed; arm again if that is still wanted"
                )
            self.check_none_since(before)
            amplifiers = [*self.amplifiers.values()]
            if self.is_armed:
                statuses = await self._read(Priority.ARM)
                self.check_none_since(before)
                if all(each["state"] == ENABLED for each in statuses.values()):
                    return
                self._leave_armed()
                before = self.epoch
                await self._silenced(self._disarm, amplifiers, STOP_RAMP)
                self.check_none_since(before)
            for amplifier in amplifiers:
                amplifier.check_other_host()  # before a disarm of what failed ends its vibration
            session = self._draw(_SESSION.minimum, _SESSION.maximum)
            arming = asyncio.gather(
                *[each.arm(session, self._watchdog) for each in amplifiers], return_exceptions=True
            )
            try:
                self.checked(await asyncio.shield(arming))
                self.check_none_since(before)
            except BaseException as error:
                self.note(error)
                await self._silenced(self._disarm_armed, arming)
                if isinstance(error, DriverError):
                    self.check_none_since(before)
                if self.is_degraded_only(error):
                    raise LinkDegraded(str(error)) from error
                if self.lost_by:
                    self.lose()
                raise
            self.is_set_incomplete = False
            self.state = GroupState.ARMED

    async def _disarm_armed(self, arming: "asyncio.Future[list[Any]]") -> None:
        """Disarm what may have been armed by this; any other may be another host's."""
        await arming
        disarmed = await asyncio.gather(
            *[
                self._retried(each, partial(each.disarm, STOP_RAMP))
                for each in self.amplifiers.values()
                if each.may_be_armed
            ],
            return_exceptions=True,
        )
        failures = [each for each in disarmed if isinstance(each, BaseException)]
        if not all(isinstance(each, LinkError) for each in failures):  # a mute one stops none
            await self.stop()

    def beat(self) -> Coroutine[Any, Any, Sequence[Values | Staged]]:
        """Feed the watchdog of every amplifier that replies; raises as `apply`.

        Of one that does not reply the status is read meanwhile; one that replies again must still
        play its set. A watchdog that runs down, and starts anew with each heartbeat, shows that it
        would silence the amplifier: so its status is read just before it is fed, five times a
        second, and less often on a slow wire or where replies come late. On a shared line one that
        has committed nothing since it was armed is fed by a silent set, so that all have committed
        the same: the line feeds them together by that.
        """
        return self._exchange(self._beat)

    def _beat(self) -> Awaitable[Sequence[Values | Staged]]:
        for each in self.amplifiers.values():  # before the others are waited for: they stop then
            if (each.silence_cause or each.line.loss) and is_lost(each):
                raise LinkTimeout(each.line.loss or each.silence_cause)
        first: dict[Line, int] = {}
        running = self._read_running()
        feeding: list[Awaitable[Values | Staged]] = []
        order = self.by_need
        for line in {each.line for each in self.amplifiers.values() if each.line.late > GRACE}:
            # A late line feeds all again ahead of each: after that the last one's status tells.
            of_line = [name for name in order if self.amplifiers[name].line is line]
            next_read = min(of_line, key=lambda name: self._running_due.get(name, 0.0))
            order.remove(next_read)
            order.append(next_read)
        for name in order:
            each = self.amplifiers[name]
            if each.silence_cause is None:
                if name in running:
                    feeding.append(self._read_and_feed(each, self.epoch, running[name]))
                elif not each.committed and len(each.line.members) > 1:
                    token = first[each.line] = first.get(each.line) or self._first_token(each.line)
                    layers, priority = [Layer(0)], Priority.HEARTBEAT
                    feeding.append(each.stage(token, layers, now=True, priority=priority))
                else:
                    feeding.append(each.ping())
            elif name not in self._readings or self._readings[name].done():
                read = partial(each.read_status, Priority.READING)
                self._readings[name] = asyncio.ensure_future(self._retried(each, read))
                self._readings[name].add_done_callback(self._has_replied)
        return self.all(feeding)

    def _read_running(self) -> dict[str, "asyncio.Future[Values]"]:
        """Read statuses that show how a watchdog runs down, before any of their line are fed.

        On a line that is slow or late of one alone, so that none waits for long; of none where one
        may reply again, which is to be heard before.
        """
        busy = {each.line for each in self.amplifiers.values() if each.silence_cause is not None}
        running: dict[str, asyncio.Future[Values]] = {}
        for name in self.by_need:
            each = self.amplifiers[name]
            now, line = each.line.time(), each.line
            is_due = line not in busy and now >= self._running_due.get(name, 0.0)
            is_first = not each.committed and len(line.members) > 1  # it is fed by a set
            if is_due and not is_first and each.feeding.tells(now):
                pause = each.exchange_time("Set") / _MAX_STATUS_LOAD
                self._running_due[name] = now + max(pause, _STATUS_INTERVAL)
                all_of_line = 2 * each.exchange_time("GetStatus") * len(line.members)
                if line.late > GRACE or all_of_line > HEARTBEAT:
                    busy.add(line)
                running[name] = each.read_status(Priority.HEARTBEAT)
        return running

    def _has_replied(self, reading: "asyncio.Future[Values]") -> None:
        _seen(reading)
        if not reading.cancelled() and reading.exception() is None:
            self._restored()

    def _first_token(self, line: Line) -> int:
        """Return the token that one of a line has committed, or else a new one."""
        committed = max(each.committed for each in line.members.values())
        self.token = self.token if committed else token_after(self.token)
        return committed or self.token

    async def _read_and_feed(
        self, amplifier: Amplifier, before: int, reading: "asyncio.Future[Values]"
    ) -> Values:
        await reading
        self.check_none_since(before)
        return await amplifier.ping()

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, read back from every amplifier.

        It goes on to its end if its caller is cancelled. Where one fails all are stopped.
        """
        self._leave_armed()
        await self._silenced(self._disarm, [*self.amplifiers.values()], ramp)

    async def _disarm(self, members: Sequence[Amplifier], ramp: float) -> None:
        try:
            await self.all([self._retried(each, partial(each.disarm, ramp)) for each in members])
        except BaseException:
            await self.stop()
            raise

    def stop(
        self, ramp: float = STOP_RAMP, *, waits_for: Sequence[str] | None = None
    ) -> Coroutine[Any, Any, Mapping[str, Stopped]]:
        """Stop every amplifier along a ramp [s], lost ones too; latched until `clear`.

        The requests are queued when this returns; those of one line get a broadcast first, so that
        none waits for the reply of another. Await it for what became of each, by name: of those of
        some names, None for all. It goes on to its end if its caller is cancelled.
        """
        self._leave_armed()
        if self.is_open:
            self.state = GroupState.STOPPED
        for line in {each.line for each in self.amplifiers.values()}:
            if len(line.members) > 1:
                try:
                    self._broadcast(line, ramp)
                except Exception:  # each amplifier is stopped by itself as well
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        stops: dict[str, asyncio.Future[Stopped]] = {}
        for name, amplifier in self.amplifiers.items():
            try:
                stops[name] = amplifier.stop(ramp)
            except Exception as error:  # the others are stopped all the same
                stops[name] = asyncio.get_running_loop().create_future()
                stops[name].set_exception(error)
        names = [*stops] if waits_for is None else waits_for
        return self._silenced(self._outcomes, {name: stops[name] for name in names})

    def _broadcast(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line, unless one is queued."""
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            first = next(iter(self.amplifiers.values()))
            sent = line.submit(None, Priority.STOP, "Stop", {"ramp": first.wire_ramp(ramp)})
            sent.add_done_callback(_seen)
            self._broadcasts[line] = sent

    async def _outcomes(
        self, stops: Mapping[str, "asyncio.Future[Stopped]"]
    ) -> Mapping[str, Stopped]:
        outcomes: dict[str, Stopped] = {}
        for name, result in zip(
            stops, await asyncio.gather(*stops.values(), return_exceptions=True), strict=True
        ):
            if isinstance(result, BaseException):
                result = what_may_play(self.amplifiers[name], f"{type(result).__name__}: {result}")
            outcomes[name] = result
        return outcomes

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone.

        Raises Preempted while amplifiers are being stopped or disarmed: nothing precedes that.
        """
        if self._silencing:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        before = self.epoch
        try:
            await self.all([each.clear() for each in self.amplifiers.values()])
        except LinkError:
            await self.stop()
            raise
        except CommandRefused as error:
            if self.epoch != before:  # the stop of now is another one
                raise Preempted("a stop came first; find the cause, then clear again") from error
            raise
        if self.epoch == before and self.state is GroupState.STOPPED:
            self.state = GroupState.DISARMED

    async def statuses(self) -> dict[str, Values]:
        """Read the status of every amplifier, by name; again while one does not reply.

        Raises LinkError once that one is lost.
        """
        return await self._read(Priority.OTHER)

    async def _read(self, priority: Priority) -> dict[str, Values]:
        amplifiers = self.amplifiers.values()
        statuses = await self.all(
            [self._retried(each, partial(each.read_status, priority)) for each in amplifiers]
        )
        return dict(zip(self.amplifiers, statuses, strict=True))

    async def close(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, confirm it by reading back, and disarm; may be called twice.

        A failure stops all amplifiers and is logged. The lines are left to their owner.
        """
        is_armed, now = self.is_armed, clock.now()
        self._leave_armed()
        self.state = GroupState.CLOSED
        # Of one that does not reply by then a stop is all that is left.
        self._gives_up_at = min(self._gives_up_at, now + CONFIRM_TIMEOUT)
        async with self._closing:
            members = [
                each
                for each in self.amplifiers.values()
                if each.may_be_armed
                and (
                    is_armed
                    or not is_lost(each)
                    or (each.line.loss is None and what_may_play(each).may_play_until > now)
                )
            ]
            try:
                if members:
                    await self._silenced(self._disarm, members, ramp)
            except DriverError as error:
                _logger.error("amplifiers: stopped, because closing failed: %s", error)
            if self._silencing:  # a line is closed once what stops on it has ended
                await asyncio.wait({*self._silencing})

    async def _retried(self, amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
        """Repeat a request until it is answered, the amplifier is lost, or all is being closed."""
        while True:
            try:
                return await request()
            except LinkTimeout:
                if is_lost(amplifier) or clock.now() > self._gives_up_at:
                    raise
                await asyncio.sleep(_REPEAT_INTERVAL)

    def _silenced(
        self, work: Callable[_P, Coroutine[Any, Any, _T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> Coroutine[Any, Any, _T]:
        """Begin a stop or disarm; nothing arms until it ends, whoever is cancelled meanwhile."""
        task = asyncio.ensure_future(work(*args, **kwargs))  # begun wherever it was made
        self._silencing.add(task)
        task.add_done_callback(self._silencing.discard)
        return _to_completion(task)

    def _leave_armed(self) -> None:
        """Leave ARMED for DISARMED, if armed, so that nothing more is played."""
        self.epoch += 1
        if self.is_armed:
            self.state = GroupState.DISARMED


def _seen(sent: "asyncio.Future[Values]") -> None:
    """Retrieve an error that nobody awaits: what each amplifier says afterwards decides."""
    if not sent.cancelled():
        sent.exception()


async def _to_completion(task: "asyncio.Future[_T]") -> _T:
    """Await work, however often the caller is cancelled meanwhile; re-raise that at the end."""
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        task.exception()  # retrieved: what has failed is said by the amplifiers
        raise cancellation
    return task.result()
