"""All amplifiers of a plate: they play together or not at all, and their watchdogs are fed here.

`Group` is the state of all amplifiers: a failure of one stops all, and nothing arms by itself.

`Heartbeats` alone decides which amplifier is fed, when and by what. A status read just before a
heartbeat shows that the watchdog runs down, and so would silence its amplifier: this is read five
times a second, less often on a slow wire or where replies come late. Where late replies let one
exchange take a third of a watchdog, all amplifiers of a line are fed ahead of a request to one.
"""

import asyncio
import logging
import math
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from enum import Enum, auto
from functools import partial
from typing import Any, TypeAlias, TypeVar

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
from drivers.host.dialogue import IsPreempted, StopOutcome, word_passed_by_all
from drivers.host.joint_sets import Clocks, JointSets, Members, PlayedSet, is_lost, outcomes
from drivers.host.line import GRACE, Line, Make, Priority
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import ENABLED, HEARTBEAT, QUANTITIES, STOP_RAMP, check_watchdog
from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token, token_after
from registry import threads

_STATUS_INTERVAL = 0.19  # s at least, between statuses that show if the watchdog runs down
_MAX_STATUS_LOAD = 0.05  # of the line's time, for these
_UNFED = 1.5 * HEARTBEAT  # s; beside a set to each, longest time between feedings of one

Feed: TypeAlias = Callable[[], Awaitable[object]]
"""What feeds an amplifier."""


