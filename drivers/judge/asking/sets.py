"""Checks of what a set may hold, and that it is taken whole or not at all."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product

from drivers.protocol.definition import COMMAND, ENVELOPE, LAYER, QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, pack_layers
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import (
    FULL,
    Rows,
    Send,
    expect_within,
    in_batches,
    layer,
    play,
    require,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_PLACE = "protocol.md#sets"
_SCANNED = 8
_AT_ONCE = 6  # sets that are refused, before a look at the status
_LEVEL, _PHASE = QUANTITIES["level"].maximum, QUANTITIES["phase"]
_TONE = "frequency", "level", "phase"


@driving(_PLACE)
def every_channel(subject: Subject) -> Rows:
    """It plays every channel at its own level, and silences those that a set does not name."""
    tones = [subject.tone(channel, 1 - 0.05 * channel) for channel in subject.channels]
    reverse = [replace(tones[-1 - at], channel=at) for at in reversed(subject.channels)]
    but_one = reverse[: max(len(tones) - 1, 1)]
    alone = [layer(0, tone) for tone in tones]
    return [subject.arm, *alone, *(layer(0, *each) for each in (tones, reverse, but_one, []))]


@driving(_PLACE)
def levels_of_every_frequency(subject: Subject) -> Rows:
    """It plays the level that was asked for at its lowest and its highest frequency."""
    ends = [
        (number, limits[end])
        for number, limits in enumerate(subject.can["limits"])
        for end in ("frequency_min", "frequency_max")
    ]
    return [subject.arm, *(layer(0, subject.tone(at, frequency=each)) for at, each in ends)]


@driving("protocol.md#messages")
async def achieved(subject: Subject) -> None:
    """It says what each layer plays within half a step, and *exact* where that was asked."""
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


@driving("protocol.md#messages")
async def steps_as_stated(subject: Subject) -> None:
    """It rounds to the steps that it states."""
    base = subject.tone(0)
    coarse = [name for name in _TONE if subject.can[f"{name}_step"] > 3]
    require(bool(coarse), "its steps are about those of the wire")
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
        what = f"number of values achieved of {_SCANNED} within a step of {name}"
        expect_within(len(found), 0, 2, what)


def _part(words: list[int], code: str = "BAD_VALUE", *channels: int | None, **values: int) -> Send:
    """Send words as a set of one part, which must be refused; channels: one of which is named."""
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
        *(layer(1, tone), layer(0, tone, renew=True), layer(0, after=True)),
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


@driving(_PLACE)
def all_or_nothing(subject: Subject) -> Rows:
    """It refuses a set as a whole, says why and names the channel; what plays and waits stays."""
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
        play(subject.one(level=0.5), token=last),
        stage(subject.one(level=0.25)),
        _part(silent, "BAD_TOKEN", token=last - 1, now=1),
        send("Set", raw=[subject.next_session, 0, 1 << 1, *silent], code="BAD_TOKEN"),
        send("Commit", token=last + 1),
    ]


@driving("protocol.md#messages")
def accepts_its_ranges(subject: Subject) -> Rows:
    """It takes what is just within its ranges, and any frequency of a silent channel."""
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
