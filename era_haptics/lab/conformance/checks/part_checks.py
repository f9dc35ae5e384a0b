"""Checks of sets in parts: kept parts, the reply to the last part, effects of a rejected set."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from drivers.protocol.definition import COMMAND, ENVELOPE, KNOT, LAYER, MESSAGES, STAGED_LIFE
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.outcomes import require
from era_haptics.lab.conformance.request_rows import (
    DISARM_NOW,
    RequestRows,
    Row,
    Send,
    Wait,
    commit,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_SHAPED = COMMAND.words + 2 * ENVELOPE.words  # of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set; on a slow wire, a longer set expires in transit
_LONG, _SHORT = 600, 60  # words of a set of several parts
_SLOW = 0.03  # s; exchange of the longest messages on a slow line
_MANY = 127  # parts
_MANY_ON_MODBUS = 9  # parts; each has a response, and all must arrive before the set expires


def long_set(subject: Subject) -> list[LayerSet]:
    """Make a set of several parts; a short set on a slow line, so that it does not expire in
    transit."""
    is_quick = max(subject.client.transit, subject.timing.exchange_time) < _SLOW
    max_words = _LONG if is_quick else _SHORT
    return _set_of(subject, min(subject.can["set_words"], max_words))


def _set_of(subject: Subject, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    count = _layer_count(subject, room)
    bare = LAYER.words + _SHAPED * len(subject.channels)
    remaining_knots = max(room - count * bare, 0) // KNOT.words
    layers = []
    for number in range(count):
        tones = []
        for channel in subject.channels:
            onset_knots = min(remaining_knots, subject.can["knots"])
            remaining_knots -= onset_knots
            ending_knots = min(remaining_knots, subject.can["knots"])
            remaining_knots -= ending_knots
            onset = subject.envelope(0.001, *[0.1 + 0j] * onset_knots)
            ending = subject.envelope(0.001, *[0.1 + 0j] * ending_knots)
            tones.append(subject.tone(channel, 0.1, onset=onset, ending=ending))
        layers.append(layer(number, *tones))
    return layers


def _layer_count(subject: Subject, room: int) -> int:
    """Return the smallest number of layers with all channels that can fill `room` words."""
    channels = len(subject.channels)
    bare = LAYER.words + _SHAPED * channels
    full = bare + 2 * KNOT.words * channels * subject.can["knots"]
    max_layers = min(len(subject.layers), room // bare)
    # Except for the heads of layers, the number of words is even.
    counts = [count for count in range(1, max_layers + 1) if count % 2 == room % 2]
    for count in counts:
        if count * full >= room:
            return count
    return counts[-1] if counts else max_layers


def _require_quick(subject: Subject) -> None:
    is_quick = 16 * subject.timing.exchange_time <= STAGED_LIFE
    require(is_quick, "the line is too slow for a set of several parts")


def _cut(subject: Subject, *layers: LayerSet, token: int, now: int = 0) -> list[Send]:
    """Cut a set into three parts or more."""
    set_parts = subject.sets.parts(*layers, token=token, now=now, count=3)
    return [send("Set", **part) for part in set_parts]


def _with(row: Send, *, code: str = "", **values: Any) -> Send:
    """Return a part with other values, and the reply that it must have."""
    return replace(row, values={**row.values, **values}, codes=(code,))


@driving("protocol.md#parts-of-a-set")
def parts_of_sets(subject: Subject) -> RequestRows:
    """Parts in any order, repeated or missing: Taken for the last only; Commit: INCOMPLETE.

    Collect parts by index, reply only to the last part, and report the first missing index in
    Taken.
    """
    _require_quick(subject)
    layers = long_set(subject)
    playing = subject.layer_0()
    silent_layers = [layer(number) for number in subject.layers[1:]]
    rows: list[Row] = [subject.arm, playing]
    rows += _staged_in_any_order(_cut(subject, *layers, token=2))
    rows += [play_now(playing, *silent_layers, token=3), Wait(0.05)]
    rows += _played_in_any_order(_cut(subject, *layers, token=4, now=1))
    together = _cut(subject, *layers, token=6)
    rows += [play_now(playing, token=5), partial(subject.send_all, together), commit(6)]
    # Only the last part decides whether the set plays immediately.
    *middle, last = together
    rows += [_with(part, token=7, now=1) for part in middle]
    rows += [_with(last, token=7), _with(last, token=7, now=1)]
    return rows


def _staged_in_any_order(set_parts: Sequence[Send]) -> list[Row]:
    """Return the parts of a set that is staged, the last one first, and repetitions."""
    first, *middle, last = set_parts
    token = first.values["token"]
    incomplete = commit(token, "INCOMPLETE")
    rows: list[Row] = [last]
    for part in (*reversed(middle), middle[-1]):
        rows += [part, incomplete, last]
    rows += [first, incomplete, last, last]
    rows += [first, middle[0], last, commit(token), last, Wait(0.05)]
    return rows


def _played_in_any_order(set_parts: Sequence[Send]) -> list[Row]:
    """Return the parts of a set that plays immediately, the last one too early, and repeated."""
    first, *middle, last = set_parts
    return [first, last, *middle, last, last, Wait(0.05)]


@driving("protocol.md#parts-of-a-set")
def parts_that_are_dropped(subject: Subject) -> RequestRows:
    """Part that must not be kept: no reply, the set being collected does not change.

    Compare session, token and number of parts before you store a part; drop it silently if one is
    wrong.
    """
    _require_quick(subject)
    set_parts = _cut(subject, *long_set(subject), token=9)
    first, second, *middle, last = set_parts
    count = len(set_parts)
    dropped_values: list[Values] = [
        {"session": subject.next_session % 0xFFFF + 1},
        *({"token": token} for token in (5, 4, 8, 5 + 0x8000)),
        {"parts": count + 1},
    ]
    dropped = [_with(second, **values) for values in dropped_values]
    drop_all = partial(subject.send_all, dropped)
    wrong_last_parts = partial(subject.send_all, _wrong_last_parts(last, count))
    rows: list[Row] = [subject.arm, play_now(subject.layer_0(), token=5), last, first, drop_all]
    rows += [*_parts_without_a_name(subject, second), wrong_last_parts]
    rows += [_with(last, token=5), last, *middle, second, last, drop_all, commit(9)]
    rows += [DISARM_NOW, subject.settle, first, _with(last, code="WRONG_STATE")]
    return rows


def _parts_without_a_name(subject: Subject, part: Send) -> list[Row]:
    """Return a part without a session, and without a token."""
    message = MESSAGES["Set"]
    words = message.request.pack({"session": subject.next_session, **part.values})
    without_session = [0, *words[1:]]
    without_token = [words[0], 0, *words[2:]]
    return [
        partial(subject.client.part, message.number, without_session),
        partial(subject.client.part, message.number, without_token),
    ]


def _wrong_last_parts(last: Send, count: int) -> list[Send]:
    """Return last parts that are rejected, and one of a newer set that is incomplete."""
    return [
        _with(last, index=count, code="BAD_VALUE"),
        _with(last, index=count, token=10, code="BAD_VALUE"),
        _with(last, index=255, token=10, code="BAD_VALUE"),
        _with(last, parts=1, index=0, code="BAD_VALUE"),
        _with(last, index=0, parts=0, token=10, code="BAD_VALUE"),
        _with(last, token=8, code="BAD_TOKEN"),
        _with(last, token=4, code="BAD_TOKEN"),
        _with(last, token=10),
        _with(last, token=4, index=count, code="BAD_TOKEN"),
    ]


@driving("protocol.md#parts-of-a-set")
def parts_again(subject: Subject) -> RequestRows:
    """Part sent again: replaces the first copy; last part of a whole set: only its token counts.

    Overwrite a stored part with its repetition. Once a set is staged or played, confirm its token
    without looking at the stream.
    """
    _require_quick(subject)
    first, *middle, last = _cut(subject, *long_set(subject), token=2)
    nonsense = [0xFFFF] * 3
    wrong_first = _with(first, stream=nonsense)
    wrong_last = _with(last, stream=nonsense)
    rows: list[Row] = [subject.arm, subject.layer_0(), wrong_first, *middle, first, last]
    rows += [wrong_first, wrong_last, last, commit(2)]
    rows += [_with(last, stream=nonsense, now=1), _with(last, index=0)]
    return rows


@driving("protocol.md#parts-of-a-set")
def refused_parts(subject: Subject) -> RequestRows:
    """Set rejected as a whole: its parts are dropped, other sets are kept.

    On a rejection, free only the parts collected under that token.
    """
    _require_quick(subject)
    half = subject.layer_0(level=0.5)
    quarter = subject.layer_0(level=0.25)
    flawed = layer(len(subject.layers) - 1, subject.tone(), subject.tone())
    first, *middle, last = _cut(subject, half, flawed, token=2)
    *valid_parts, valid_last = _cut(subject, *long_set(subject), token=5)
    rejected = partial(replace, codes=("BAD_CHANNEL",), channels=(0,))
    rows: list[Row] = [subject.arm, quarter, first, *middle, rejected(last), last]
    rows += [stage(half, token=3), rejected(play_now(flawed, token=4))]
    rows.append(rejected(stage(flawed, token=4)))
    # The last part of an incomplete newer set changes nothing; a part that is kept does.
    rows += [valid_last, commit(3), stage(quarter, token=4), *valid_parts]
    rows += [stage(quarter, token=4, code="BAD_TOKEN"), commit(4, "BAD_TOKEN")]
    rows += [rejected(stage(flawed, token=6)), valid_last, commit(5)]
    rows += [stage(half, token=6), play_now(quarter, token=7), commit(6, "BAD_TOKEN")]
    return rows


@driving("protocol.md#sets")
def empty_sets(subject: Subject) -> RequestRows:
    """Part or set without words: accepted, changes nothing.

    Accept parts of length 0, up to 127 parts, and a set without layers.
    """
    playing = subject.layer_0(valid_for=subject.scaled(300))
    half = subject.layer_0(level=0.5)
    part, *_, last = _cut(subject, half, token=4)
    empty_set = _with(last, token=2, index=0, parts=1, stream=[])
    empty_part = partial(_with, part, stream=[])
    is_on_modbus = subject.client.transactions > 1
    count = _MANY_ON_MODBUS if is_on_modbus else _MANY
    many_parts = [empty_part(token=5, index=index, parts=count) for index in range(count)]
    rows: list[Row] = [subject.arm, playing, empty_set, commit(2)]
    rows += [_with(empty_set, token=3, now=1), Wait(0.1)]
    rows.append(empty_part(index=0, parts=4))
    rows.append(_with(part, index=1, parts=4, stream=pack_layers([half])))
    rows.append(empty_part(index=2, parts=4))
    rows.append(_with(last, index=3, parts=4, stream=[], now=1))
    rows.append(partial(subject.send_all, many_parts))
    return rows


@driving("protocol.md#sets")
def max_set(subject: Subject) -> RequestRows:
    """Set of set_words words: accepted; longer: BAD_LENGTH.

    Provide memory for the set_words that you state, and check the length before the contents.
    """
    room = min(subject.can["set_words"], _MAX_TRIED)
    rows: list[Row] = [subject.arm, stage(*_set_of(subject, room)), commit(1)]
    first, *others = _set_of(subject, room + 2)
    is_longer = len(pack_layers([first, *others])) > subject.can["set_words"]
    if is_longer:
        flawed = replace(first, renew=True)  # which is found after the length
        rows.append(stage(flawed, *others, code="BAD_LENGTH"))
    return rows


class ExpiringSet:
    """A set that is sent in parts and expires."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._began = 0.0

    async def start(self, part: Send) -> None:
        """Send the first part that is kept."""
        await self._subject.send(part)
        status = await self._subject.status()
        self._began = status.when.latest

    async def outlive(self) -> None:
        """Wait until the set must have expired."""
        subject = self._subject
        status = await subject.status()
        age = status.when.latest - self._began
        await subject.wait(max(1.03 * STAGED_LIFE - age, 0.0))
        await subject.status()
        subject.judge.sets.has_expired = False  # it must have


@driving("protocol.md#parts-of-a-set")
def sets_expire(subject: Subject) -> RequestRows:
    """Set not committed within 1 s of its first part: discarded.

    Start a timer of 1 s with the first part that is kept; repetitions do not restart it.
    """
    _require_quick(subject)
    first, *middle, last = _cut(subject, *long_set(subject), token=3)
    pause = Wait(0.45 * STAGED_LIFE - 3.5 * min(subject.timing.exchange_time, 0.1))
    expiring = ExpiringSet(subject)
    rows: list[Row] = [subject.arm, subject.layer_0(), partial(expiring.start, first), pause]
    # Another confirmation does not extend the life of a set.
    rows += [*middle, last, pause, last, expiring.outlive, commit(3, "BAD_TOKEN"), last]
    rows += [partial(expiring.start, middle[0]), *middle[1:]]
    rows += [Wait(0.55 * STAGED_LIFE), first, expiring.outlive, last]
    return rows
