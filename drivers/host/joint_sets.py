"""Sets that several amplifiers play together.

`JointSets.play` stages a set on all amplifiers that it names, and then commits it on all or on
none: by one broadcast if they share a line, or on several lines for a moment that leaves enough
time for the slowest line. A set for one amplifier plays with its last part.

It returns a `PlayedSet`, or an `UnplayedSet` if no amplifier plays the set. It raises an error only
if it is unknown which amplifiers play it.

A token is newer than another one if it is ahead by less than half of 2^16 (RFC 1982); so an
amplifier left out of 40 000 sets would mistake the next one for an old set. It commits an empty set
before that.
"""

import asyncio
import math
from collections.abc import Awaitable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from drivers.errors import CommandRefused, Overtaken, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.amplifier_record import COMMITTING
from drivers.host.group_states import Failure
from drivers.host.ledger import is_silence
from drivers.host.line import Line
from drivers.host.members import Members, last_fed_at, outcomes
from drivers.host.requests import Priority
from drivers.host.set_admission import IsPreempted, StagedSet
from drivers.protocol.definition import (
    AHEAD_MAX,
    HIGH_TIME,
    HIGH_WORDS,
    LATCHED,
    STATES,
    STOP_RAMP,
    clock_at,
    high_word,
    moment_behind,
    moment_of,
    name_of,
    word_passed,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, token_after
from registry import threads

_TOKEN_SPAN = 1 << 16
_MAX_GAP = 1 << 14  # tokens; with the tokens between two checks, below half of the span
_TOKENS_BETWEEN_CHECKS = 1 << 12
_LINE_RECHECK = 0.5e-3  # s, between two looks at a line whose request nobody awaits
_WORD_STEP = AHEAD_MAX // 2  # between two high words that are tried


@dataclass(frozen=True)
class PlayedSet:
    """A set in playback."""

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    """Achieved playback of each amplifier, by name."""
    starts_at: float
    """Earliest start [s] of the last amplifier."""


@dataclass(frozen=True)
class UnplayedSet:
    """A set that no amplifier plays."""

    failure: Failure
    """REFUSED, OVERTAKEN or SILENCED."""
    reason: CommandRefused


SetOutcome: TypeAlias = PlayedSet | UnplayedSet
"""What has become of a set, once that is known."""


class JointSets:
    """The sets of a group's amplifiers; token: the token before the first set."""

    def __init__(self, members: Members, token: int) -> None:
        self._members = members
        self.token = token
        """Token of the last set."""
        self.is_incomplete = False
        """Whether perhaps only some amplifiers have committed the last set."""
        self.is_on_several_lines = False
        """Whether a set for several lines is under way; no clock is read meanwhile."""

    @property
    def is_in_doubt(self) -> bool:
        """Whether it is unknown if all amplifiers play the last set, which is then silenced."""
        if self.is_incomplete:
            return True
        return any(amplifier.is_in_doubt for amplifier in self._members.amplifiers.values())

    def next_token(self) -> int:
        """Begin a set, and return its token."""
        self.token = token_after(self.token)
        return self.token

    def note_armed(self) -> None:
        """Note that all amplifiers have just been armed, and so play nothing."""
        self.is_incomplete = False

    def refusal_of(self, sets: Mapping[str, StagedSet]) -> CommandRefused | None:
        """Return why ledgers would not admit sets by amplifier now; None if all would.

        It returns None also while a set is in doubt, since that set is silenced first.
        """
        if self.is_in_doubt:
            return None
        amplifiers = self._members.amplifiers
        refusals = {}
        for name, amplifier_set in sets.items():
            refusal = amplifiers[name].refusal_of(amplifier_set)
            if refusal is not None:
                refusals[name] = refusal
        return _merged(refusals) if refusals else None

    async def play(
        self,
        sets: Mapping[str, StagedSet],
        is_preempted: IsPreempted | None = None,
    ) -> SetOutcome:
        """Play sets on the amplifiers with these names; all start at one moment.

        is_preempted: called before the set is sent, and again before it is committed; if it returns
        True, the set is given up. Raises DriverError if it is unknown which amplifiers play the
        set.
        """
        amplifiers = [self._members.amplifiers[name] for name in sets]
        amplifiers.sort(key=last_fed_at)
        lines = {amplifier.line for amplifier in amplifiers}
        self.is_on_several_lines = len(lines) > 1
        sets_in_order = {amplifier: sets[amplifier.name] for amplifier in amplifiers}
        try:
            return await self._play_on(sets_in_order, is_preempted)
        finally:
            self.is_on_several_lines = False

    async def _play_on(
        self,
        sets: Mapping[Amplifier, StagedSet],
        is_preempted: IsPreempted | None,
    ) -> SetOutcome:
        """Stage, judge, commit and report sets; sets: in the order of staging."""
        epoch = self._members.epoch
        if self._is_gap_check_due():
            await self._close_gaps()
        is_silent = all(is_silence(staged.requested) for staged in sets.values())
        is_immediate = is_silent or len(sets) == 1
        began = threads.now()
        token = self.next_token()
        stagings = []
        for amplifier, staged in sets.items():
            staging = amplifier.stage(
                staged,
                token,
                now=is_immediate,
                priority=Priority.SILENCE if is_silent else Priority.SET,
                is_preempted=is_preempted,
            )
            stagings.append(staging)
        replies = dict(zip(sets, await outcomes(stagings), strict=True))
        reason = self._judge(replies, is_immediate=is_immediate, is_silent=is_silent)
        if reason is None and not is_immediate:
            if is_preempted is not None and is_preempted():
                reason = Overtaken(f"set {token} is preempted")
            else:
                reason = await self._commit(token, sets, epoch, began)
        if reason is not None:
            return await self._give_up(reason, sets, began)
        self.is_incomplete = False
        return await self._report(token, sets)

    def _judge(
        self,
        replies: Mapping[Amplifier, StagedSet | BaseException],
        *,
        is_immediate: bool,
        is_silent: bool,
    ) -> CommandRefused | None:
        """Return why a set must be given up after staging; None if all amplifiers have staged it.

        is_immediate: whether each amplifier plays it as soon as it arrives. Raises the most severe
        error of an amplifier that may play the set, or that could not be silenced.
        """
        refusals, has_failed = _refusals(replies, is_immediate=is_immediate)
        if refusals and not has_failed and not is_silent:
            return _merged(refusals)
        others = []
        for amplifier, reply in replies.items():
            if amplifier.name not in refusals:
                others.append(reply)
        try:
            self._members.checked(others)  # before refusals, however severe these are
            self._members.checked([*replies.values()])
        except Overtaken as overtaken:
            return overtaken
        return None

    async def _commit(
        self, token: int, staged_sets: Mapping[Amplifier, StagedSet], epoch: int, began: float
    ) -> CommandRefused | None:
        """Commit the set of a token; return the refusal of a commit that came too late.

        epoch, began: of the members, and the time [s], before staging. Raises any other error.
        """
        self._members.check_none_since(epoch)
        self.is_incomplete = True
        try:
            await self._commit_on_lines(token, staged_sets)
        except CommandRefused as refusal:
            if refusal.until is None or self._members.epoch != epoch:
                raise
            self.is_incomplete = _may_play_since(began, staged_sets)
            return refusal
        return None

    async def _give_up(
        self, reason: CommandRefused, amplifiers: Iterable[Amplifier], began: float
    ) -> UnplayedSet:
        """Silence a set that came too late, if it may play; return it as unplayed.

        began: start of staging [s].
        """
        if isinstance(reason, Overtaken):
            return UnplayedSet(Failure.OVERTAKEN, reason)
        if reason.until is None or not _may_play_since(began, amplifiers):
            return UnplayedSet(Failure.REFUSED, reason)
        await self.silence(STOP_RAMP)
        return UnplayedSet(Failure.SILENCED, reason)

    async def _report(self, token: int, staged_sets: Mapping[Amplifier, StagedSet]) -> PlayedSet:
        """Return a set that all amplifiers play, after reading how they have rounded it."""
        played: dict[str, tuple[LayerSet, ...]] = {}
        readings: dict[str, Awaitable[tuple[LayerSet, ...]]] = {}
        for amplifier, staged_set in staged_sets.items():
            played[amplifier.name] = staged_set.layers
            if not staged_set.is_exact:
                readings[amplifier.name] = _achieved(amplifier, staged_set)
        starts_at = max([amplifier.played_at for amplifier in staged_sets], default=-math.inf)
        if readings:
            achieved = await self._members.all([*readings.values()])
            played.update(zip(readings, achieved, strict=True))
        return PlayedSet(token, played, starts_at)

    async def silence(self, ramp: float) -> None:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed."""
        # Mute amplifiers come last, so that no other amplifier on the same line waits for them.
        amplifiers = self._members.by_last_feeding
        amplifiers.sort(key=lambda amplifier: amplifier.no_reply_cause is not None)
        await self._members.all([amplifier.silence(ramp) for amplifier in amplifiers])
        self.is_incomplete = False

    async def _commit_on_lines(
        self, token: int, staged_sets: Mapping[Amplifier, StagedSet]
    ) -> None:
        """Commit a set on all lines for one moment, with one broadcast for each shared line.

        Raises CommandRefused if an amplifier does not play its set afterwards.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        for amplifier in staged_sets:
            by_line.setdefault(amplifier.line, []).append(amplifier)
        moment: float | None = None  # None: immediately
        if len(by_line) > 1:
            deadline = min([staged_set.until for staged_set in staged_sets.values()])
            await _wait_until_free([*by_line], until=deadline)
            moment = moment_behind(max([line.commit_arrives() for line in by_line]))
        for staged_set in staged_sets.values():
            staged_set.starts_at = moment
        words = _start_words(moment, [*staged_sets])
        requests: dict[Amplifier, Awaitable[Values]] = {}
        broadcasts: list[Awaitable[Values]] = []
        for line, line_amplifiers in by_line.items():
            line_words = {words[amplifier] for amplifier in line_amplifiers}
            if len(line_amplifiers) == 1 or len(line_words) > 1:  # a clock is not steered
                for amplifier in line_amplifiers:
                    requests[amplifier] = amplifier.commit(staged_sets[amplifier], words[amplifier])
                continue
            make = partial(commit_of, line_amplifiers, token, line_words.pop())
            broadcasts.append(line.submit(None, Priority.SET, "Commit", make))
            for amplifier in line_amplifiers:
                # A heartbeat confirms the broadcast, and feeds the watchdog meanwhile.
                requests[amplifier] = amplifier.ping()
        # The broadcasts are awaited too: a queued one is not sent if this is cancelled.
        statuses = await self._members.all([*requests.values(), *broadcasts])
        replies = statuses[: len(requests)]  # without the broadcasts
        for amplifier, status in zip(requests, replies, strict=True):
            if status["token"] != token or status["state"] in LATCHED:
                await _check_plays(amplifier, status, staged_sets[amplifier])

    def _is_gap_check_due(self) -> bool:
        """Whether so many sets have been sent that an amplifier's token may be far behind."""
        return self.token % _TOKENS_BETWEEN_CHECKS == 0

    async def _close_gaps(self) -> None:
        """Let amplifiers whose token is far behind commit an empty set, which changes nothing."""
        behind = []
        for amplifier in self._members.amplifiers.values():
            # An amplifier without a committed token accepts any token as newer.
            gap = (self.token - amplifier.committed) % _TOKEN_SPAN
            if amplifier.committed > 0 and gap > _MAX_GAP:
                behind.append(amplifier)
        if behind:
            token = self.next_token()
            stagings = [amplifier.stage(StagedSet(()), token, now=True) for amplifier in behind]
            await self._members.all(stagings)


def _may_play_since(began: float, amplifiers: Iterable[Amplifier]) -> bool:
    """Whether an amplifier may have started to play a set since a time [s]."""
    return any(amplifier.played_at >= began for amplifier in amplifiers)


def _start_words(moment: float | None, amplifiers: Sequence[Amplifier]) -> dict[Amplifier, int]:
    """Return the high word of each amplifier's clock at a moment [s]; None: immediately."""
    if moment is None:
        return dict.fromkeys(amplifiers, word_passed_by_all(threads.now(), amplifiers))
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
    for _ in range(HIGH_WORDS // _WORD_STEP):
        if all(moment_of(at, time) is None for time in times):
            break
        at = (at - _WORD_STEP) % HIGH_WORDS
    return at


def _shown(amplifier: Amplifier, time: float) -> float:
    """Return the clock of an amplifier at a time [s], rounded to a high word."""
    return time + amplifier.clock.lead(time) + HIGH_TIME / 2


async def _wait_until_free(lines: Sequence[Line], *, until: float) -> None:
    """Wait until a commit can be sent on all lines simultaneously, or a time [s] has passed.

    A request that ends after that time is awaited too: its line is busy anyway.
    """
    while threads.now() < until:
        busy = [line.current.result for line in lines if line.current is not None]
        if not busy:
            return
        unfinished = [reply for reply in busy if not reply.done()]
        if unfinished:
            await asyncio.wait(unfinished)
        else:  # their callers were cancelled, but the requests are still on the lines
            await asyncio.sleep(_LINE_RECHECK)


def _refusals(
    replies: Mapping[Amplifier, StagedSet | BaseException], *, is_immediate: bool
) -> tuple[dict[str, CommandRefused], bool]:
    """Return the ledgers' refusals of a set by amplifier, and whether it has failed otherwise.

    is_immediate: whether the set plays as soon as it arrives, so that an amplifier may play it
    although it has refused it.
    """
    refusals = {}
    has_failed = False
    for amplifier, reply in replies.items():
        if isinstance(reply, CommandRefused) and not reply.is_disarmed:
            if is_immediate and reply.may_play:
                has_failed = True
            elif not isinstance(reply, Preempted):
                refusals[amplifier.name] = reply
        elif isinstance(reply, BaseException):
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
        amplifier.check_may_send("Commit", values, Priority.SET)
    return [values]


async def _check_plays(amplifier: Amplifier, status: Values, staged: StagedSet) -> None:
    """Raise CommandRefused unless an amplifier plays a set.

    status: of a heartbeat, which may have been sent before the commit. If no status has shown the
    token of the set, the commit is repeated once. The ledger compares what its layers play with
    each status.
    """
    token = staged.token
    if amplifier.committed != token and status["state"] not in LATCHED:
        word = word_passed_by_all(threads.now(), [amplifier])
        staged.starts_at = None
        status = await amplifier.commit(staged, word)
    if amplifier.committed != token or status["state"] in LATCHED:
        raise CommandRefused(
            f"amplifier {amplifier.name}: token must be {token} while armed, got "
            f"{status['token']} in state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: StagedSet) -> tuple[LayerSet, ...]:
    """Read how an amplifier achieved the layers of the set it plays."""
    return tuple([await amplifier.read_achieved(layer, staged.token) for layer in staged.layers])
