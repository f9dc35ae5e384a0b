"""Checks of what a set may hold, and that it is taken whole or not at all."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from drivers.conformance.check import driving
from drivers.conformance.findings import Optional, expect, expect_equal
from drivers.conformance.material import FULL, layer
from drivers.conformance.subject import Reply, Subject
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers
from drivers.protocol.table import QUANTITIES

_PLACE = "protocol.md#sets"
_SCANNED = 8
_LEVEL, _PHASE = QUANTITIES["level"].maximum, QUANTITIES["phase"]
_TONE = "frequency", "level", "phase"


@driving(_PLACE)
async def every_channel(subject: Subject) -> None:
    """It plays every channel at its own level, and silences those that a set does not name."""
    await subject.arm()
    tones = [subject.tone(channel, 1 - 0.05 * channel) for channel in subject.channels]
    reverse = [replace(tones[-1 - at], channel=at) for at in reversed(subject.channels)]
    but_one = max(len(tones) - 1, 1)
    for one in (*([each] for each in tones), tones, reverse, reverse[:but_one], []):
        await subject.play(layer(0, *one))
        await subject.status()


@driving(_PLACE)
async def levels_of_every_frequency(subject: Subject) -> None:
    """It plays the level that was asked for at its lowest and its highest frequency."""
    await subject.arm()
    for number, limits in enumerate(subject.can["limits"]):
        for end in ("frequency_min", "frequency_max"):
            await subject.play(layer(0, subject.tone(number, frequency=limits[end])))
            await subject.status()


@driving("protocol.md#messages")
async def achieved(subject: Subject) -> None:
    """It says what each layer plays within half a step, and *exact* where that was asked."""
    await subject.arm()
    for number in subject.layers:
        tones = [
            subject.tone(
                channel,
                (0.98765 - 0.05 * channel) / len(subject.layers),
                20.0 * channel - 160.12,
                frequency=min(subject.frequency + 7 * channel + 40 * number, subject.highest),
            )
            for channel in subject.channels
        ]
        taken = await subject.play(
            layer(number, *tones, ramp=number + 1, valid_for=50_000 + number)
        )
        await _expect_achieved(subject, number, is_exact=bool(taken["exact"]))
    for number in subject.layers:
        await _expect_achieved(subject, number, is_exact=False)


async def _expect_achieved(subject: Subject, number: int, *, is_exact: bool) -> Reply:
    """Require that a layer plays its set, of a token of its own number, within half a step."""
    shown = await subject.request("GetAchieved", layer=number)
    (one,) = subject.shown.sets[number + 1]
    seen = [shown[name] for name in ("token", "layer", "ramp", "valid_for")]
    required = [number + 1, one.layer, one.ramp, one.valid_for]
    expect_equal(seen, required, f"token, layer, ramp, valid_for of achieved layer {number}")
    commands = sorted(shown["commands"], key=lambda each: each["channel"])
    channels = [each["channel"] for each in commands]
    expect_equal(channels, [*subject.channels], f"channels of layer {number}")
    for tone, found in zip(one.commands, commands, strict=True):
        for name in _TONE:
            requested, seen = getattr(tone, name), found[name]
            half = 0 if is_exact else subject.can[f"{name}_step"] / 2
            error = abs(seen - requested)
            error = min(error, 36_000 - error) if name == "phase" else error
            what = f"achieved {name} of channel {tone.channel} in layer {number}"
            expect(error <= half, what, expected=f"{requested} within {half:g}", seen=seen)
    return shown


@driving("protocol.md#messages")
async def steps_as_stated(subject: Subject) -> None:
    """It rounds to the steps that it states."""
    base = subject.tone(0, 0.5)
    coarse = [name for name in _TONE if subject.can[f"{name}_step"] > 3]
    if not coarse:
        raise Optional("its steps are about those of the wire")
    await subject.arm()
    for name in coarse:
        step, start, found = subject.can[f"{name}_step"], getattr(base, name), set()
        for number in range(_SCANNED):
            await subject.play(layer(0, replace(base, **{name: start + number * step // _SCANNED})))
            shown = await subject.request("GetAchieved", layer=0)
            found.add(shown["commands"][0][name])
        what = f"values achieved of {_SCANNED} within a step of {name}"
        expect(len(found) <= 2, what, expected="at most two", seen=found)


class _Flawed(NamedTuple):
    """A set that must be refused; channel: that the refusal names, or one of these."""

    what: str
    words: list[int]
    code: str = "BAD_VALUE"
    channels: tuple[int | None, ...] = (None,)


def _bad_tones(subject: Subject) -> Iterator[tuple[str, Command]]:
    """Yield commands beyond the limits of their channel, or the envelopes that there can be."""
    low, high = subject.can["envelope_step_min"], subject.can["envelope_step_max"]
    for number, limits in enumerate(subject.can["limits"]):
        own, loud = subject.tone(number), limits["level_max"] + 1
        for end, beyond in (("frequency_min", -1), ("frequency_max", 1)):
            frequency = limits[end] + beyond
            if 0 <= frequency <= 0xFFFF:
                yield f"{frequency} steps of frequency", replace(own, frequency=frequency)
        if loud <= FULL:
            above = Envelope(low, ((loud, 0),))
            yield f"level {loud}", replace(own, level=loud)
            yield f"a knot of level {loud}", replace(own, onset=above)
            yield f"an ending with a knot of level {loud}", replace(own, ending=above)
    for step in {low - 1, high + 1} - {0, 1001}:
        shape = Envelope(step, ((100, 0),))
        yield f"a step of {step}", subject.tone(onset=shape)
    if (count := subject.can["knots"]) < 32:
        many = Envelope(low, ((100, 0),) * (count + 1))
        yield "a knot too many", subject.tone(onset=many)


def _bad_sets(subject: Subject) -> Iterator[_Flawed]:
    """Yield sets that must be refused: beside a good layer, and as words that no set can have."""
    tone, good = subject.tone(), layer(1, subject.tone(0, 0.5))
    channels, layers, ramp = len(subject.channels), len(subject.layers), subject.can["ramp_max"]
    for what, one in _bad_tones(subject):
        yield _Flawed(what, pack_layers([good, layer(0, one)]), channels=(one.channel,))
    twice = pack_layers([good, layer(0, tone, tone)])
    yield _Flawed("a channel twice", twice, "BAD_CHANNEL", (0,))
    if channels < 16:
        beyond = pack_layers([good, layer(0, replace(tone, channel=channels))])
        yield _Flawed("a channel too many", beyond, "BAD_CHANNEL", (channels,))
    flawed = [
        ("a layer twice", layer(1, tone)),
        ("renew with commands", layer(0, tone, renew=True)),
        ("after without commands", layer(0, after=True)),
        *([("a layer too many", layer(layers, tone))] if layers < 16 else []),
        *([("a longer ramp", layer(0, tone, ramp=ramp + 1))] if ramp < 1000 else []),
    ]
    for what, layer_set in flawed:
        yield _Flawed(what, pack_layers([good, layer_set]))
    words = pack_layers([layer(0, tone)])
    for at, word, names_channel in (
        (0, words[0] | 1 << 15, False),
        (1, QUANTITIES["ramp"].maximum + 1, False),
        (2, QUANTITIES["valid_for"].maximum + 1, False),
        (3, words[3] | 1 << 12, True),
        (5, _LEVEL + 1, True),
        (6, _PHASE.maximum + 1, True),
        (6, 0x10000 + _PHASE.minimum - 1, True),
    ):
        channels_named = (None, 0) if names_channel else (None,)
        beyond = [*words[:at], word, *words[at + 1 :]]
        yield _Flawed(f"{word:#x} as its word {at}", beyond, channels=channels_named)
    yield _Flawed("its last word missing", words[:-1], "BAD_LENGTH")
    yield _Flawed("a word too many", [*words, 0], "BAD_LENGTH")
    yield _Flawed("a command missing", [words[0] + 1, *words[1:]], "BAD_LENGTH")


@driving("protocol.md#sets")
async def all_or_nothing(subject: Subject) -> None:
    """It refuses a set as a whole, says why and names the channel; what plays and waits stays."""
    await subject.arm()
    await subject.play(subject.one())
    session = subject.session
    for token, flawed in enumerate(_bad_sets(subject), 2):
        for now in (1, 0):
            answer = await subject.answer("Set", session, token, 1 << 1 | now, *flawed.words)
            seen, what = answer.code or "carried out", f"refusal of a set with {flawed.what}"
            expect_equal(seen, flawed.code, what)
            is_named = answer.channel in flawed.channels
            what = f"channel of the {what}"
            expect(is_named, what, expected=flawed.channels, seen=answer.channel)
        await subject.status()
        await subject.refused("BAD_TOKEN", "Commit", session=session, token=token)
    subject.token = token
    await subject.play(layer(0, subject.tone(0, 0.5)))
    staged = await subject.stage(layer(0, subject.tone(0, 0.25)))
    for older in (staged - 2, 0):
        words = [session, older, 1 << 1, *pack_layers([layer(0)])]
        await subject.refused("BAD_TOKEN", "Set", *words, what=f"a set of token {older}")
    await subject.commit(staged)


@driving("protocol.md#messages")
async def accepts_its_ranges(subject: Subject) -> None:
    """It takes what is just within its ranges, and any frequency of a silent channel."""
    await subject.arm()
    can, quiet = subject.can, round(subject.level * FULL)
    sets: list[LayerSet] = [
        layer(
            0,
            Command(number, limits[end], limits["level_max"], _PHASE.minimum),
            ramp=can["ramp_max"],
            valid_for=QUANTITIES["valid_for"].maximum,
        )
        for number, limits in enumerate(can["limits"])
        for end in ("frequency_min", "frequency_max")
    ]
    for step in (can["envelope_step_min"], can["envelope_step_max"]):
        for count in {0, 1, can["knots"]}:
            shape = Envelope(step, ((quiet, _PHASE.maximum),) * count)
            sets.append(subject.one(subject.tone(onset=shape, ending=shape)))
    for one in (*sets, layer(len(subject.layers) - 1, subject.tone(), ramp=can["ramp_max"])):
        await subject.stage(one)
    for frequency in (0, 0xFFFF):
        await subject.play(layer(0, Command(0, frequency, 0, 0)))
    await subject.status()
