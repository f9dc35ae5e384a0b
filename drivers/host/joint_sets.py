"""What amplifiers play together: a set is staged on all that it names, then committed on them.

At one moment on all, or on none: by one broadcast on a line that they share, on several lines for a
moment that is ahead for the slowest. On one amplifier it plays with its last part. A token is newer
than another by less than half of 2^16 (RFC 1982): an amplifier that was left out of 40 000 sets
would take the next one for an older one. It commits an empty one before.
"""

import asyncio
import math
from collections.abc import Awaitable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

from drivers.errors import CommandRefused, DriverError, Overtaken, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.dialogue import IsPreempted, Staged
from drivers.host.jobs import Priority
from drivers.host.ledger import is_silence
from drivers.host.line import Line
from drivers.host.members import Members, need, outcomes
from drivers.host.moments import word_passed_by_all, words_of
from drivers.playing.contents import Layer
from drivers.protocol.definition import LATCHED, STATES, STOP_RAMP, moment_behind, name_of
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, token_after
from registry import threads

INTERVAL = 1 << 12
"""Tokens after which the gaps are looked at again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16


@dataclass(frozen=True)
class Played:
    """What amplifiers play of a set, by name, as they have achieved it; token: of the set.

    starts_at [s]: at the soonest, the last of them.
    """

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    starts_at: float


class JointSets:
    """The sets of the amplifiers of a group, under tokens from a first one on."""

    def __init__(self, members: Members, token: int) -> None:
        self._members = members
        self.token = token
        """Of the last set."""
        self.is_incomplete = False
        """Whether possibly only some amplifiers have committed the last set."""

    @property
    def is_in_doubt(self) -> bool:
        """Whether it is unknown if the last set plays, on all amplifiers: it is silenced first."""
        every = self._members.amplifiers.values()
        return self.is_incomplete or any(map(attrgetter("is_in_doubt"), every))

    def refusal_of(self, layers: Mapping[str, Sequence[Layer]]) -> CommandRefused | None:
        """Return why ledgers would not admit layers by amplifier now; None if all would.

        Not while a set is in doubt, which is silenced first.
        """
        if self.is_in_doubt:
            return None
        amplifiers = self._members.amplifiers
        refusals = {
            name: refusal
            for name, each in layers.items()
            if (refusal := amplifiers[name].refusal_of(each)) is not None
        }
        return _merged(refusals) if refusals else None

    async def play(
        self, layers: Mapping[str, Sequence[Layer]], is_preempted: IsPreempted | None = None
    ) -> Played | DriverError:
        """Stage and commit layers by amplifier; a refusal before the first commit is returned.

        Preempted where a commit that was lost is too late to be repeated: then all are silent.
        Overtaken where it is preempted before that.
        """
        amplifiers = sorted([self._members.amplifiers[name] for name in layers], key=need)
        self._members.has_joint_set = len({each.line for each in amplifiers}) > 1
        before = self._members.epoch
        if self.token % INTERVAL == 0:
            await self._close_gaps()
        self.token = token = token_after(self.token)
        is_silent = all(map(is_silence, layers.values()))
        priority = Priority.SILENCE if is_silent else Priority.SET
        is_now = is_silent or len(layers) == 1
        began = threads.now()
        staging = partial(
            Amplifier.stage, token=token, now=is_now, priority=priority, is_preempted=is_preempted
        )
        results = await outcomes([staging(each, layers=layers[each.name]) for each in amplifiers])
        refusals: dict[str, CommandRefused] = {}
        has_failed = is_silent
        for each, result in zip(amplifiers, results, strict=True):
            if isinstance(result, CommandRefused) and not result.is_disarmed:
                if is_now and result.may_play:
                    has_failed = True
                elif not isinstance(result, Preempted):
                    refusals[each.name] = result
            elif isinstance(result, BaseException):
                has_failed = True
        if refusals and not has_failed:
            refusal = _merged(refusals)
            return await self._silenced(refusal, amplifiers, began) if is_now else refusal
        try:
            if refusals:  # of which nothing is told where anything worse happened
                several = zip(amplifiers, results, strict=True)
                self._members.checked([one for each, one in several if each.name not in refusals])
            staged = dict(zip(amplifiers, self._members.checked(results), strict=True))
        except Overtaken as overtaken:
            return overtaken
        if is_preempted is not None and not is_now and is_preempted():
            return Overtaken(f"set {token} is preempted")
        if not is_now:
            self._members.check_none_since(before)
            self.is_incomplete = True
            try:
                await self._commit(staged)
            except CommandRefused as refusal:
                if refusal.until is None or self._members.epoch != before:
                    raise
                return await self._silenced(refusal, amplifiers, began)
        self.is_incomplete = False
        played: dict[str, tuple[LayerSet, ...]] = {}
        reading: dict[str, Awaitable[tuple[LayerSet, ...]]] = {}
        starts_at = -math.inf
        for each, one in staged.items():
            played[each.name], starts_at = one.layers, max(starts_at, each.played_at)
            if not one.is_exact:
                reading[each.name] = _achieved(each, one)
        if reading:
            achieved = await self._members.all([*reading.values()])
            played.update(zip(reading, achieved, strict=True))
        return Played(token, played, starts_at)

    async def _silenced(
        self, refusal: CommandRefused, amplifiers: Sequence[Amplifier], began: float
    ) -> CommandRefused:
        """Silence a set that may play since a time [s], and came too late; returns why it ended."""
        if refusal.until is None or not any(each.played_at >= began for each in amplifiers):
            self.is_incomplete = False
            return refusal
        await self.silence(STOP_RAMP)
        return Preempted(str(refusal))

    async def silence(self, ramp: float) -> None:
        """Let all layers of all amplifiers fall silent along a ramp [s]; they stay armed."""
        # On a line that they share none waits for one that does not reply: that comes last.
        amplifiers = self._members.by_need
        amplifiers.sort(key=lambda each: each.silence_cause is not None)
        await self._members.all([each.silence(ramp) for each in amplifiers])
        self.is_incomplete = False

    async def _commit(self, staged: Mapping[Amplifier, Staged]) -> None:
        """Commit on every line for one moment, by one broadcast where amplifiers share it.

        Raises CommandRefused where one does not play its set then.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        for each in staged:
            by_line.setdefault(each.line, []).append(each)
        token = self.token
        moment: float | None = None  # at once
        if len(by_line) > 1:
            await _freed([*by_line], until=min([one.until for one in staged.values()]))
            moment = moment_behind(max([line.commit_arrives() for line in by_line]))
        for each in staged:
            each.starts = -math.inf if moment is None else moment
        if moment is None:
            words = dict.fromkeys(staged, word_passed_by_all(threads.now(), [*staged]))
        else:
            words = words_of(moment, [*staged])
        requests: dict[Amplifier, Awaitable[Values]] = {}
        broadcasts: list[Awaitable[Values]] = []
        for line, sharing in by_line.items():
            at = words[sharing[0]]
            if len(sharing) == 1 or any(words[each] != at for each in sharing):
                for each in sharing:  # alone, or with a clock that is not steered
                    requests[each] = each.commit(token, words[each])
                continue
            make = partial(_commit_of, sharing, token, at)
            broadcasts.append(line.submit(None, Priority.SET, "Commit", make))
            for each in sharing:  # by a heartbeat: where replies are late the watchdogs run
                requests[each] = each.ping()
        # With the broadcasts: one that waits is not sent where this is given up.
        statuses = await self._members.all([*requests.values(), *broadcasts])
        for each, status in zip(requests, statuses, strict=False):
            if status["token"] != token or status["state"] in LATCHED:
                await _check_plays(each, status, token)

    async def _close_gaps(self) -> None:
        """Have amplifiers whose token is far behind commit an empty set, which changes nothing."""
        behind = [
            each
            for each in self._members.amplifiers.values()
            if each.committed > 0 and (self.token - each.committed) % _SPAN > _MAX_GAP
        ]
        if behind:  # not of those that have committed none: any is newer
            self.token = token_after(self.token)
            await self._members.all([each.stage(self.token, (), now=True) for each in behind])


