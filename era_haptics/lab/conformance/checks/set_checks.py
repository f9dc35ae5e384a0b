"""Checks of the contents of a set, and that it is accepted completely or not at all.

Checks of sets in parts: kept parts, the reply to the last part, and effects of a rejected set.

Checks of tokens: staging, one commit, their order, expiry after a second, start times.
"""

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

from drivers.playing import VoiceTransition
from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    COMMAND,
    ENVELOPE,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    KNOT,
    LAYER,
    MAX_AHEAD,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
    ahead,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import (
    FULL,
    RequestRows,
    Send,
    expect_within,
    in_batches,
    layer,
    play_now,
    require,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expected_output import CLOCK_DRIFT
from registry import threads

_SCANNED = 8
_AT_ONCE = 6  # sets that are refused, before a look at the status
_LEVEL, _PHASE = QUANTITIES["level"].maximum, QUANTITIES["phase"]
_TONE = "frequency", "level", "phase"


@driving("protocol.md#layers")
def every_channel(subject: Subject) -> RequestRows:
    """Set for several channels: each at its own level, channels left out fall silent.

    Use the channel number of the command, not its position in the set, and release the voices of a
    named layer that get no new command.
    """
    tones = [subject.tone(channel, 1 - 0.05 * channel) for channel in subject.channels]
    reverse = [replace(tones[-1 - at], channel=at) for at in reversed(subject.channels)]
    but_one = reverse[: max(len(tones) - 1, 1)]
    alone = [layer(0, tone) for tone in tones]
    return [subject.arm, *alone, *(layer(0, *each) for each in (tones, reverse, but_one, []))]


@driving("protocol.md#readings")
def levels_of_every_frequency(subject: Subject) -> RequestRows:
    """Tone at the lowest and highest frequency of a channel: Status shows its level.

    Show the amplitude in full levels, whatever the frequency and the voltage that it takes, and
    accept both ends of the range.
    """
    ends = [
        (number, limits[end])
        for number, limits in enumerate(subject.can["limits"])
        for end in ("frequency_min", "frequency_max")
    ]
    return [subject.arm, *(layer(0, subject.tone(at, frequency=each)) for at, each in ends)]


@driving("protocol.md#readings")
async def achieved(subject: Subject) -> None:
    """GetAchieved: every value within half a step; Taken: exact only if nothing is rounded.

    Return the values that are really played with token, ramp and valid_for of their set, leave out
    released voices, and set exact only if nothing is rounded.
    """
    await subject.arm()
    shape = subject.envelope(0.0001)
    for number, first in product(subject.layers, (0.5, 0.98765)):
        tones = [
            subject.tone(
                channel,
                (first - 0.02 * channel) / len(subject.layers),
                20.0 * channel - 160.12 * first,
                frequency=min(subject.frequency + 7 * channel + 40 * number, subject.highest),
                keep=True,
                onset=shape,
                ending=shape,
            )
            for channel in subject.channels
        ]
        await subject.play(layer(number, *tones, ramp=number + 1, valid_for=50_000 + number))
        await subject.request("GetAchieved", layer=number)
    for number in subject.layers:
        await subject.request("GetAchieved", layer=number)
    # What fades is not listed, nor its layer once that is over, by an onset to level 0 too.
    other, to_0 = subject.tone(frequency=subject.other), subject.tone(0, 0.0, onset=shape)
    for one in (subject.one(other), layer(0), subject.one(to_0)):
        await subject.play(replace(one, ramp=subject.ramp))
        await subject.request("GetAchieved", layer=0)
    await subject.follow()
    await subject.request("GetAchieved", layer=0)


@driving("protocol.md#identity-and-capabilities")
async def steps_as_stated(subject: Subject) -> None:
    """Values within one step: rounded to at most two achieved values.

    State the frequency_step, level_step and phase_step with which you really play.
    """
    base = subject.tone(0)
    coarse = [name for name in _TONE if subject.can[f"{name}_step"] > 3]
    require(bool(coarse), "the stated steps are about as fine as the steps of the wire")
    ranges = {
        "frequency": (subject.lowest, base.frequency, subject.highest),
        "level": (1, base.level - subject.can["level_step"], _LEVEL),
        "phase": (_PHASE.minimum, base.phase, _PHASE.maximum),
    }
    await subject.arm()
    for name in coarse:
        found: set[int] = set()
        step = subject.can[f"{name}_step"]
        lowest, start, highest = ranges[name]
        for number in range(_SCANNED):
            value = min(max(start + number * step // _SCANNED, lowest), highest)
            await subject.play(layer(0, replace(base, **{name: value})))
            shown = await subject.request("GetAchieved", layer=0)
            found.update(each[name] for each in shown["commands"])
        expect_within(
            len(found), 0, 2, f"number of different achieved values within one {name}_step"
        )


def _part(words: list[int], code: str = "BAD_VALUE", *channels: int | None, **values: int) -> Send:
    """Send words as a single-part set; expect a rejection that names one of the channels."""
    part: Values = {"index": 0, "parts": 1, "stream": words, **values}
    return send("Set", code=code, channels=channels or (None,), **part)


def _flawed_tones(subject: Subject) -> Iterator[Command]:
    """Yield commands beyond the limits of their channel."""
    low = subject.can["envelope_step_min"]
    to_0 = partial(replace, level=0, onset=Envelope(low, ()))  # drives all the same
    for number, limits in enumerate(subject.can["limits"]):
        own, loud = subject.tone(number), limits["level_max"] + 1
        for frequency in (limits["frequency_min"] - 1, limits["frequency_max"] + 1):
            if 0 <= frequency <= 0xFFFF:
                yield from (replace(own, frequency=frequency), to_0(own, frequency=frequency))
        if loud <= FULL:
            above = Envelope(low, ((loud, 0),))
            yield from (
                replace(own, level=loud),
                replace(own, onset=above),
                replace(own, ending=above),
            )


def _flawed_shapes(subject: Subject) -> Iterator[list[int]]:
    """Yield words of sets whose onset, or an ending that is never played, cannot be played."""
    low, high = subject.can["envelope_step_min"], subject.can["envelope_step_max"]
    count, knot = subject.can["knots"], (100, 0)
    wrong = (_LEVEL + 1, 0), (100, _PHASE.maximum + 1), (100, 0x10000 + _PHASE.minimum - 1)
    bare = Envelope(low, ())
    onset = subject.tone(0, 0.5, onset=bare)
    ended = [replace(each, ending=bare) for each in (onset, subject.tone(0, 0.0))]
    for tone in (onset, *ended):
        start = pack_layers([layer(0, tone)])[: -ENVELOPE.words]
        yield from ([*start, 0, step] for step in (low - 1, high + 1))
        yield [*start, count + 1, low, *knot * (count + 1)]
        if count > 1:
            yield from ([*start, 2, low, *each, *knot] for each in wrong)
            yield [*start, 2, low, *knot, *wrong[0]]


def _flawed_sets(subject: Subject) -> Iterator[Send]:
    """Yield sets that must be refused: beside a good layer, and as words that no set can have."""
    tone, good = subject.tone(), layer(1, subject.tone(0, 0.5))
    channels, layers, ramp = len(subject.channels), len(subject.layers), subject.can["ramp_max"]
    for one in _flawed_tones(subject):
        yield _part(pack_layers([good, layer(0, one)]), "BAD_VALUE", one.channel)
    yield _part(pack_layers([good, layer(0, tone, tone)]), "BAD_CHANNEL", 0)
    if channels < 16:
        beyond = pack_layers([good, layer(0, replace(tone, channel=channels))])
        yield _part(beyond, "BAD_CHANNEL", channels)
    for layer_set in (
        layer(1, tone),
        layer(0, tone, renew=True),
        layer(0, after=True),
        layer(0, renew=True, after=True),
        *([layer(layers, tone)] if layers < 16 else []),
    ):
        yield from (_part(pack_layers(each)) for each in ([good, layer_set], [layer_set, good]))
    above = {"ramp": ramp + 1, "valid_for": QUANTITIES["valid_for"].maximum + 1}
    for headed in (layer(0, tone, tone), layer(0), layer(0, renew=True)):
        for name, number in above.items():
            start = pack_layers([good, headed])
            start[len(pack_layers([good])) + LAYER.places[name]] = number
            yield _part(start)
    words = pack_layers([layer(0, tone)])
    head, command = LAYER.places, COMMAND.places
    for at, word, named in (
        *((head["layer"], words[head["layer"]] | 1 << bit, (None,)) for bit in range(11, 16)),
        *(
            (LAYER.words + command[name], word, (0,))
            for name, word in (
                *(("channel", 1 << bit) for bit in range(8, 16)),
                ("level", _LEVEL + 1),
                ("phase", _PHASE.maximum + 1),
                ("phase", 0x10000 + _PHASE.minimum - 1),
            )
        ),
    ):
        yield _part([*words[:at], word, *words[at + 1 :]], "BAD_VALUE", *named)
    yield from (_part(each, "BAD_VALUE", 0) for each in _flawed_shapes(subject))
    yield _part([*words[:-2], 0, _PHASE.maximum + 1], "BAD_VALUE", 0)
    for wrong in (words[:-1], [*words, 0], [words[head["count"]] + 1, *words[1:]]):
        yield _part(wrong, "BAD_LENGTH")
    # Of two flaws it names the first: length, layer, channel, then the channel's words.
    long = [*words[: head["ramp"]], 1001, *words[head["ramp"] + 1 :]]
    loud = [*words[LAYER.words : -2], _LEVEL + 1, words[-1]]
    two = [words[0] + 1, *words[1 : LAYER.words]]
    yield _part(long[:-1], "BAD_LENGTH")
    yield _part([two[0], *long[1:], *words[LAYER.words :]], "BAD_VALUE")
    yield _part([*two, *words[LAYER.words :], *loud], "BAD_CHANNEL", 0)
    yield _part([*two, *loud, *words[LAYER.words :]], "BAD_VALUE", 0)
    for then in (words, words[:-1]):
        yield _part([*words[: LAYER.words], *loud, *then], "BAD_VALUE", 0)


@driving("protocol.md#parts-of-a-set")
def all_or_nothing(subject: Subject) -> RequestRows:
    """Set with one error: rejected as a whole with code and channel, playback unchanged.

    Validate the whole stream before you change anything, in the order of the page: length, layers,
    then each command with its onset and its ending.
    """
    flawed = [
        row
        for token, each in enumerate(_flawed_sets(subject), 2)
        for row in (
            replace(each, values={**each.values, "token": token, "now": token % 2}),
            *([] if token % _AT_ONCE else [send("Commit", token=token, code="BAD_TOKEN")]),
        )
    ]
    last, silent = len(flawed) + 2, pack_layers([layer(0)])
    return [
        subject.arm,
        subject.one(),
        *(partial(subject.send_all, each) for each in in_batches(flawed, _AT_ONCE)),
        play_now(subject.one(level=0.5), token=last),
        stage(subject.one(level=0.25)),
        _part(silent, "BAD_TOKEN", token=last - 1, now=1),
        send("Set", raw=[subject.next_session, 0, 1 << 1, *silent], code="BAD_TOKEN"),
        send("Commit", token=last + 1),
    ]


@driving("protocol.md#identity-and-capabilities")
def accepts_its_ranges(subject: Subject) -> RequestRows:
    """Values at the ends of the stated ranges, and any frequency at level 0: accepted.

    Treat limits as inclusive, and check the frequency only of commands that drive.
    """
    can, quiet = subject.can, round(subject.level * FULL)
    shapes = [
        Envelope(can[f"envelope_step_{end}"], ((quiet, _PHASE.maximum),) * count)
        for end in ("min", "max")
        for count in {0, min(1, can["knots"]), can["knots"]}
    ]
    loud = [
        Command(number, limits[end], limits["level_max"], _PHASE.minimum)
        for number, limits in enumerate(can["limits"])
        for end in ("frequency_min", "frequency_max")
    ]
    ramp, lasting = can["ramp_max"], QUANTITIES["valid_for"].maximum
    return [
        subject.arm,
        *(stage(subject.one(each, ramp=ramp, valid_for=lasting)) for each in loud),
        *(stage(subject.one(subject.tone(onset=each, ending=each))) for each in shapes),
        stage(layer(len(subject.layers) - 1, subject.tone(), ramp=ramp)),
        *(layer(0, Command(0, frequency, 0, 0)) for frequency in (0, 0xFFFF)),
    ]


_SHAPED = COMMAND.words + 2 * ENVELOPE.words  # of a command with two empty envelopes
_MAX_TRIED = 2000  # words of a set: more take a slow wire longer than a set lives
_LONG, _SHORT = 600, 60  # words of a set of several parts
_SLOW = 0.03  # s; of a line, for an exchange of the longest messages
_OLD = "BAD_TOKEN"


def set_of(subject: Subject, room: int) -> list[LayerSet]:
    """Make a set of this many words, or of as many as there can be."""
    channels, max_knots = len(subject.channels), subject.can["knots"]
    # All but the heads of layers has an even number of words.
    bare = LAYER.words + _SHAPED * channels
    max_layers = min(len(subject.layers), room // bare)
    counts = [each for each in range(1, max_layers + 1) if each % 2 == room % 2] or [max_layers]
    full = bare + 2 * KNOT.words * channels * max_knots
    count = next((each for each in counts if each * full >= room), counts[-1])
    left = max(room - count * bare, 0) // KNOT.words
    layers = []
    for number in range(count):
        tones = []
        for channel in subject.channels:
            knots = [min(left, max_knots), min(max(left - max_knots, 0), max_knots)]
            left -= sum(knots)
            onset, ending = (subject.envelope(0.001, *[0.1 + 0j] * each) for each in knots)
            tones.append(subject.tone(channel, 0.1, onset=onset, ending=ending))
        layers.append(layer(number, *tones))
    return layers


def long_set(subject: Subject) -> list[LayerSet]:
    """Make a set of several parts, a short one on a slow line, lest it expires on its way."""
    is_quick = max(subject.client.transit, subject.exchange_time) < _SLOW
    return set_of(subject, min(subject.can["set_words"], _LONG if is_quick else _SHORT))


def _require_quick(subject: Subject) -> None:
    require(
        16 * subject.exchange_time <= STAGED_LIFE,
        "the line is too slow for a set of several parts",
    )


def _cut(subject: Subject, *layers: LayerSet, token: int, now: int = 0) -> list[Send]:
    """Cut a set into three parts or more."""
    cut = subject.parts(*layers, token=token, now=now, count=3)
    return [send("Set", **each) for each in cut]


def _with(row: Send, *, code: str = "", **changed: Any) -> Send:
    """Return a part with other values, and the answer that it must have."""
    return replace(row, values={**row.values, **changed}, codes=(code,))


@driving("protocol.md#parts-of-a-set")
def parts_of_sets(subject: Subject) -> RequestRows:
    """Parts in any order, repeated or missing: Taken for the last only; Commit: INCOMPLETE.

    Collect parts by index, reply only to the last part, and report the first missing index in
    Taken.
    """
    _require_quick(subject)
    made = long_set(subject)

    def in_turn(token: int, now: int) -> RequestRows:
        first, *others, last = _cut(subject, *made, token=token, now=now)
        incomplete = send("Commit", token=token, code="INCOMPLETE")
        late = [row for each in (*reversed(others), others[-1]) for row in (each, incomplete, last)]
        if now:
            return [first, last, *others, last, last, 0.05]
        again = first, others[0], last, send("Commit", token=token), last
        return [last, *late, first, incomplete, last, last, *again, 0.05]

    others = play_now(subject.one(), *(layer(each) for each in subject.layers[1:]), token=3)
    at_once, back = _cut(subject, *made, token=6), send("Commit", token=6)
    return [
        subject.arm,
        subject.one(),
        *in_turn(2, now=0),
        others,
        0.05,
        *in_turn(4, now=1),
        # Back to back, and what says `now` is the last part alone.
        play_now(subject.one(), token=5),
        partial(subject.send_all, at_once),
        back,
        *(_with(each, token=7, now=1) for each in at_once[:-1]),
        _with(at_once[-1], token=7),
        _with(at_once[-1], token=7, now=1),
    ]


@driving("protocol.md#parts-of-a-set")
def parts_that_are_dropped(subject: Subject) -> RequestRows:
    """Part that must not be kept: no reply, the set being collected does not change.

    Compare session, token and number of parts before you store a part; drop it silently if one is
    wrong.
    """
    _require_quick(subject)
    made = long_set(subject)
    first, second, *others, last = _cut(subject, *made, token=9)
    count = len(others) + 3
    dropped: list[Values] = [
        {"session": subject.next_session % 0xFFFF + 1},
        *({"token": token} for token in (5, 4, 8, 5 + 0x8000)),
        {"parts": count + 1},
    ]
    drop_all = partial(subject.send_all, [_with(second, **each) for each in dropped])
    head = MESSAGES["Set"].request.pack({"session": subject.next_session, **second.values})
    nameless = [0, *head[1:]], [head[0], 0, *head[2:]]
    refused: list[tuple[Values, str]] = [
        ({"index": count}, "BAD_VALUE"),
        ({"index": count, "token": 10}, "BAD_VALUE"),
        ({"index": 255, "token": 10}, "BAD_VALUE"),
        ({"parts": 1, "index": 0}, "BAD_VALUE"),
        ({"index": 0, "parts": 0, "token": 10}, "BAD_VALUE"),
        ({"token": 8}, _OLD),
        ({"token": 4}, _OLD),
        ({"token": 10}, ""),
        ({"token": 4, "index": count}, _OLD),
    ]
    return [
        subject.arm,
        play_now(subject.one(), token=5),
        last,
        first,
        drop_all,
        *(partial(subject.client.part, MESSAGES["Set"].number, each) for each in nameless),
        partial(subject.send_all, [_with(last, code=code, **each) for each, code in refused]),
        _with(last, token=5),
        last,
        *others,
        second,
        last,
        drop_all,
        send("Commit", token=9),
        send("Disarm", ramp=0),
        subject.settle,
        first,
        _with(last, code="WRONG_STATE"),
    ]


@driving("protocol.md#parts-of-a-set")
def parts_again(subject: Subject) -> RequestRows:
    """Part sent again: replaces the first copy; last part of a whole set: only its token counts.

    Overwrite a stored part with its repetition. Once a set is staged or played, confirm its token
    without looking at the stream.
    """
    _require_quick(subject)
    first, *others, last = _cut(subject, *long_set(subject), token=2)
    nonsense = [0xFFFF] * 3
    return [
        subject.arm,
        subject.one(),
        _with(first, stream=nonsense),
        *others,
        first,
        last,
        _with(first, stream=nonsense),
        _with(last, stream=nonsense),
        last,
        send("Commit", token=2),
        _with(last, stream=nonsense, now=1),
        _with(last, index=0),
    ]


@driving("protocol.md#parts-of-a-set")
def refused_parts(subject: Subject) -> RequestRows:
    """Set rejected as a whole: its parts are dropped, other sets are kept.

    On a rejection, free only the parts collected under that token.
    """
    _require_quick(subject)
    flawed = layer(len(subject.layers) - 1, subject.tone(), subject.tone())
    half, quarter = subject.one(level=0.5), subject.one(level=0.25)
    good = _cut(subject, *long_set(subject), token=5)
    first, *others, last = _cut(subject, half, flawed, token=2)
    flawed_one = partial(replace, codes=("BAD_CHANNEL",), channels=(0,))
    return [
        subject.arm,
        quarter,
        first,
        *others,
        flawed_one(last),
        last,
        stage(half, token=3),
        flawed_one(play_now(flawed, token=4)),
        flawed_one(stage(flawed, token=4)),
        # The last part of an incomplete newer set changes nothing; a part that is kept does.
        good[-1],
        send("Commit", token=3),
        stage(quarter, token=4),
        *good[:-1],
        _with(stage(quarter, token=4), code=_OLD),
        send("Commit", token=4, code=_OLD),
        flawed_one(stage(flawed, token=6)),
        good[-1],
        send("Commit", token=5),
        stage(half, token=6),
        play_now(quarter, token=7),
        send("Commit", token=6, code=_OLD),
    ]


@driving("protocol.md#sets")
def empty_sets(subject: Subject) -> RequestRows:
    """Part or set without words: accepted, changes nothing.

    Accept parts of length 0, up to 127 parts, and a set without layers.
    """
    one, half = subject.one(valid_for=subject.lasting(300)), subject.one(level=0.5)
    first, *_, last = _cut(subject, half, token=4)
    empty = [_with(first, index=at, parts=4, stream=[]) for at in (0, 2)]
    empty_set = _with(last, token=2, index=0, parts=1, stream=[])
    # Modbus has a response to each, which takes longer than a set lives.
    count = 127 if subject.client.transactions == 1 else 9
    many = [_with(first, token=5, index=at, parts=count, stream=[]) for at in range(count)]
    return [
        subject.arm,
        one,
        empty_set,
        send("Commit", token=2),
        _with(empty_set, token=3, now=1),
        0.1,
        empty[0],
        _with(first, index=1, parts=4, stream=pack_layers([half])),
        empty[1],
        _with(last, index=3, parts=4, stream=[], now=1),
        partial(subject.send_all, many),
    ]


@driving("protocol.md#sets")
def max_set(subject: Subject) -> RequestRows:
    """Set of set_words words: accepted; longer: BAD_LENGTH.

    Provide memory for the set_words that you state, and check the length before the contents.
    """
    room = min(subject.can["set_words"], _MAX_TRIED)
    longer = set_of(subject, room + 2)
    is_longer = len(pack_layers(longer)) > subject.can["set_words"]
    flawed = replace(longer[0], renew=True)  # which is found after the length
    refused = [stage(flawed, *longer[1:], code="BAD_LENGTH")] if is_longer else []
    return [subject.arm, stage(*set_of(subject, room)), send("Commit", token=1), *refused]


@driving("protocol.md#parts-of-a-set")
def sets_expire(subject: Subject) -> RequestRows:
    """Set not committed within 1 s of its first part: discarded.

    Start a timer of 1 s with the first part that is kept; repetitions do not restart it.
    """
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
        await subject.status()
        subject.shown.sets.has_expired = False  # as it must have

    return [
        subject.arm,
        subject.one(),
        partial(start, first),
        part,
        *others,
        # Another confirmation does not extend the life of a set.
        last,
        part,
        last,
        outlive,
        send("Commit", token=3, code=_OLD),
        last,
        partial(start, others[0]),
        *others[1:],
        0.55 * STAGED_LIFE,
        first,
        outlive,
        last,
    ]


# s; of a moment, in which statuses are dense; by which levels may be older, and a sample
_AROUND, _NEAR = 0.015, 0.0003
_RISE, _ROUGH, _SAMPLE = 5, 0.0015, 0.00007  # ms; of full level: rounding; s, at 16 kHz
_SLOWEST, _FASTEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
# s; until a clock rate becomes visible; until a dropped set becomes visible
_STAGING_LONG, _BEHIND = 0.2, 0.02


@driving("protocol.md#start-of-a-set")
def stage_and_commit(subject: Subject) -> RequestRows:
    """Commit with the staged token: plays once, repeats confirmed; other tokens: BAD_TOKEN.

    Compare all 16 bits of the token. Confirm the token committed last, and reject every token that
    is not staged.
    """
    both = layer(0, subject.tone(0, 0.5), ramp=50), layer(1, subject.beside(1, 0.25))
    again = send("Commit", token=2), stage(*both, token=2), play_now(*both, token=2)
    others = (send("Commit", token=other, code=_OLD) for other in (3, 302, 2 ^ 0x100, 0))
    return [
        subject.arm,
        send("Commit", token=0, code=_OLD),
        subject.one(),
        stage(*both),
        *others,
        send("Commit", token=2),
        subject.follow,
        *again,
        *again,
        stage(subject.one(level=0.75), token=3),
        send("Commit", token=2),
        send("Commit", token=3),
        play_now(subject.one(), token=2, code=_OLD),
    ]


@driving("protocol.md#start-of-a-set")
def repeats_change_nothing(subject: Subject) -> RequestRows:
    """Commit or Set of the committed token, again: confirmed, nothing restarts.

    Compare the token with that committed last before you play anything, even if its vibration is
    over.
    """
    one, commit = subject.one(valid_for=300), send("Commit", token=1)
    again = commit, play_now(one, token=1)
    return [subject.arm, stage(one), commit, 0.2, *again, 0.13, *again]


@driving("protocol.md#sets")
def tokens_wrap(subject: Subject) -> RequestRows:
    """Token newer by 1 to 32767 modulo 65536: accepted; others: BAD_TOKEN.

    Compute (a - b) modulo 65536 in 16 bits and compare it with 1 to 32767.
    """
    rows: list[RequestRows] = [
        [
            play_now(subject.one(level=0.5), token=newer),
            *(
                play_now(layer(0), token=(newer + ahead) % 0x10000, code=_OLD)
                for ahead in (32_768, 32_769, 65_534)
                if newer + ahead != 0x10000
            ),
        ]
        for newer in (65_535, 1, 32_768, 65_535)
    ]
    return [
        subject.arm,
        play_now(subject.one(), token=65_530),
        *(row for each in rows for row in each),
    ]


@driving("protocol.md#parts-of-a-set")
def newer_sets_replace(subject: Subject) -> RequestRows:
    """New staged set, `now`, Silence or Disarm: the set staged before is dropped.

    Keep one staged set. Drop it when a newer set is staged or played and when the amplifier falls
    silent.
    """
    half, quarter = subject.one(level=0.5), subject.one(level=0.25)
    dropped = partial(send, "Commit", code=_OLD)
    return [
        subject.arm,
        stage(quarter),
        stage(half),
        dropped(token=1),
        stage(subject.one(), token=1, code=_OLD),
        send("Commit", token=2),
        stage(subject.one()),
        half,
        dropped(token=3),
        stage(subject.one()),
        send("Silence", ramp=0),
        dropped(token=5),
        stage(subject.one()),
        send("Disarm", ramp=0),
        subject.settle,
        subject.arm,
        dropped(token=6),
    ]


@driving("protocol.md#start-of-a-set")
def committed_together(subject: Subject) -> RequestRows:
    """Commit of a set with all layers and channels: all start at the same sample.

    Apply a whole set between two samples, not layer by layer across several.
    """
    tones = [subject.tone(each, 1 / len(subject.layers)) for each in subject.channels]
    room = subject.can["set_words"] // (LAYER.words + COMMAND.words * len(tones))
    layers = [layer(each, *tones, ramp=subject.ramp) for each in subject.layers[:room]]
    return [[stage(*layers), send("Commit", token=1)]]


@driving("protocol.md#start-of-a-set")
async def starts_at_its_moment(subject: Subject) -> None:
    """Commit with a moment up to 0.5 s ahead: starts there; otherwise immediately.

    Compare the high word of the clock modulo 65536, and start with the first sample at or behind
    the moment.
    """
    soon = min(0.1 * subject.slowness, 0.4)
    beyond = 1.01 * MAX_AHEAD + 2 * min(subject.exchange_time, 1.0)
    for duration in (soon, 0.99 * MAX_AHEAD, beyond, -0.1, 0.0):
        await subject.in_time(partial(_starts, subject, duration))
    over_the_end = -subject.shown.clock.present - round(0.05 / HIGH_TIME)
    await subject.in_time(partial(_starts, subject, soon, shift=over_the_end % HIGH_WORDS))


async def _starts(subject: Subject, duration: float, *, shift: int = 0) -> None:
    """Commit a set for a moment a time [s] ahead, which repeats do not move."""
    await subject.arm(shift=shift)
    is_ahead, is_long = 0 < duration <= MAX_AHEAD, duration > _STAGING_LONG
    await subject.request("Ping", rate=_FASTEST if is_long else 0)
    one, can = subject.one(ramp=_RISE), subject.can
    await subject.run([stage(one)])
    at, began = await subject.commit_in(duration), threads.now()
    await subject.request("Ping", rate=_SLOWEST if is_long else 0)
    await subject.run([play_now(one, token=1), send("Commit", token=1)])
    await subject.pause(max(duration * is_ahead - _AROUND - threads.now() + began, 0.0))
    while threads.now() < began + duration * is_ahead + _AROUND:
        shown = await subject.status()
        if is_ahead and can["clock_error"] != CLOCK_UNKNOWN:
            since = ahead(shown["clock"], at * HIGH_STEPS)
            ramp, error = min(_RISE, can["ramp_max"]) / 1000, can["clock_error"]
            slack = QUANTITIES["clock_error"].from_wire(error) + CLOCK_DRIFT * abs(since)
            rise = VoiceTransition(0.0, ramp, 0j, complex(one.commands[0].level / FULL), ramp)
            low, high = (
                abs(rise.at(each)) for each in (since - _NEAR - slack, since + _SAMPLE + slack)
            )
            rough = _ROUGH + can["level_step"] / FULL
            expect_within(
                shown["levels"][0] / FULL,
                low - rough,
                high + rough,
                f"level {1e3 * since:.2f} ms after the moment, by the amplifier's clock",
            )
        await asyncio.sleep(_NEAR)
    subject.dating.expect_steady()
    await subject.run([subject.follow])


@driving("protocol.md#start-of-a-set")
def what_waits_for_its_moment(subject: Subject) -> RequestRows:
    """Set waiting for its moment: a newer set starts it, every silencing request drops it.

    Before a newer Commit or `now` that you accept, start the set that waits. Drop it in Silence,
    Stop, Disarm, faults and an Arm with a new session.
    """
    half = layer(1, subject.beside(1, 0.5))
    left = min(0.1 * subject.slowness, 0.4)
    waiting = stage(subject.one(level=0.25))
    arm = send("Arm", watchdog=subject.can["watchdog_max"])
    first, *_ = subject.parts(half, token=2, now=0, count=3)
    refused = play_now(layer(0, after=True), token=3, code="BAD_VALUE")
    ends: list[RequestRows] = [
        *([send(name, ramp=0)] for name in ("Silence", "Stop")),
        [send("Disarm", ramp=0), subject.settle, subject.arm],
        [arm],
        *([play_now(one)] for one in (half, subject.one(level=0.5))),
        # It starts before the next set for its own layer.
        [stage(subject.one(level=0.5)), send("Commit", token=2)],
        [send("Set", **first)],
        [stage(half), partial(subject.commit_in, left / 2)],
        [stage(half), send("Commit", token=3, code=_OLD), refused],
    ]
    past = partial(subject.past_moment, _BEHIND)
    trips: RequestRows = [
        send("Arm", watchdog=subject.shortest_watchdog),
        subject.starve,
        subject.settle,
    ]
    later = [waiting, partial(subject.commit_in, min(3 * left, 0.45)), *trips, past]
    # No status is read as it starts; its end counts from there.
    timed = subject.one(ramp=subject.ramp, valid_for=subject.lasting(100))
    unseen = stage(timed), partial(subject.commit_in, left)
    lefts = [left if len(each) > 1 else 0.6 * left for each in ends]
    courses = [
        [waiting, partial(subject.commit_in, each), *rows, past]
        for rows, each in zip(ends, lefts, strict=True)
    ]
    return [*courses, later, [*unseen, 1.25 * left]]