class Heartbeats:
    """Feeds the watchdogs of a group. restored: called where one that was mute replies again."""

    def __init__(
        self, members: Members, sets: JointSets, clocks: Clocks, restored: Callable[[], None]
    ) -> None:
        self._members, self._sets, self._restored = members, sets, restored
        self._clocks = clocks
        self._running_due: dict[Amplifier, float] = {}  # statuses just before a heartbeat
        self._readings: dict[Amplifier, asyncio.Future[Values]] = {}  # of those that are mute

    def follow(self) -> None:
        """Know those of a line from now on, who are fed ahead of one's sets."""
        every = self._members.amplifiers.values()
        for line in self._members.lines:
            of_line = [each for each in every if each.line is line]
            line.ahead = partial(self._ahead, line, of_line) if len(of_line) > 1 else None

    def beat(self) -> Awaitable[Sequence[object]]:
        """Feed every amplifier that replies, and read the status of any other meanwhile.

        One that has committed nothing since it was armed is fed by an empty set on a line that it
        shares, so that all have committed the same: the line feeds them together by that.
        A status shows how a watchdog runs down only if it is read before any of its line are fed.
        On a line that is slow or late the status of one amplifier is read at a time, so that none
        waits for long; no status is read on a line where a mute amplifier may reply again, since
        that one must be heard first.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        mute: set[Line] = set()
        for each in self._members.by_need:
            if (each.silence_cause or each.line.loss) and is_lost(each):
                # Before the others are waited for: they stop then.
                raise LinkTimeout(each.line.loss or each.silence_cause)
            by_line.setdefault(each.line, []).append(each)
            if each.silence_cause is not None:
                mute.add(each.line)
        self._clocks.look({line: by_line[line] for line in by_line if line not in mute})
        feeds: list[Feed] = []
        for line, of_line in by_line.items():
            may_read, token = line not in mute, 0
            is_late, is_shared, now = line.late > GRACE, len(line.members) > 1, line.time()
            for each in of_line:
                if each.silence_cause is not None:
                    self._listen(each)
                    continue
                feed: Feed = each.ping
                due = self._running_due.get(each, 0.0)
                if is_shared and not each.committed:
                    token = token or self._first_token(of_line)
                    feed = partial(each.stage, token, (), now=True, priority=Priority.HEARTBEAT)
                elif may_read and now >= due and each.feeding.tells(now):
                    due = now + max(each.exchange_time("Set") / _MAX_STATUS_LOAD, _STATUS_INTERVAL)
                    self._running_due[each] = due
                    all_of_line = 2 * each.exchange_time("GetStatus") * len(line.members)
                    may_read = not is_late and all_of_line <= HEARTBEAT
                    reading = each.read_status(Priority.HEARTBEAT)
                    feed = partial(self._feed_after, each, self._members.epoch, reading)
                elif is_late and not each.clock.is_alone:  # heartbeats alone are readings of it
                    pause = asyncio.sleep(self._clocks.later())
                    feed = partial(self._feed_after, each, self._members.epoch, pause)
                feeds.append(feed)
        return self._members.all([feed() for feed in feeds])

    def _first_token(self, of_line: Sequence[Amplifier]) -> int:
        """Return the token that one of a line has committed, or else a new one."""
        committed = max([each.committed for each in of_line])
        if not committed:
            self._sets.token = token_after(self._sets.token)
        return committed or self._sets.token

    async def _feed_after(
        self, amplifier: Amplifier, before: int, awaited: Awaitable[object]
    ) -> Values:
        """Feed one after a reading or a pause, unless a stop or disarm came since an epoch."""
        await awaited
        self._members.check_none_since(before)
        return await amplifier.ping()

    def _listen(self, amplifier: Amplifier) -> None:
        """Read the status of one that is mute, until it replies or is lost."""
        reading = self._readings.get(amplifier)
        if reading is None or reading.done():
            read = partial(amplifier.read_status, Priority.READING)
            reading = asyncio.ensure_future(self._members.retried(amplifier, read))
            reading.add_done_callback(self._has_replied)
            self._readings[amplifier] = reading

    def _has_replied(self, reading: "asyncio.Future[Values]") -> None:
        if not reading.cancelled() and reading.exception() is None:
            self._restored()

    def _ahead(
        self, line: Line, of_line: Sequence[Amplifier], name: str, priority: Priority
    ) -> Make | None:
        """Return what feeds all of a line ahead of a request of the control loop to one.

        Where one was surely fed long ago. By a commit of the newest token: it changes nothing on
        those that have committed it, and the others may have their commit now. Not ahead of a
        status: it shows how a watchdog runs down only if none was fed before it.
        """
        if priority not in (Priority.HEARTBEAT, Priority.SET) or name == "GetStatus":
            return None
        limit = HEARTBEAT
        if line.late <= GRACE:
            limit = _UNFED + sum([each.exchange_time("Set") for each in of_line])
        if line.time() - min([each.feeding.since for each in of_line]) <= limit:
            return None
        session, token = of_line[0].session, 0
        for each in of_line:
            if each.committed and is_newer_token(each.committed, token):
                token = each.committed
        if not token or any(each.session != session for each in of_line):
            return None

        def make() -> list[Values]:
            values = {
                "session": session,
                "token": token,
                "at": word_passed_by_all(line.time(), of_line),
            }
            for each in of_line:
                each.next_request("Commit", values, Priority.SET)
            return [values]

        return make


_T = TypeVar("_T")
_SESSION, _TOKEN = QUANTITIES["session"], QUANTITIES["token"]
_logger = logging.getLogger(__name__)


class GroupState(Enum):
    """State of all amplifiers together: CLOSED until opened and in the end, LOST by a LinkError.

    STOPPED: disarmed by a stop, which is to be cleared before they are armed.
    """

    CLOSED = auto()
    DISARMED = auto()
    STOPPED = auto()
    ARMED = auto()
    LOST = auto()


class Group:
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
        self.state = GroupState.CLOSED
        self.members = Members(amplifiers)
        """Which of them reply, and which are lost."""
        self.amplifiers = self.members.amplifiers
        self.sets = JointSets(self.members, draw(_TOKEN.minimum, _TOKEN.maximum))
        """What they play together."""
        self._clocks = Clocks(self.members)
        self._heartbeats = Heartbeats(self.members, self.sets, self._clocks, restored)
        self._watchdog, self._draw = watchdog, draw
        self._arming = asyncio.Lock()  # a second arm waits for the first
        self._closing = asyncio.Lock()  # a second close waits for the first
        self._limit: asyncio.Timeout | None = None  # of an exchange in progress

    @property
    def clock_errors(self) -> Mapping[str, float]:
        """Errors of the clocks [s rms] by amplifier, see `Clocks.errors`."""
        return self._clocks.errors

    @property
    def is_open(self) -> bool:
        """Whether all reply as far as is known: neither closed nor lost."""
        return self.state not in (GroupState.CLOSED, GroupState.LOST)

    @property
    def is_armed(self) -> bool:
        """Whether layers may be played."""
        return self.state is GroupState.ARMED

    async def open(self) -> None:
        """Identify all amplifiers and leave them disarmed.

        Raises LinkError, and CommandError for a wire that is too slow for the watchdog.
        """
        members, before = self.members, self.members.epoch
        members.gives_up_at = math.inf
        await self._all([each.open() for each in self.amplifiers.values()])
        for amplifier in self.amplifiers.values():
            check_watchdog(self._watchdog, amplifier.exchange_time("Set"))
        self._clocks.follow()
        self._heartbeats.follow()
        # Each amplifier says itself what it has latched before.
        self.state = GroupState.DISARMED if members.epoch == before else GroupState.STOPPED

    async def arm(self) -> None:
        """Switch the high voltage on at level zero: on all amplifiers, or none stays armed.

        Each line has a session of its own: a broadcast reaches all of it, and one whose cable was
        exchanged for another line's neither plays nor is fed. If all are armed, also by a request
        that came first, nothing changes. Raises DriverError, LinkDegraded where one only does not
        reply for now.
        """
        members, before = self.members, self.members.epoch
        async with self._arming:
            if not self.is_open:
                raise CommandError(
                    f"amplifiers must be open to be armed, got {self.state.name}; close and open "
                    "all of them again"
                )
            if self.state is GroupState.STOPPED:  # an amplifier that restarted does not know
                raise CommandRefused("a stop must be cleared before arming; clear, then arm again")
            if members.silencing:  # the result would depend on the order of frames
                raise CommandRefused(
                    "amplifiers are being stopped or disarmed; arm again if that is still wanted"
                )
            members.check_none_since(before)
            amplifiers = [*self.amplifiers.values()]
            if self.is_armed:
                statuses = await self.statuses(Priority.ARM)
                members.check_none_since(before)
                if all(each["state"] == ENABLED for each in statuses.values()):
                    return
                self._leave_armed()
                before = members.epoch
                await members.silence(self._disarm, amplifiers, STOP_RAMP)
                members.check_none_since(before)
            for amplifier in amplifiers:
                amplifier.check_other_host()  # before a disarm of what failed ends its vibration
            await self._clocks.settle()
            members.check_none_since(before)
            drawn = self._draw(_SESSION.minimum, _SESSION.maximum)
            sessions = {
                line: (drawn + number) % _SESSION.maximum + 1
                for number, line in enumerate(members.lines)
            }
            arms = [each.arm(sessions[each.line], self._watchdog) for each in amplifiers]
            arming = asyncio.ensure_future(outcomes(arms))
            try:
                members.checked(await asyncio.shield(arming))
                members.check_none_since(before)
            except BaseException as error:
                self._note(error)
                await members.silence(self._disarm_armed, arming)
                if isinstance(error, DriverError):
                    members.check_none_since(before)
                if members.is_degraded_only(error):
                    raise LinkDegraded(str(error)) from error
                if members.lost_by:
                    self._lose()
                raise
            self.sets.is_incomplete = False
            self.state = GroupState.ARMED

    async def _disarm_armed(self, arming: "asyncio.Future[Any]") -> None:
        """Disarm what may have been armed by this; any other may be another host's."""
        await arming
        retried = self.members.retried
        disarms = [
            retried(each, partial(each.disarm, STOP_RAMP))
            for each in self.amplifiers.values()
            if each.may_be_armed
        ]
        # One that is mute stops none.
        if not all(isinstance(each, LinkError | None) for each in await outcomes(disarms)):
            await self.stop()

    def beat(self) -> Coroutine[Any, Any, Sequence[object]]:
        """Feed the watchdog of every amplifier that replies; raises as `apply`.

        Of one that does not reply the status is read meanwhile; one that replies again must still
        play its set.
        """
        return self._exchange(self._heartbeats.beat)

    def apply(
        self,
        layers: Mapping[str, Sequence[AmplifierLayer]],
        is_preempted: IsPreempted | None = None,
    ) -> Coroutine[Any, Any, PlayedSet]:
        """Play layers on the amplifiers of these names, all from one moment on.

        Refused on one means committed on none, and CommandRefused; silence alone is not staged. One
        that is no longer armed does not refuse a set: it stops all.
        Raises Preempted where a stop, disarm or `abort_exchange` came first, and LinkDegraded where
        one does not reply: then it is unknown whether the set plays. What else fails stops all
        amplifiers before it is raised.
        is_preempted: asked before one is sent the set, and before they are to play it; if so,
        Overtaken, and what plays goes on.
        """
        return self._exchange(partial(self.sets.play, layers, is_preempted))

    async def silence(self, ramp: float) -> float:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed.

        Returns when [s] the last request went out. Raises as `apply`.
        """
        await self._exchange(partial(self.sets.silence, ramp))
        return self.members.last_sent_at

    def abort_exchange(self) -> None:
        """End an `apply`, `silence` or `beat` in progress, so that silence can be sent next.

        What was not sent is not sent any more; a request on the wire is waited for at most 8 ms.
        """
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(threads.now())

    async def _exchange(self, exchange: Callable[[], Awaitable[_T | DriverError]]) -> _T:
        """Run an exchange of the control loop; any unexplained failure stops all amplifiers.

        An error that it returns stops none.
        """
        if not self.is_armed:
            raise CommandRefused("the amplifiers must be armed; clear a stop, then arm")
        members, before = self.members, self.members.epoch
        limit = asyncio.timeout(None)
        try:
            try:
                async with limit as self._limit:
                    done = await exchange()
            finally:
                self._limit, members.has_joint_set = None, False
        except Exception as error:
            self._note(error)
            has_lost = isinstance(error, LinkTimeout) and self.state is GroupState.LOST
            if limit.expired() and isinstance(error, TimeoutError | Preempted) and not has_lost:
                raise Preempted("given up, since silence comes first") from error
            if members.is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            is_explained = members.epoch != before and self.state is not GroupState.LOST
            if is_explained and isinstance(error, DriverError):
                raise Preempted("a stop or disarm came first") from error
            replying = [name for name, each in self.amplifiers.items() if not each.silence_cause]
            await self.stop(waits_for=replying)
            if has_lost:  # also where it was degraded when this began
                raise LinkTimeout(next(iter(members.lost_by.values()), str(error))) from error
            raise
        if isinstance(done, DriverError):
            raise done
        return done

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence and switch the high voltage off, read back from every amplifier.

        It goes on to its end if its caller is cancelled. Where one fails all are stopped.
        """
        self._leave_armed()
        await self.members.silence(self._disarm, [*self.amplifiers.values()], ramp)

    async def _disarm(self, amplifiers: Sequence[Amplifier], ramp: float) -> None:
        retried = self.members.retried
        try:
            await self._all([retried(each, partial(each.disarm, ramp)) for each in amplifiers])
        except BaseException:
            await self.stop()
            raise

    def stop(
        self, ramp: float = STOP_RAMP, *, waits_for: Sequence[str] | None = None
    ) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
        """Stop every amplifier along a ramp [s], lost ones too; latched until `clear`.

        The requests are queued when this returns. Await it for what became of each, by name: of
        those of some names, None for all. It goes on to its end if its caller is cancelled.
        """
        self._leave_armed()
        if self.is_open:
            self.state = GroupState.STOPPED
        members, stops = self.members, dict[str, asyncio.Future[StopOutcome]]()
        for line in members.lines:
            if len(line.members) > 1:  # so that none waits for the reply of another
                try:
                    members.broadcast_stop(line, ramp)
                except Exception:  # each amplifier is stopped by itself as well
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        for name, amplifier in self.amplifiers.items():
            try:
                stops[name] = amplifier.stop(ramp)
            except Exception as error:  # the others are stopped all the same
                stops[name] = asyncio.get_running_loop().create_future()
                stops[name].set_exception(error)
        names = stops if waits_for is None else waits_for
        return members.silence(members.stopped, {name: stops[name] for name in names})

    async def clear(self) -> None:
        """Acknowledge stops, and faults whose cause has gone.

        Raises Preempted while amplifiers are being stopped or disarmed: nothing precedes that.
        """
        if self.members.silencing:
            raise Preempted("amplifiers are being stopped or disarmed; clear again afterwards")
        before = self.members.epoch
        try:
            await self._all([each.clear() for each in self.amplifiers.values()])
        except LinkError:
            await self.stop()
            raise
        except CommandRefused as error:
            if self.members.epoch != before:  # the stop of now is another one
                raise Preempted("a stop came first; find the cause, then clear again") from error
            raise
        if self.members.epoch == before and self.state is GroupState.STOPPED:
            self.state = GroupState.DISARMED

    async def statuses(self, priority: Priority = Priority.OTHER) -> dict[str, Values]:
        """Read the status of every amplifier, by name; again while one does not reply.

        Raises LinkError once that one is lost.
        """
        amplifiers, retried = self.amplifiers.values(), self.members.retried
        statuses = await self._all(
            [retried(each, partial(each.read_status, priority)) for each in amplifiers]
        )
        return dict(zip(self.amplifiers, statuses, strict=True))

    async def close(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, confirm it by reading back, and disarm; may be called twice.

        A failure stops all amplifiers and is logged. The lines are left to their owner.
        """
        is_armed, now = self.is_armed, threads.now()
        self._leave_armed()
        self.state = GroupState.CLOSED
        # Of one that does not reply by then a stop is all that is left.
        self.members.gives_up_at = min(self.members.gives_up_at, now + CONFIRM_TIMEOUT)
        async with self._closing:
            amplifiers = [
                each
                for each in self.amplifiers.values()
                if each.may_be_armed
                and (
                    is_armed
                    or not is_lost(each)
                    or (each.line.loss is None and each.what_may_play().may_play_until > now)
                )
            ]
            try:
                if amplifiers:
                    await self.members.silence(self._disarm, amplifiers, ramp)
            except DriverError as error:
                _logger.error("amplifiers: stopped, because closing failed: %s", error)
            if self.members.silencing:  # only then is a line closed
                await asyncio.wait({*self.members.silencing})

    def _leave_armed(self) -> None:
        """Leave ARMED for DISARMED, if armed, so that nothing more is played."""
        self.members.epoch += 1
        if self.is_armed:
            self.state = GroupState.DISARMED

    def _lose(self) -> None:
        """Enter the state LOST, in which nothing is played."""
        if self.state is not GroupState.CLOSED:
            self.state = GroupState.LOST

    def _note(self, error: BaseException) -> None:
        """Note an error of a request: it may show that an amplifier is lost."""
        if isinstance(error, LinkError) and not self.members.is_degraded_only(error):
            error.lost = tuple(self.members.lost_by)
            self._lose()

    async def _all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error, noted."""
        try:
            return await self.members.all(requests)
        except LinkError as error:
            self._note(error)
            raise
