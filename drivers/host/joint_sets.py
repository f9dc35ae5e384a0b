"""Sets that several amplifiers play together, the amplifiers of a group, and their clocks.

A set is staged on all amplifiers that it names, and then committed on all or on none: by one
broadcast if they share a line, or on several lines for a moment that leaves enough time for the
slowest line. A set for one amplifier plays with its last part. A token is newer than another one if
it is ahead by less than half of 2^16 (RFC 1982); so an amplifier left out of 40 000 sets would
mistake the next one for an old set. It commits an empty set before that.

`Members` tracks which amplifiers reply and which are lost, and selects the most severe of several
errors. Stops and disarms start immediately and run to completion.

`Clocks` compares the clocks of all amplifiers. If heartbeats do not measure them well enough, for
instance on full-speed USB or a busy network, it reads statuses between the heartbeats, less often
for well-known clocks; any other request preempts these. On a line shared by several amplifiers, a
Mark makes all of them record the clock at the same byte.
"""

import asyncio
import math
import re
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from operator import attrgetter
from statistics import median
from typing import Any, ParamSpec, TypeVar, cast

from drivers.errors import CommandRefused, DriverError, LinkError, LinkTimeout, Overtaken, Preempted
from drivers.host.amplifier import COMMITTING, Amplifier, IsPreempted
from drivers.host.clock import HeldClock
from drivers.host.ledger import StagedSet, StopOutcome, is_silence
from drivers.host.line import GRACE, Line, Priority
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import (
    AHEAD_MAX,
    HEARTBEAT,
    HIGH_TIME,
    HIGH_WORDS,
    LATCHED,
    STATES,
    STOP_RAMP,
    clock_at,
    has_feature,
    high_word,
    moment_behind,
    moment_of,
    name_of,
    word_passed,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, token_after
from registry import threads

_T = TypeVar("_T")
_P = ParamSpec("_P")
_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
need = attrgetter("feeding.since")
_lost_from = attrgetter("feeding.lost_from")
_silence_cause = attrgetter("silence_cause")


class Members:
    """The amplifiers of a group, by name."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.amplifiers = dict(amplifiers)
        self.epoch = 0
        """Number of stops, disarms and closes; what began before one must not arm, play or feed."""
        self.has_joint_set = False
        """Whether a set for several lines is under way; no clock is read meanwhile."""
        self.gives_up_at = math.inf
        """When requests are no longer repeated [s], because all is being closed."""
        self.silencing: set[asyncio.Future[Any]] = set()
        """Stops and disarms in progress."""
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}  # the last stop of each line

    @property
    def lines(self) -> tuple[Line, ...]:
        """Each line once, in the order of the amplifiers, so that runs are reproducible."""
        return tuple(dict.fromkeys([amplifier.line for amplifier in self.amplifiers.values()]))

    @property
    def by_need(self) -> list[Amplifier]:
        """All amplifiers; the least recently fed is first, because replies may be late."""
        return sorted(self.amplifiers.values(), key=need)

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        mute = filter(_silence_cause, self.amplifiers.values())
        return tuple([amplifier.name for amplifier in mute if not is_lost(amplifier)])

    @property
    def lost_by(self) -> Mapping[str, str]:
        """Why each lost amplifier is lost, by name."""
        causes = {}
        for name, amplifier in self.amplifiers.items():
            if is_lost(amplifier):
                causes[name] = amplifier.line.loss or amplifier.silence_cause or ""
        return causes

    @property
    def lost_from(self) -> float:
        """When an amplifier that does not reply is lost [s]; the next beat then stops all."""
        mute = filter(_silence_cause, self.amplifiers.values())
        return min(map(_lost_from, mute), default=math.inf)

    @property
    def last_sent_at(self) -> float:
        """When a set or silence was last sent to any amplifier [s]."""
        times = [amplifier.played_at for amplifier in self.amplifiers.values()]
        return max(times, default=-math.inf)

    def check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, disarm or close has come since an epoch."""
        if self.epoch != epoch:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    def is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error only means that an amplifier currently does not reply."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    async def all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error."""
        return self.checked(await outcomes(requests))

    def checked(self, results: list[_T | BaseException]) -> list[_T]:
        """Return results, or raise the most severe error among them.

        A lost link is the most severe; the least are a preempted request and a degraded link.
        """
        errors = [result for result in results if isinstance(result, BaseException)]
        if errors:
            raise min(errors, key=self._severity)
        return cast("list[_T]", results)

    def _severity(self, error: BaseException) -> int:
        if self.is_degraded_only(error):
            return 3
        if isinstance(error, Preempted):  # the user should see the error that preempted it
            return 2
        return 0 if isinstance(error, LinkError) else 1

    async def retried(self, amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
        """Repeat a request until it has a reply, the amplifier is lost, or everything is closed."""
        while True:
            try:
                return await request()
            except LinkTimeout:
                if is_lost(amplifier) or threads.now() > self.gives_up_at:
                    raise
                await asyncio.sleep(_REPEAT_INTERVAL)

    def silence(
        self, work: Callable[_P, Coroutine[Any, Any, _T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> Coroutine[Any, Any, _T]:
        """Start a stop or disarm, which runs to completion in spite of cancellation."""
        task = asyncio.ensure_future(work(*args, **kwargs))  # starts even if not awaited
        self.silencing.add(task)
        task.add_done_callback(self.silencing.discard)
        return _to_completion(task)

    def broadcast_stop(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line along a ramp [s], unless one is queued."""
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            first = next(iter(self.amplifiers.values()))
            sent = line.submit(None, Priority.STOP, "Stop", {"ramp": first.wire_ramp(ramp)})
            # Its error does not matter: the replies of the amplifiers to their own stops decide.
            sent.add_done_callback(lambda sent: sent.cancelled() or sent.exception())
            self._broadcasts[line] = sent

    async def stopped(
        self, stops: Mapping[str, "asyncio.Future[StopOutcome]"]
    ) -> Mapping[str, StopOutcome]:
        """Await stops by name; a failed stop gives the possible output of its amplifier."""
        stop_outcomes: dict[str, StopOutcome] = {}
        for name, result in zip(stops, await outcomes([*stops.values()]), strict=True):
            if isinstance(result, BaseException):
                cause = f"{type(result).__name__}: {result}"
                result = self.amplifiers[name].what_may_play(cause)
            stop_outcomes[name] = result
        return stop_outcomes


async def _to_completion(task: "asyncio.Future[_T]") -> _T:
    """Await a task to its end even if the caller is cancelled; then raise the cancellation."""
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        task.exception()  # so that asyncio does not report it; the amplifiers' own errors are
        raise cancellation
    return task.result()


async def outcomes(requests: Sequence[Awaitable[_T]]) -> list[_T | BaseException]:
    """Await all requests to their ends; returns the result or the error of each."""
    if len(requests) > 1:
        return await asyncio.gather(*requests, return_exceptions=True)
    results = list[_T | BaseException]()
    for request in requests:  # `gather` would take a further iteration of the event loop
        try:
            results.append(await request)
        except Exception as error:
            results.append(error)
    return results


def is_lost(amplifier: Amplifier) -> bool:
    """Whether an amplifier cannot be reached: its line is gone, or it is mute past its watchdog."""
    if amplifier.silence_cause is None or amplifier.line.loss is not None:
        return amplifier.line.loss is not None
    return threads.now() >= amplifier.feeding.lost_from


_STEP = AHEAD_MAX // 2  # between two high words that are tried


def _words_of(moment: float, amplifiers: Sequence[Amplifier]) -> dict[Amplifier, int]:
    """Return the nearest high word of the clock of each amplifier at a moment [s]."""
    steered_word = high_word(clock_at(moment + HIGH_TIME / 2))
    words = {}
    for amplifier in amplifiers:
        if amplifier.clock.can_be_steered:
            words[amplifier] = steered_word
        else:
            words[amplifier] = high_word(clock_at(_shown(amplifier, moment)))
    return words


def word_passed_by_all(now: float, amplifiers: Sequence[Amplifier]) -> int:
    """Return a high word in the past of all amplifiers' clocks, now [s] and soon.

    A commit with it starts immediately.
    """
    at = word_passed(now)
    times = []
    for amplifier in amplifiers:
        if not amplifier.clock.can_be_steered:
            times.append(_shown(amplifier, now))
            times.append(_shown(amplifier, now + COMMITTING))
    for _ in range(HIGH_WORDS // _STEP):
        if all(moment_of(at, time) is None for time in times):
            break
        at = (at - _STEP) % HIGH_WORDS
    return at


def _shown(amplifier: Amplifier, time: float) -> float:
    """Return the clock of an amplifier at a time [s], rounded to a high word."""
    return time + amplifier.clock.lead(time) + HIGH_TIME / 2


INTERVAL = 1 << 12
"""Number of tokens after which the gaps are checked again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16


@dataclass(frozen=True)
class PlayedSet:
    """A set in playback."""

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    """Achieved playback of each amplifier, by name."""
    starts_at: float
    """Earliest start [s] of the last amplifier."""


class JointSets:
    """The sets of a group's amplifiers; token: the token before the first set."""

    def __init__(self, members: Members, token: int) -> None:
        self._members = members
        self.token = token
        """Token of the last set."""
        self.is_incomplete = False
        """Whether perhaps only some amplifiers have committed the last set."""

    @property
    def is_in_doubt(self) -> bool:
        """Whether it is unknown if all amplifiers play the last set, which is then silenced."""
        amplifiers = self._members.amplifiers.values()
        return self.is_incomplete or any(map(attrgetter("is_in_doubt"), amplifiers))

    def refusal_of(self, layers: Mapping[str, Sequence[AmplifierLayer]]) -> CommandRefused | None:
        """Return why ledgers would not admit layers by amplifier now; None if all would.

        It returns None also while a set is in doubt, since that set is silenced first.
        """
        if self.is_in_doubt:
            return None
        amplifiers = self._members.amplifiers
        refusals = {}
        for name, amplifier_layers in layers.items():
            refusal = amplifiers[name].refusal_of(amplifier_layers)
            if refusal is not None:
                refusals[name] = refusal
        return _merged(refusals) if refusals else None

    async def play(
        self,
        layers: Mapping[str, Sequence[AmplifierLayer]],
        is_preempted: IsPreempted | None = None,
    ) -> PlayedSet | DriverError:
        """Stage and commit layers by amplifier; a refusal before the first commit is returned.

        Preempted is returned if a lost commit is too late to be repeated; all are silent then.
        Overtaken is returned if the set is preempted before its commit.
        """
        amplifiers = sorted([self._members.amplifiers[name] for name in layers], key=need)
        self._members.has_joint_set = len({amplifier.line for amplifier in amplifiers}) > 1
        epoch = self._members.epoch
        if self.token % INTERVAL == 0:
            await self._close_gaps()
        self.token = token = token_after(self.token)
        is_silent = all(map(is_silence, layers.values()))
        priority = Priority.SILENCE if is_silent else Priority.SET
        is_now = is_silent or len(layers) == 1
        began = threads.now()
        stagings = []
        for amplifier in amplifiers:
            stagings.append(
                amplifier.stage(
                    token,
                    layers[amplifier.name],
                    now=is_now,
                    priority=priority,
                    is_preempted=is_preempted,
                )
            )
        results = dict(zip(amplifiers, await outcomes(stagings), strict=True))
        refusals, has_failed = _refusals(results, is_now=is_now)
        if refusals and not (has_failed or is_silent):
            refusal = _merged(refusals)
            return await self._silenced(refusal, amplifiers, began) if is_now else refusal
        try:
            staged = self._staged(results, refusals)
        except Overtaken as overtaken:
            return overtaken
        if is_preempted is not None and not is_now and is_preempted():
            return Overtaken(f"set {token} is preempted")
        if not is_now:
            late_refusal = await self._commit_after_staging(staged, epoch)
            if late_refusal is not None:
                return await self._silenced(late_refusal, amplifiers, began)
        self.is_incomplete = False
        return await self._played(token, staged)

    def _staged(
        self, results: Mapping[Amplifier, StagedSet | BaseException], refused: Collection[str]
    ) -> dict[Amplifier, StagedSet]:
        """Return the staged sets, or raise the failure of an amplifier.

        refused: names of amplifiers whose ledger has refused its set. A worse failure of another
        amplifier is raised first.
        """
        others = [result for amplifier, result in results.items() if amplifier.name not in refused]
        self._members.checked(others)
        staged_sets = self._members.checked([*results.values()])
        return dict(zip(results, staged_sets, strict=True))

    async def _commit_after_staging(
        self, staged: Mapping[Amplifier, StagedSet], epoch: int
    ) -> CommandRefused | None:
        """Commit staged sets; return a refusal that is only due to lateness, raise others.

        epoch: of the members before staging.
        """
        self._members.check_none_since(epoch)
        self.is_incomplete = True
        try:
            await self._commit(staged)
        except CommandRefused as refusal:
            if refusal.until is None or self._members.epoch != epoch:
                raise
            return refusal
        return None

    async def _played(self, token: int, staged: Mapping[Amplifier, StagedSet]) -> PlayedSet:
        """Return the set that was committed, after reading how amplifiers have rounded it."""
        played = {amplifier.name: staged_set.layers for amplifier, staged_set in staged.items()}
        starts_at = max([amplifier.played_at for amplifier in staged], default=-math.inf)
        readings: dict[str, Awaitable[tuple[LayerSet, ...]]] = {}
        for amplifier, staged_set in staged.items():
            if not staged_set.is_exact:
                readings[amplifier.name] = _achieved(amplifier, staged_set)
        if readings:
            achieved = await self._members.all([*readings.values()])
            played.update(zip(readings, achieved, strict=True))
        return PlayedSet(token, played, starts_at)

    async def _silenced(
        self, refusal: CommandRefused, amplifiers: Sequence[Amplifier], began: float
    ) -> CommandRefused:
        """Silence a set that came too late, if it may play; returns the error with the reason.

        began: start of sending [s].
        """
        if refusal.until is None or not any(
            amplifier.played_at >= began for amplifier in amplifiers
        ):
            self.is_incomplete = False
            return refusal
        await self.silence(STOP_RAMP)
        return Preempted(str(refusal))

    async def silence(self, ramp: float) -> None:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed."""
        # Mute amplifiers come last, so that no other amplifier on the same line waits for them.
        amplifiers = self._members.by_need
        amplifiers.sort(key=lambda amplifier: amplifier.silence_cause is not None)
        await self._members.all([amplifier.silence(ramp) for amplifier in amplifiers])
        self.is_incomplete = False

    async def _commit(self, staged: Mapping[Amplifier, StagedSet]) -> None:
        """Commit on all lines for one moment, by one broadcast for amplifiers that share a line.

        Raises CommandRefused if an amplifier does not play its set afterwards.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        for amplifier in staged:
            by_line.setdefault(amplifier.line, []).append(amplifier)
        token = self.token
        moment: float | None = None  # None: immediately
        if len(by_line) > 1:
            await _freed(
                [*by_line], until=min([staged_set.until for staged_set in staged.values()])
            )
            moment = moment_behind(max([line.commit_arrives() for line in by_line]))
        for amplifier in staged:
            amplifier.starts = -math.inf if moment is None else moment
        if moment is None:
            words = dict.fromkeys(staged, word_passed_by_all(threads.now(), [*staged]))
        else:
            words = _words_of(moment, [*staged])
        requests: dict[Amplifier, Awaitable[Values]] = {}
        broadcasts: list[Awaitable[Values]] = []
        for line, sharing in by_line.items():
            at = words[sharing[0]]
            if len(sharing) == 1 or any(words[amplifier] != at for amplifier in sharing):
                for amplifier in sharing:  # alone on the line, or a clock is not steered
                    requests[amplifier] = amplifier.commit(token, words[amplifier])
                continue
            make = partial(commit_of, sharing, token, at)
            broadcasts.append(line.submit(None, Priority.SET, "Commit", make))
            for amplifier in sharing:  # a heartbeat confirms it, and feeds the watchdog meanwhile
                requests[amplifier] = amplifier.ping()
        # The broadcasts are awaited too: a queued one is not sent if this is cancelled.
        statuses = await self._members.all([*requests.values(), *broadcasts])
        for amplifier, status in zip(requests, statuses, strict=False):
            if status["token"] != token or status["state"] in LATCHED:
                await _check_plays(amplifier, status, token)

    async def _close_gaps(self) -> None:
        """Let amplifiers whose token is far behind commit an empty set, which changes nothing."""
        behind = [
            amplifier
            for amplifier in self._members.amplifiers.values()
            if amplifier.committed > 0 and (self.token - amplifier.committed) % _SPAN > _MAX_GAP
        ]
        if behind:  # amplifiers without a committed token accept any token as newer
            self.token = token_after(self.token)
            await self._members.all(
                [amplifier.stage(self.token, (), now=True) for amplifier in behind]
            )


async def _freed(lines: Sequence[Line], *, until: float) -> None:
    """Wait until a commit can be sent on all lines simultaneously, or until a time [s]."""
    while threads.now() < until:
        busy = [line.current.result for line in lines if line.current is not None]
        if not busy:
            return
        await asyncio.wait(busy)


def _refusals(
    results: Mapping[Amplifier, StagedSet | BaseException], *, is_now: bool
) -> tuple[dict[str, CommandRefused], bool]:
    """Return the ledgers' refusals of a set by amplifier, and whether it has failed otherwise.

    is_now: whether the set plays as soon as it arrives, so that an amplifier may play it although
    it has refused it.
    """
    refusals = {}
    has_failed = False
    for amplifier, result in results.items():
        if isinstance(result, CommandRefused) and not result.is_disarmed:
            if is_now and result.may_play:
                has_failed = True
            elif not isinstance(result, Preempted):
                refusals[amplifier.name] = result
        elif isinstance(result, BaseException):
            has_failed = True
    return refusals, has_failed


def _merged(refusals: Mapping[str, CommandRefused]) -> CommandRefused:
    """Join rejections by amplifier; `until` is known only if all rejections are temporary."""
    ends = [refusal.until for refusal in refusals.values() if refusal.until is not None]
    return CommandRefused(
        "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
        channel=next(iter(refusals.values())).channel,
        until=max(ends) if len(ends) == len(refusals) else None,
    )


def commit_of(amplifiers: Sequence[Amplifier], token: int, at: int) -> list[Values]:
    """Return a commit for several amplifiers of a line; raises unless it is allowed for all."""
    values = {"session": amplifiers[0].session, "token": token, "at": at}
    for amplifier in amplifiers:
        amplifier.next_request("Commit", values, Priority.SET)
    return [values]


async def _check_plays(amplifier: Amplifier, status: Values, token: int) -> None:
    """Raise CommandRefused unless an amplifier plays the set with this token.

    status: of a heartbeat, which may have been sent before the commit. If no status has shown the
    token, the commit is repeated once. The ledger compares what its layers play with each status.
    """
    if amplifier.committed != token and status["state"] not in LATCHED:
        amplifier.starts = -math.inf
        status = await amplifier.commit(token, word_passed_by_all(threads.now(), [amplifier]))
    if amplifier.committed != token or status["state"] in LATCHED:
        raise CommandRefused(
            f"amplifier {amplifier.name}: token must be {token} while armed, got "
            f"{status['token']} in state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: StagedSet) -> tuple[LayerSet, ...]:
    """Read how an amplifier achieved the layers of the set it plays."""
    return tuple([await amplifier.read_achieved(layer, staged.token) for layer in staged.layers])


# Errors of a clock [s]: a good clock does not lower a promise, a fair one by a tenth of a dB.
_GOOD, _FAIR, _POOR = 5e-6, 8e-6, 12e-6
_MAX_LOAD = 0.2  # share of the line's time for readings between heartbeats
_INTERVAL = 0.01  # s; between readings of a fair clock; half for a poor one, more for a better
_SETTLING = 0.2  # s; at most, for readings before clocks are needed
_FRAME = 1e-3  # s; a USB frame; readings should cover all of its phases
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples cover a circle evenly


class Clocks:
    """The clocks of the amplifiers of a group, on open lines."""

    def __init__(self, members: Members) -> None:
        self._members = members
        self._amplifiers = members.amplifiers
        self._are_alike = True
        """Whether all amplifiers and lines are alike."""
        self._dither = 0.0
        """The last varying part of a frame, see `later`."""
        self._readings: dict[Amplifier, asyncio.Future[Any]] = {}
        """The last reading of each clock."""
        self._turns: dict[Line, Iterator[Amplifier]] = {}
        """The amplifiers of each line in endless turns."""
        self._marked: set[Line] = set()
        """Lines of several amplifiers that all support Mark."""
        self._firsts: dict[Line, HeldClock | None] = {}
        """The clock of each line that the others follow."""

    def follow(self) -> None:
        """Adopt the amplifiers and lines as just identified."""
        amplifiers = self._amplifiers.values()
        self._are_alike = len({_kind(amplifier) for amplifier in amplifiers}) == 1
        for line in self._members.lines:
            line_amplifiers = [amplifier for amplifier in amplifiers if amplifier.line is line]
            self._turns[line] = cycle(line_amplifiers)
            mark_support = []
            for amplifier in line_amplifiers:
                mark_support.append(has_feature(amplifier.ledger.capabilities, "mark"))
            if len(line_amplifiers) > 1 and all(mark_support):
                self._marked.add(line)
        for amplifier in amplifiers:
            amplifier.clock.is_alone = len(amplifiers) == 1

    @property
    def errors(self) -> Mapping[str, float]:
        """Relative errors of the clocks [s rms] by amplifier; infinite if not synchronised.

        Each error combines the amplifier's specified error, the measured error of its clock and, if
        lines or amplifiers differ, half of the shortest exchange without its bits, because no
        exchange shows how that time is split between the two directions. A single amplifier has 0.
        """
        amplifiers = self._amplifiers
        if len(amplifiers) < 2:
            return dict.fromkeys(amplifiers, 0.0)
        now = next(iter(amplifiers.values())).line.time()
        leads = {}
        synchronised_leads = []
        uncompared_count = 0
        for name, amplifier in amplifiers.items():
            leads[name] = amplifier.clock.lead(now)
            if amplifier.clock.error(now) < math.inf:
                synchronised_leads.append(leads[name])
                uncompared_count += not amplifier.clock.is_compared
        is_common = len(self._members.lines) == 1 and uncompared_count == 1
        common_lead = median(synchronised_leads or [0.0])
        # With this factor the RMS of the errors is at least the RMS of their differences.
        count = len(synchronised_leads)
        factor = math.sqrt(count / max(count - 1, 1))
        errors = {}
        for name, amplifier in amplifiers.items():
            off = factor * (leads[name] - common_lead)
            clock_error = amplifier.clock.error(now, off=off, is_common=is_common)
            split_error = 0.0 if self._are_alike else amplifier.clock.shortest / 2
            errors[name] = math.hypot(clock_error, split_error)
        return errors

    async def settle(self) -> None:
        """Read poorly known clocks repeatedly while nothing plays, so that nothing is delayed.

        It ends early once an amplifier does not reply, or a stop or disarm has come.
        """
        lines = self._members.lines if len(self._amplifiers) > 1 else ()
        now = asyncio.get_running_loop().time()
        try:
            async with asyncio.TaskGroup() as settling:
                for line in lines:
                    settling.create_task(self._settle(line, now + _SETTLING))
        except* DriverError:  # arming finds the same error, and reports it
            pass

    async def _settle(self, line: Line, until: float) -> None:
        line_amplifiers = [
            amplifier
            for amplifier in self._amplifiers.values()
            if amplifier.line is line and amplifier.clock.can_be_steered
        ]
        epoch = self._members.epoch
        now = line.time()
        while now < until:
            errors = [amplifier.clock.scatter(now) for amplifier in line_amplifiers]
            if max(errors, default=0.0) <= _GOOD:
                break
            if line in self._marked:
                self._compare(line_amplifiers, now)
                await line.submit(None, Priority.READING, "Mark", {})
            for amplifier in line_amplifiers:
                if line.time() >= until or self._members.epoch != epoch:
                    return
                await amplifier.read_status(Priority.READING)
                await asyncio.sleep(self.later())
            now = line.time()

    def _compare(self, line_amplifiers: Sequence[Amplifier], now: float) -> None:
        """Make the clocks of a line follow the same clock as before, or else the best one."""
        line = line_amplifiers[0].line
        last_first = self._firsts.get(line)

        def rank(clock: HeldClock) -> tuple[bool, bool, bool, float]:
            # No other clock follows a clock that has jumped.
            error = clock.error(now)
            has_problem = clock.problem(now) is not None
            return error == math.inf, has_problem, clock is not last_first, error

        best = min([amplifier.clock for amplifier in line_amplifiers], key=rank)
        first = best if best.error(now) < math.inf else None
        self._firsts[line] = first
        for amplifier in line_amplifiers:
            amplifier.clock.compare(None if amplifier.clock is first else first)

    def look(self, by_line: Mapping[Line, Sequence[Amplifier]]) -> None:
        """Schedule readings of clocks between the heartbeats, which go out next.

        All lines are read equally often, because the lowest of several readings is the closer to
        the lead the more there are.
        """
        if len(self._amplifiers) == 1:
            return
        loop = asyncio.get_running_loop()
        now = loop.time()
        worst = 0.0
        unmarked: dict[Line, Sequence[Amplifier]] = {}
        for line, line_amplifiers in by_line.items():
            if line in self._marked:
                self._compare(line_amplifiers, now)
                # A Mark that waits for a reply would be sent in step with USB frames.
                delay = self.later(_INTERVAL + _busy_time(line_amplifiers))
                loop.call_later(delay, line.submit, None, Priority.HEARTBEAT, "Mark", {})
            else:
                unmarked[line] = line_amplifiers
                worst = max(worst, _worst_scatter(line_amplifiers, now))
        if worst <= _GOOD:
            return
        for line, line_amplifiers in unmarked.items():
            if line.late <= GRACE:
                self._schedule_readings(line, line_amplifiers, _reading_interval(worst))

    def _schedule_readings(
        self, line: Line, line_amplifiers: Sequence[Amplifier], min_interval: float
    ) -> None:
        """Schedule readings of a line's clocks until the next heartbeat.

        min_interval: between readings of one clock [s], longer on a busy line. A reading that waits
        for the reply to another one would be sent in step with USB frames.
        """
        loop = asyncio.get_running_loop()
        line_interval = max(min_interval, _busy_time(line_amplifiers) / _MAX_LOAD)
        interval = line_interval / len(line_amplifiers)
        for number in range(1, int(HEARTBEAT / interval)):
            amplifier = next(self._turns[line])
            loop.call_later(self.later(number * interval), self.read_clock, amplifier)

    def later(self, duration: float = 0.0) -> float:
        """Return a duration [s] plus a varying part of a frame."""
        self._dither = (self._dither + _GOLDEN) % 1.0
        return duration + self._dither * _FRAME

    def read_clock(self, amplifier: Amplifier) -> None:
        """Read the status of an amplifier, if it replies, can be steered and is not being read."""
        reading = self._readings.get(amplifier)
        is_free = amplifier.clock.can_be_steered and (reading is None or reading.done())
        is_heard = amplifier.silence_cause is None and amplifier.line.loss is None
        if is_free and is_heard and not self._members.has_joint_set:
            self._readings[amplifier] = amplifier.read_status(Priority.READING)


def _busy_time(line_amplifiers: Sequence[Amplifier]) -> float:
    """Return how long heartbeats to all amplifiers of a line take [s]."""
    busy = 0.0
    for amplifier in line_amplifiers:
        last_round_trip = amplifier.counts.last_round_trip or 0.0
        busy += max(amplifier.exchange_time("GetStatus"), last_round_trip)
    return busy


def _worst_scatter(line_amplifiers: Sequence[Amplifier], now: float) -> float:
    """Return the largest scatter [s] of the clocks that can be steered; 0 if there are none."""
    worst = 0.0
    for amplifier in line_amplifiers:
        if amplifier.clock.can_be_steered:
            worst = max(worst, amplifier.clock.scatter(now))
    return worst


def _reading_interval(scatter: float) -> float:
    """Return the interval between readings of a clock with a scatter above _GOOD [s]."""
    if scatter > _POOR:
        return _INTERVAL / 2
    return _INTERVAL * max((_FAIR - _GOOD) / (scatter - _GOOD), 1.0)


def _kind(amplifier: Amplifier) -> tuple[Any, ...]:
    """Return what must be equal for two amplifiers to receive their requests equally late."""
    line = amplifier.line
    identity = amplifier.identity
    device = re.match(r"/.*/(\D*)", line.name)  # without its number; None for a network
    model = identity.get("vendor"), identity.get("product"), identity.get("firmware")
    return type(line.wire), device and device[1], model
