"""Sets of several amplifiers: staged on all of them, then committed at one moment, or on none.

A token is newer than another by less than half of 2^16 (RFC 1982): an amplifier that was left out
of 40 000 sets would take the next one for an older one. It commits one that changes nothing before.
"""

import asyncio
from collections.abc import Awaitable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from drivers.contents import Layer, is_silence
from drivers.errors import CommandRefused, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.comparison import name_of
from drivers.host.dialogue import Staged
from drivers.host.jobs import JointStart, Priority
from drivers.host.line import Line
from drivers.host.members import Members
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, token_after
from drivers.protocol.table import ENABLED, STATES


@dataclass(frozen=True)
class Played:
    """What amplifiers play of a set, by name, as they have achieved it; token: of the set.

    sent_at [s]: when the last commit went out.
    """

    token: int
    layers: Mapping[str, tuple[LayerSet, ...]]
    sent_at: float


class JointSets:
    """Sets of the amplifiers of a group, under tokens from a first one on."""

    def __init__(self, members: Members, token: int) -> None:
        self.is_incomplete = False
        """Whether possibly only some amplifiers have committed the last set."""
        self.token = token
        """Of the last set."""
        self._members = members

    async def play(self, layers: Mapping[str, Sequence[Layer]]) -> Played | CommandRefused:
        """Stage and commit layers by amplifier; a refusal before the first commit is returned."""
        amplifiers = self._members.amplifiers
        before = self._members.epoch
        if self.token % INTERVAL == 0:
            self.token = await close_gaps(amplifiers.values(), self.token)
        self.token = token = token_after(self.token)
        is_silent = all(map(is_silence, layers.values()))
        several: list[Amplifier] = []
        staging: list[Awaitable[Staged]] = []
        for name, of_one in layers.items():
            several.append(amplifiers[name])
            staging.append(several[-1].stage(token, of_one, now=is_silent))
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
        staged = self._members.checked(results)
        if not is_silent:
            self._members.check_none_since(before)
            self.is_incomplete = len(layers) > 1
            await self._commit(several, staged)
        self.is_incomplete = False
        return await self._played(layers, several, staged)

    async def _commit(self, several: Sequence[Amplifier], staged: Sequence[Staged]) -> None:
        """Commit on every line at one moment, by one broadcast where amplifiers share it.

        Raises CommandRefused where one does not play its set then.
        """
        token = self.token
        by_line: dict[Line, list[Amplifier]] = {}
        for amplifier in several:
            by_line.setdefault(amplifier.line, []).append(amplifier)
        start = None
        if len(by_line) > 1:
            start = JointStart(len(by_line), until=min([one.until for one in staged]))
        requests: dict[Amplifier, Awaitable[Values]] = {}
        broadcasts: list[Awaitable[Values]] = []
        for line, sharing in by_line.items():
            if len(sharing) == 1:
                requests[sharing[0]] = sharing[0].commit(token, start=start)
                continue
            make = partial(_commit_of, sharing, token)
            sent = line.submit(None, Priority.SET, "Commit", {}, make=make, start=start)
            broadcasts.append(sent)
            for amplifier in sharing:
                requests[amplifier] = _status_of(amplifier, token, sent)
        # With the broadcasts: one that waits is not sent where this is given up.
        statuses = await self._members.all([*(requests[each] for each in several), *broadcasts])
        for amplifier, status, one in zip(several, statuses, staged, strict=False):
            _check_plays(amplifier.name, status, one)

    async def _played(
        self,
        names: Iterable[str],
        several: Sequence[Amplifier],
        staged: Sequence[Staged],
    ) -> Played:
        """Return what plays: as it was sent where it is played exactly, else as achieved."""
        sent_at = max([each.played_at for each in several])
        achieved = [one.layers for one in staged]
        inexact = [number for number, one in enumerate(staged) if not one.is_exact]
        if inexact:
            read = await self._members.all(
                [_achieved(several[number], staged[number]) for number in inexact]
            )
            for number, layers in zip(inexact, read, strict=True):
                achieved[number] = layers
        return Played(self.token, dict(zip(names, achieved, strict=True)), sent_at)


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
    values = {"session": several[0].session, "token": token}
    for amplifier in several:
        amplifier.while_admitted(token, values)
    return values


def _check_plays(name: str, status: Values, staged: Staged) -> None:
    """Raise CommandRefused unless a status shows that a set plays, in each of its layers."""
    for one in staged.layers:
        is_lasting = False
        for command in one.commands:
            is_lasting = is_lasting or (command.level > 0 and not one.after)
        got = dict(enumerate(status["tokens"])).get(one.layer)
        if is_lasting and got != staged.token:
            raise CommandRefused(
                f"amplifier {name}: token of layer {one.layer} must be {staged.token}, got {got}"
            )
    if status["token"] != staged.token or status["state"] != ENABLED:
        raise CommandRefused(
            f"amplifier {name}: token must be {staged.token} while armed, got {status['token']} in "
            f"state {name_of(STATES, status['state'])}"
        )


async def _achieved(amplifier: Amplifier, staged: Staged) -> tuple[LayerSet, ...]:
    """Read the layers of a set that plays, as the amplifier has achieved them."""
    return tuple([await amplifier.read_achieved(one) for one in staged.layers])


async def _status_of(amplifier: Amplifier, token: int, sent: Awaitable[Values]) -> Values:
    """Read the status after a broadcast that was sent, and commit again where that was lost."""
    status = await amplifier.read_status(Priority.SET)
    if status["token"] == token:
        return status
    await sent
    return await amplifier.commit(token)


INTERVAL = 1 << 12
"""Tokens after which the gaps are looked at again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16


async def close_gaps(amplifiers: Iterable[Amplifier], token: int) -> int:
    """Have amplifiers whose token is far behind one commit a set that changes nothing.

    Returns the token of that set, or the one that was given. Raises what `Amplifier.stage` raises.
    """
    behind = [each for each in amplifiers if _is_behind(each, token)]
    unchanged = [(each, layer) for each in behind if (layer := _unchanged(each)) is not None]
    if not unchanged:
        return token
    token = token_after(token)
    await asyncio.gather(*(each.stage(token, [layer], now=True) for each, layer in unchanged))
    return token


def _is_behind(amplifier: Amplifier, token: int) -> bool:
    committed = amplifier.committed  # 0: any is newer
    return committed > 0 and (token - committed) % _SPAN > _MAX_GAP


def _unchanged(amplifier: Amplifier) -> Layer | None:
    """Return a layer that is silent, or renewed without end; None if all end soon by themselves."""
    playback = amplifier.ledger.playback
    playing = playback.tokens
    for number in range(amplifier.capabilities["layers"]):
        if number not in playing:
            return Layer(number)
        if playback.is_endless(number):
            return Layer(number, renew=True)
    return None