async def _freed(lines: Sequence[Line], *, until: float) -> None:
    """Wait until a commit can be sent on all lines at once, or for a time [s]."""
    while threads.now() < until and (
        busy := [line.current.result for line in lines if line.current is not None]
    ):
        await asyncio.wait(busy)


def _merged(refusals: Mapping[str, CommandRefused]) -> CommandRefused:
    """Join refusals by amplifier; `until` is known only if all of them pass by themselves."""
    known = [each.until for each in refusals.values() if each.until is not None]
    return CommandRefused(
        "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
        channel=next(iter(refusals.values())).channel,
        until=max(known) if len(known) == len(refusals) else None,
    )


def _commit_of(several: Sequence[Amplifier], token: int, at: int) -> list[Values]:
    """Return the commit of all amplifiers of a line; raises unless each may have it now."""
    values = {"session": several[0].session, "token": token, "at": at}
    for amplifier in several:
        amplifier.next_request("Commit", values, Priority.SET)
    return [values]


async def _check_plays(amplifier: Amplifier, status: Values, token: int) -> None:
    """Raise CommandRefused unless a status has shown the token of a set, or does once repeated.

    status: of a heartbeat, which may have gone before the commit: another may have shown it since.
    What its layers play is compared with every status.
    """
    if amplifier.committed != token and status["state"] not in LATCHED:
        amplifier.starts = -math.inf
        status = await amplifier.commit(token, word_passed_by_all(threads.now(), [amplifier]))
    if amplifier.committed != token or status["state"] in LATCHED:
        raise CommandRefused(
            f"amplifier {amplifier.name}: token must be {token} while armed, got "
            f"{status['token']} in state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: Staged) -> tuple[LayerSet, ...]:
    """Read the layers of a set that plays, as the amplifier has achieved them."""
    return tuple([await amplifier.read_achieved(one, staged.token) for one in staged.layers])
