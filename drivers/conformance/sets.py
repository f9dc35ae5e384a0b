"""Checks of what a set may hold, and that it is taken whole or not at all."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from drivers.conformance.check import driving
from drivers.conformance.findings import Optional, expect, expect_equal
from drivers.conformance.subject import FULL, Subject, layer
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers

_PLACE = "protocol.md#sets"
_SCANNED = 8


@driving(_PLACE)
async def every_channel(subject: Subject) -> None:
    """It plays every channel at its own level, and silences those that a set does not name."""
    await subject.arm()
    count = len(subject.channels)
    for channel in subject.channels:
        await subject.play(layer(0, subject.tone(channel)))
        await subject.expect_levels(*(0.0,) * channel, 1.0, why=f"channel {channel} alone")
    fractions = [1.0 - 0.05 * channel for channel in subject.channels]
    for levels in (fractions, fractions[::-1]):
        await subject.play(layer(0, *(subject.tone(*each) for each in enumerate(levels))))
        await subject.expect_levels(*levels, why="all channels")
    tones = [subject.tone(channel, levels[channel]) for channel in reversed(subject.channels)]
    await subject.play(layer(0, *tones[: max(count - 1, 1)]))
    kept = [0.0, *levels[1:]] if count > 1 else levels
    await subject.expect_levels(*kept, why="set without channel 0, the others in reverse order")
    await subject.play(layer(0))
    await subject.expect_levels(why="layer without commands")


@driving(_PLACE)
async def levels_of_every_frequency(subject: Subject) -> None:
    """It plays the level that was asked for at its lowest and its highest frequency."""
    await subject.arm()
    for number, limits in enumerate(subject.can["limits"]):
        for frequency in (limits["frequency_min"], limits["frequency_max"]):
            await subject.play(layer(0, subject.tone(number, frequency=frequency)))
            why = f"channel {number} at {frequency / 20:g} Hz"
            await subject.expect_levels(*(0.0,) * number, 1.0, why=why)


@driving("protocol.md#messages")
async def achieved(subject: Subject) -> None:
    """It says what each layer plays within half a step, and *exact* where that was asked."""
    await subject.arm()
    can, made = subject.can, {}
    for number in subject.layers:
        made[number] = layer(
            number,
            *(
                subject.tone(
                    channel,
                    (0.98765 - 0.05 * channel) / len(subject.layers),
                    20.0 * channel - 160.12,
                    frequency=min(subject.frequency + 7 * channel + 40 * number, subject.highest),
                )
                for channel in subject.channels
            ),
            ramp=number + 1,
            valid_for=50_000 + number,
        )
        (part, *_) = subject.parts(made[number])
        is_exact = bool((await subject.request("Set", **part))["exact"])
        shown = (await subject.request("GetAchieved", layer=number)).values
        required = subject.token, number, number + 1, 50_000 + number
        seen = tuple(shown[name] for name in ("token", "layer", "ramp", "valid_for"))
        expect_equal(seen, required, f"token, layer, ramp, valid_for of achieved layer {number}")
        _expect_achieved(can, made[number].commands, shown, number, is_exact=is_exact)
    for number in subject.layers:
        shown = (await subject.request("GetAchieved", layer=number)).values
        _expect_achieved(can, made[number].commands, shown, number, is_exact=False)
    for number in range(len(subject.layers), 16):
        await subject.refused("BAD_VALUE", "GetAchieved", layer=number)


def _expect_achieved(
    can: Values, requested: tuple[Command, ...], shown: Values, number: int, *, is_exact: bool
) -> None:
    found = {each["channel"]: each for each in shown["commands"]}
    expect_equal(
        sorted(found), sorted(one.channel for one in requested), f"channels of layer {number}"
    )
    for one in requested:
        for name in ("frequency", "level", "phase"):
            required, seen = getattr(one, name), found[one.channel][name]
            half = 0 if is_exact else can[f"{name}_step"] / 2
            error = abs(
                (seen - required + 18000) % 36000 - 18000 if name == "phase" else seen - required
            )
            what = f"achieved {name} of channel {one.channel} in layer {number}"
            expect(error <= max(half, 0), what, expected=f"{required} within {half:g}", seen=seen)


@driving("protocol.md#messages")
async def steps_as_stated(subject: Subject) -> None:
    """It rounds to the steps that it states."""
    base = subject.tone(0, 0.5)
    coarse = [name for name in ("frequency", "level", "phase") if subject.can[f"{name}_step"] > 3]
    if not coarse:
        raise Optional("its steps are about those of the wire")
    await subject.arm()
    for name in coarse:
        step, start = subject.can[f"{name}_step"], getattr(base, name)
        found = set()
        for number in range(_SCANNED):
            command = replace(base, **{name: start + number * step // _SCANNED})
            await subject.play(layer(0, command))
            shown = (await subject.request("GetAchieved", layer=0)).values
            found.add(shown["commands"][0][name])
        what = f"values achieved of {_SCANNED} within a step of {name}"
        expect(len(found) <= 2, what, expected="at most two", seen=found)


class _Bad(NamedTuple):
    what: str
    words: list[int]
    code: str
    channel: int | None


def _bad_sets(subject: Subject) -> Iterator[_Bad]:
    """Yield sets that must be refused, with the code and the channel."""
    can, tone = subject.can, subject.tone()

    def flawed(
        what: str, one: LayerSet, code: str = "BAD_VALUE", channel: int | None = None
    ) -> _Bad:
        return _Bad(what, pack_layers([layer(1, subject.tone(0, 0.5)), one]), code, channel)

    for number, limits in enumerate(can["limits"]):
        own = subject.tone(number)
        low, high, loud = (limits[name] for name in ("frequency_min", "frequency_max", "level_max"))
        tones = []
        if low > 0:
            tones.append((f"{low - 1} steps of frequency", replace(own, frequency=low - 1)))
        if high < 0xFFFF:
            tones.append((f"{high + 1} steps of frequency", replace(own, frequency=high + 1)))
        if loud < FULL:
            above = Envelope(can["envelope_step_min"], ((loud + 1, 0),))
            tones += [
                (f"level {loud + 1}", replace(own, level=loud + 1)),
                (f"a knot of level {loud + 1}", replace(own, onset=above)),
                (f"an ending with a knot of level {loud + 1}", replace(own, ending=above)),
            ]
        for what, one in tones:
            yield flawed(f"{what} on channel {number}", layer(0, one), channel=number)
    if len(subject.channels) < 16:
        beyond = replace(tone, channel=len(subject.channels))
        yield flawed("a channel too many", layer(0, beyond), "BAD_CHANNEL", beyond.channel)
    yield flawed("a channel twice", layer(0, tone, tone), "BAD_CHANNEL", 0)
    if len(subject.layers) < 16:
        yield flawed("a layer too many", layer(len(subject.layers), tone))
    yield flawed("a layer twice", layer(1, tone))
    yield flawed("renew with commands", layer(0, tone, renew=True))
    yield flawed("after without commands", layer(0, after=True))
    if can["ramp_max"] < 1000:
        yield flawed("a ramp above the longest", layer(0, tone, ramp=can["ramp_max"] + 1))
    knots = ((100, 0),)
    for step in {can["envelope_step_min"] - 1, can["envelope_step_max"] + 1} - {0, 1001}:
        one = replace(tone, onset=Envelope(step, knots))
        yield flawed(f"a step of {step}", layer(0, one), channel=0)
    if can["knots"] < 32:
        many = Envelope(can["envelope_step_min"], knots * (can["knots"] + 1))
        yield flawed("a knot too many", layer(0, replace(tone, onset=many)), channel=0)
    yield from _bad_words(subject)


def _bad_words(subject: Subject) -> Iterator[_Bad]:
    """Yield streams that no set can have: numbers beyond the table, too few words, bits unused."""
    good = pack_layers([layer(0, subject.tone())])

    def flawed(what: str, at: int, word: int, code: str = "BAD_VALUE") -> _Bad:
        return _Bad(what, [*good[:at], word, *good[at + 1 :]], code, None)

    yield flawed("unused bits beside a layer", 0, good[0] | 1 << 15)
    yield flawed("a ramp of 1001 ms", 1, 1001)
    yield flawed("a valid_for of 60001 ms", 2, 60_001)
    yield flawed(_BITS, 3, good[3] | 1 << 12)
    yield flawed("a level of 10001", 5, FULL + 1)
    yield flawed("a phase of 180 degrees", 6, 18_000)
    yield flawed("a phase of -180.01 degrees", 6, 0x10000 - 18_001)
    yield _Bad("its last word missing", good[:-1], "BAD_LENGTH", None)
    yield _Bad("a word too many", [*good, 0], "BAD_LENGTH", None)
    yield _Bad("a command missing", [good[0] + 1, *good[1:]], "BAD_LENGTH", None)


@driving("protocol.md#sets")
async def all_or_nothing(subject: Subject) -> None:
    """It refuses a set as a whole, says why and names the channel; what plays and waits stays."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    for what, words, code, channel in _bad_sets(subject):
        token = subject.next_token()
        for now in (1, 0):
            request = [subject.session, token, 1 << 1 | now, *words]
            answer = await subject.answer_to("Set", request)
            expect_equal(answer.code or "carried out", code, f"refusal of a set with {what}")
            is_named = answer.channel == channel or what in _OF_A_COMMAND
            text = f"channel of the refusal of a set with {what}"
            expect(is_named, text, expected=channel, seen=answer.channel)
        status = await subject.expect_levels(1.0, why=f"after a set with {what}")
        expect_equal(status["token"], 1, f"token after a set with {what}")
        subject.token = token
        await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=token)
    await subject.play(layer(0, subject.tone(0, 0.5)))
    staged = await subject.stage(layer(0, subject.tone(0, 0.25)))
    for what, token, now in (("an older token", staged - 2, 1), ("token 0", 0, 0)):
        words = [subject.session, token, 1 << 1 | now, *pack_layers([layer(0)])]
        await subject.refused_words("BAD_TOKEN", "Set", words, what=f"a set with {what}")
    await subject.commit(staged)
    await subject.expect_levels(0.25, why="set that was staged before refused ones")


