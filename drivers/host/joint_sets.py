"""Sets that several amplifiers play together.

A set is staged on all amplifiers that it names, and then committed on all or on none: by one
broadcast if they share a line, or on several lines for a moment that leaves enough time for the
slowest line. A set for one amplifier plays with its last part. A token is newer than another one if
it is ahead by less than half of 2^16 (RFC 1982); so an amplifier left out of 40 000 sets would
mistake the next one for an old set. It commits an empty set before that.
"""

import asyncio
import math
from collections.abc import Awaitable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from drivers.errors import CommandRefused, DriverError, Overtaken, Preempted
from drivers.host.amplifier import COMMITTING, Amplifier, IsPreempted
from drivers.host.ledger import StagedSet, is_silence
from drivers.host.line import Line, Priority
from drivers.host.members import Members, last_fed_at, outcomes
from drivers.playing import AmplifierLayer
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

INTERVAL = 1 << 12
"""Number of tokens after which the gaps are checked again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16
_STEP = AHEAD_MAX // 2  # between two high words that are tried


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
        if self.is_incomplete:
            return True
        return any(amplifier.is_in_doubt for amplifier in self._members.amplifiers.values())

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
        members = self._members
        amplifiers = [members.amplifiers[name] for name in layers]
        amplifiers.sort(key=last_fed_at)
        members.has_joint_set = len({amplifier.line for amplifier in amplifiers}) > 1
        try:
            return await self._stage_and_commit(amplifiers, layers, is_preempted)
        finally:
            members.has_joint_set = False

    async def _stage_and_commit(
        self,
        amplifiers: Sequence[Amplifier],
        layers: Mapping[str, Sequence[AmplifierLayer]],
        is_preempted: IsPreempted | None,
    ) -> PlayedSet | DriverError:
        """Stage and commit layers as `play` does; amplifiers: in the order of staging."""
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
        amplifiers = self._members.by_last_feeding
        amplifiers.sort(key=lambda amplifier: amplifier.no_reply_cause is not None)
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
            amplifier.set_start(moment)
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
        amplifier.check_may_send("Commit", values, Priority.SET)
    return [values]


async def _check_plays(amplifier: Amplifier, status: Values, token: int) -> None:
    """Raise CommandRefused unless an amplifier plays the set with this token.

    status: of a heartbeat, which may have been sent before the commit. If no status has shown the
    token, the commit is repeated once. The ledger compares what its layers play with each status.
    """
    if amplifier.committed != token and status["state"] not in LATCHED:
        amplifier.set_start(None)
        status = await amplifier.commit(token, word_passed_by_all(threads.now(), [amplifier]))
    if amplifier.committed != token or status["state"] in LATCHED:
        raise CommandRefused(
            f"amplifier {amplifier.name}: token must be {token} while armed, got "
            f"{status['token']} in state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: StagedSet) -> tuple[LayerSet, ...]:
    """Read how an amplifier achieved the layers of the set it plays."""
    return tuple([await amplifier.read_achieved(layer, staged.token) for layer in staged.layers])
