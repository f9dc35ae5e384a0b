"""Checks of sets in parts: which are kept, what the last is told, and what a refused set drops."""

from dataclasses import replace
from functools import partial
from typing import Any

from drivers.protocol.definition import COMMAND, ENVELOPE, KNOT, LAYER, MESSAGES, STAGED_LIFE
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import (
    Material,
    Rows,
    Send,
    layer,
    play,
    require,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_PLACE = "protocol.md#sets"
_SHAPED = COMMAND.words + 2 * ENVELOPE.words  # of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set: more take a slow wire longer than a set lives
_LONG, _SHORT = 600, 60  # words of a set of several parts
_SLOW = 0.03  # s; of a line, for an exchange of the longest messages
_OLD = "BAD_TOKEN"


def set_of(material: Material, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    channels, max_knots = len(material.channels), material.can["knots"]
    # All but the heads of layers has an even number of words.
    bare = LAYER.words + _SHAPED * channels
    max_layers = min(len(material.layers), room // bare)
    counts = [each for each in range(1, max_layers + 1) if each % 2 == room % 2] or [max_layers]
    full = bare + 2 * KNOT.words * channels * max_knots
    count = next((each for each in counts if each * full >= room), counts[-1])
    left = max(room - count * bare, 0) // KNOT.words
    layers = []
    for number in range(count):
        tones = []
        for channel in material.channels:
            knots = [min(left, max_knots), min(max(left - max_knots, 0), max_knots)]
            left -= sum(knots)
            onset, ending = (material.envelope(0.001, *[0.1 + 0j] * each) for each in knots)
            tones.append(material.tone(channel, 0.1, onset=onset, ending=ending))
        layers.append(layer(number, *tones))
    return layers


def long_set(subject: Subject) -> list[LayerSet]:
    """Make a set of several parts, a short one on a slow line, lest it expires on its way."""
    is_quick = max(subject.client.transit, subject.exchange_time) < _SLOW
    return set_of(subject, min(subject.can["set_words"], _LONG if is_quick else _SHORT))


def _require_quick(subject: Subject) -> None:
    require(
        16 * subject.exchange_time <= STAGED_LIFE,
        "the line is too slow for a set in several parts",
    )


def _cut(subject: Subject, *layers: LayerSet, token: int, now: int = 0) -> list[Send]:
    """Cut a set into three parts or more."""
    cut = subject.parts(*layers, token=token, now=now, count=3)
    return [send("Set", **each) for each in cut]


def _with(row: Send, *, code: str = "", **changed: Any) -> Send:
    """Return a part with other values, and the answer that it must have."""
    return replace(row, values={**row.values, **changed}, codes=(code,))


@driving(_PLACE)
def parts_of_sets(subject: Subject) -> Rows:
    """It takes parts in any order and again, and replies to the last alone: once whole, to it."""
    _require_quick(subject)
    made = long_set(subject)

    def in_turn(token: int, now: int) -> Rows:
        first, *others, last = _cut(subject, *made, token=token, now=now)
        incomplete = send("Commit", token=token, code="INCOMPLETE")
        late = [row for each in (*reversed(others), others[-1]) for row in (each, incomplete, last)]
        if now:
            return [first, last, *others, last, last, 0.05]
        again = first, others[0], last, send("Commit", token=token), last
        return [last, *late, first, incomplete, last, last, *again, 0.05]

    others = play(subject.one(), *(layer(each) for each in subject.layers[1:]), token=3)
    at_once, back = _cut(subject, *made, token=6), send("Commit", token=6)
    return [
        *(subject.arm, subject.one(), *in_turn(2, now=0), others, 0.05, *in_turn(4, now=1)),
        # Back to back, and what says `now` is the last part alone.
        *(play(subject.one(), token=5), partial(subject.send_all, at_once), back),
        *(_with(each, token=7, now=1) for each in at_once[:-1]),
        *(_with(at_once[-1], token=7), _with(at_once[-1], token=7, now=1)),
    ]


@driving(_PLACE)
def parts_that_are_dropped(subject: Subject) -> Rows:
    """It drops a part of what it cannot keep without a word, and the set under way stays."""
    _require_quick(subject)
    made = long_set(subject)
    first, second, *others, last = _cut(subject, *made, token=9)
    count = len(others) + 3
    dropped: list[Values] = [
        {"session": subject.next_session % 0xFFFF + 1},
        *({"token": token} for token in (5, 4, 8, 5 + 0x8000)),
        {"parts": count + 1},
    ]
    head = MESSAGES["Set"].request.pack({"session": subject.next_session, **second.values})
    nameless = [0, *head[1:]], [head[0], 0, *head[2:]]
    refused: list[tuple[Values, str]] = [
        *(({"index": count}, "BAD_VALUE"), ({"index": count, "token": 10}, "BAD_VALUE")),
        *(({"index": 255, "token": 10}, "BAD_VALUE"), ({"parts": 1, "index": 0}, "BAD_VALUE")),
        ({"index": 0, "parts": 0, "token": 10}, "BAD_VALUE"),
        *(({"token": 8}, _OLD), ({"token": 4}, _OLD), ({"token": 10}, "")),
        ({"token": 4, "index": count}, _OLD),
    ]
    return [
        *(subject.arm, play(subject.one(), token=5), last, first),
        *(_with(second, **each) for each in dropped),
        *(partial(subject.client.part, MESSAGES["Set"].number, each) for each in nameless),
        *(_with(last, code=code, **each) for each, code in refused),
        _with(last, token=5),
        last,
        *others,
        *(second, last),
        *(_with(second, **each) for each in dropped),
        *(send("Commit", token=9), send("Disarm", ramp=0), subject.settle, first),
        _with(last, code="WRONG_STATE"),
    ]


@driving(_PLACE)
def parts_again(subject: Subject) -> Rows:
    """It replaces a part by one that comes again, and confirms a whole set without a look."""
    _require_quick(subject)
    first, *others, last = _cut(subject, *long_set(subject), token=2)
    nonsense = [0xFFFF] * 3
    return [
        *(subject.arm, subject.one(), _with(first, stream=nonsense)),
        *others,
        *(first, last),
        *(_with(first, stream=nonsense), _with(last, stream=nonsense), last),
        *(send("Commit", token=2), _with(last, stream=nonsense, now=1), _with(last, index=0)),
    ]


@driving(_PLACE)
def refused_parts(subject: Subject) -> Rows:
    """It drops the parts of a set that is refused whole, and of no other."""
    _require_quick(subject)
    flawed = layer(len(subject.layers) - 1, subject.tone(), subject.tone())
    half, quarter = subject.one(level=0.5), subject.one(level=0.25)
    good = _cut(subject, *long_set(subject), token=5)
    first, *others, last = _cut(subject, half, flawed, token=2)
    flawed_one = partial(replace, codes=("BAD_CHANNEL",), channels=(0,))
    return [
        *(subject.arm, quarter, first),
        *others,
        *(flawed_one(last), last),
        *(
            stage(half, token=3),
            flawed_one(play(flawed, token=4)),
            flawed_one(stage(flawed, token=4)),
        ),
        # A last part of a newer set that is not whole changes nothing; one that is kept does.
        *(good[-1], send("Commit", token=3), stage(quarter, token=4)),
        *good[:-1],
        *(_with(stage(quarter, token=4), code=_OLD), send("Commit", token=4, code=_OLD)),
        *(flawed_one(stage(flawed, token=6)), good[-1], send("Commit", token=5)),
        *(stage(half, token=6), play(quarter, token=7), send("Commit", token=6, code=_OLD)),
    ]


@driving(_PLACE)
def empty_sets(subject: Subject) -> Rows:
    """It takes parts without words, and a set without any, which changes nothing."""
    one, half = subject.one(valid_for=subject.lasting(300)), subject.one(level=0.5)
    first, *_, last = _cut(subject, half, token=4)
    empty = [_with(first, index=at, parts=4, stream=[]) for at in (0, 2)]
    empty_set = _with(last, token=2, index=0, parts=1, stream=[])
    # Modbus has a response to each, which takes longer than a set lives.
    count = 127 if subject.client.transactions == 1 else 9
    many = [_with(first, token=5, index=at, parts=count, stream=[]) for at in range(count)]
    return [
        *(subject.arm, one, empty_set, send("Commit", token=2)),
        *(_with(empty_set, token=3, now=1), 0.1),
        *(empty[0], _with(first, index=1, parts=4, stream=pack_layers([half])), empty[1]),
        *(_with(last, index=3, parts=4, stream=[], now=1), partial(subject.send_all, many)),
    ]


@driving(_PLACE)
def max_set(subject: Subject) -> Rows:
    """It takes a set of as many words as it states, and refuses a longer one."""
    room = min(subject.can["set_words"], _MAX_TRIED)
    longer = set_of(subject, room + 2)
    is_longer = len(pack_layers(longer)) > subject.can["set_words"]
    flawed = replace(longer[0], renew=True)  # which is found after the length
    refused = [stage(flawed, *longer[1:], code="BAD_LENGTH")] if is_longer else []
    return [subject.arm, stage(*set_of(subject, room)), send("Commit", token=1), *refused]


@driving(_PLACE)
def sets_expire(subject: Subject) -> Rows:
    """It discards a set that is not committed, or not complete, 1 s after its first part."""
    _require_quick(subject)
    first, *others, last = _cut(subject, *long_set(subject), token=3)
    part, began = 0.45 * STAGED_LIFE - 3.5 * min(subject.exchange_time, 0.1), 0.0

    async def start(row: Send) -> None:
        nonlocal began
        await subject.send(row)
        began = (await subject.status()).when.latest

    async def outlive() -> None:
        lived = (await subject.status()).when.latest - began
        await subject.pause(max(1.03 * STAGED_LIFE - lived, 0.0))

    return [
        *(subject.arm, subject.one(), partial(start, first), part),
        *others,
        # One that is confirmed once more lives no longer.
        *(last, part, last, outlive, send("Commit", token=3, code=_OLD), last),
        partial(start, others[0]),
        *others[1:],
        *(0.55 * STAGED_LIFE, first, outlive, last),
    ]