_BITS = "unused bits beside a channel"
_OF_A_COMMAND = (
    *("a level of 10001", "a phase of 180 degrees", "a phase of -180.01 degrees", _BITS),
)
"""What an amplifier may blame on the channel of its command."""


@driving("protocol.md#messages")
async def accepts_its_ranges(subject: Subject) -> None:
    """It takes what is just within its ranges, and any frequency of a silent channel."""
    await subject.arm()
    can, quiet = subject.can, subject.level * FULL
    for number, limits in enumerate(can["limits"]):
        for frequency in (limits["frequency_min"], limits["frequency_max"]):
            loud = Command(number, frequency, limits["level_max"], -18_000)
            await subject.stage(layer(0, loud, ramp=can["ramp_max"], valid_for=60_000))
    for step in (can["envelope_step_min"], can["envelope_step_max"]):
        for count in {0, 1, can["knots"]}:
            shape = Envelope(step, ((round(quiet), 17_999),) * count)
            await subject.stage(layer(0, subject.tone(onset=shape, ending=shape)))
    await subject.stage(layer(len(subject.layers) - 1, subject.tone(), ramp=can["ramp_max"]))
    for frequency in (0, 0xFFFF):
        await subject.play(layer(0, Command(0, frequency, 0, 0)))
    await subject.expect_levels(why="sets of level 0")
