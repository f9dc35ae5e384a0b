"""Checks of transitions: raised cosines, envelopes, endings, kept phases, voices, interference."""

import asyncio
import math
from dataclasses import replace

from drivers.conformance.check import driving
from drivers.conformance.expected import flag
from drivers.conformance.findings import Late, Optional, expect
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject
from drivers.protocol.sets import Command
from drivers.protocol.table import SHORTENED_FADE

_PLACE = "protocol.md#what-a-channel-plays"
_SLOW = 400  # steps of frequency: 20 Hz, whose phase is known from times
_MAX_VOICES = 24  # that are tried
_PAUSE = 0.004  # s; between the sets of voices


@driving(_PLACE)
async def ramps(subject: Subject) -> None:
    """It rises and falls along the ramp of a layer, a raised cosine, on every channel."""
    tones = [subject.tone(channel) for channel in subject.channels]
    for ramp in {subject.ramp, 20, subject.can["ramp_max"]}:
        await subject.course(layer(0, *tones, ramp=ramp))
        await subject.course(layer(0, *tones), layer(0, ramp=ramp))


@driving(_PLACE)
async def cross_fades(subject: Subject) -> None:
    """It cross-fades tones, each along its own raised cosine, continued where it is interrupted."""
    ramp, part = subject.ramp, 0.4 * subject.ramp / 1000
    half, other = subject.tone(0, 0.5), subject.tone(0, 0.5, frequency=subject.other)
    loud = layer(0, subject.tone())
    for steps in (
        (layer(0, half), layer(0, subject.tone(frequency=subject.other), ramp=ramp)),
        (layer(0, half), layer(0, subject.tone(0, 0.5, 180.0), ramp=ramp)),
        (subject.one(ramp=ramp), part, layer(0, other, ramp=ramp)),
        (
            loud,
            layer(0, other, ramp=ramp),
            part,
            layer(0, ramp=min(3 * ramp, subject.can["ramp_max"])),
        ),
    ):
        await subject.course(*steps)


@driving("protocol.md#sets")
async def kept_phase(subject: Subject) -> None:
    """It leads a tone whose phase is kept from its present amplitude to the new one."""
    other = subject.other
    for fraction, phase, frequency in ((0.5, 0, 0), (1, 180, 0), (1, 90, 0), (1, 180, other)):
        tone = subject.tone(0, fraction, phase, keep=True, frequency=frequency)
        await subject.course(subject.one(), layer(0, tone, ramp=subject.ramp))


def _require_knots(subject: Subject) -> None:
    if not subject.can["knots"]:
        raise Optional("it has no knots")


@driving(_PLACE)
async def onsets(subject: Subject) -> None:
    """It leads an onset along straight lines in the complex plane, from 0 or what it keeps."""
    _require_knots(subject)
    for fractions in ([1, 0.25, 0.75], [0.5, -0.5, -0.5j], []):
        await subject.course(
            subject.one(subject.tone(0, 0.5, onset=subject.envelope(0.05, *fractions)))
        )
    shape = subject.envelope(0.05, 0.25, -0.5)
    kept = subject.one(subject.tone(0, 0.5, onset=shape, keep=True))
    await subject.course(subject.one(), kept)
    await subject.course(subject.one(ramp=subject.ramp), 0.4 * subject.ramp / 1000, kept)


@driving(_PLACE)
async def endings(subject: Subject) -> None:
    """It leads a tone to silence by its ending: without a command, at level 0, at its end."""
    _require_knots(subject)
    last, ramp = len(subject.channels) - 1, subject.ramp
    tone = subject.tone(last, ending=subject.envelope(0.05, 0.25, 0.75j))
    first, quiet = layer(0, tone), subject.tone(last, 0.0)
    other = subject.tone(0, 0.0) if last else quiet
    replaced = replace(quiet, onset=subject.envelope(0.1))
    for steps in (
        (first, layer(0)),
        (first, layer(0, quiet)),
        (first, layer(0, other)),
        (layer(0, tone, valid_for=100),),
        (first, layer(0, replace(quiet, skip_ending=True), ramp=ramp)),
        (first, layer(0, replaced, ramp=ramp)),
        (first, layer(0, subject.tone(last, keep=True), ramp=ramp), layer(0, ramp=ramp)),
    ):
        await subject.course(*steps)


@driving(_PLACE)
async def endings_amid(subject: Subject) -> None:
    """It begins an ending at the present amplitude, plays it once, and lets nothing prolong it."""
    _require_knots(subject)
    onset, ending = subject.envelope(0.1, 1), subject.envelope(0.05, 0.25)
    half, part = onset.step / 20_000, ending.step / 20_000
    towards_0 = subject.tone(0, 0.0, onset=onset)  # a voice counts until its onset has ended
    long = min(500, subject.can["ramp_max"])
    for steps in (
        (layer(0, replace(towards_0, ending=ending)), half, layer(0)),
        (layer(0, towards_0), half, subject.one(subject.tone(keep=True), ramp=subject.ramp)),
        (subject.one(subject.tone(ending=ending)), layer(0), part, layer(0, ramp=long)),
    ):
        await subject.course(*steps)


@driving(_PLACE)
async def extreme_envelopes(subject: Subject) -> None:
    """It plays as many knots as it states, along its shortest and longest step."""
    _require_knots(subject)
    low, high = subject.can["envelope_step_min"], subject.can["envelope_step_max"]
    count = range(subject.can["knots"])
    levels = [(0.2 + 0.8 * (at % 5) / 4) * (1 if at % 3 else -1) for at in count]
    for step, knots in ((low, levels), (100, levels), (high, [1.0])):
        shape = subject.envelope(step / 10_000, *knots)
        await subject.course(layer(0, subject.tone(0, 0.5, onset=shape)))


@driving(_PLACE)
async def phases(subject: Subject) -> None:
    """It plays phases and frequencies: tones of one frequency interfere, also if begun apart."""
    await subject.arm()
    await subject.require_interference()
    first = subject.tone(0, 0.5, 30.0)
    for channel in subject.channels:
        for number in subject.layers[1:]:
            other = subject.tone(channel, 0.5, 30.0 + 40.0 * number)
            await subject.play(layer(0, replace(first, channel=channel)), layer(number, other))
            await subject.status()
            await subject.play(layer(0), layer(number))
        for phase in (90.0, -90.0):
            await _expect_turned(subject, channel, phase, 0.25)
    slow = max(subject.lowest, _SLOW) / 20
    for periods in (0.25, 0.5):
        await _expect_turned(subject, 0, 0.0, round(0.9 * slow) + periods)
    for keep in (True, False):
        await _expect_turned(subject, 0, 0.0, 0.5, keep=keep)


async def _expect_turned(
    subject: Subject, channel: int, phase: float, periods: float, *, keep: bool | None = None
) -> None:
    """Play two tones some periods apart; keep: both at once, one of them again with that flag."""
    frequency = max(subject.lowest, _SLOW)
    tone = subject.tone(channel, 0.5, frequency=frequency)
    again = subject.tone(channel, 0.5, phase, frequency=frequency, keep=bool(keep))
    first = await subject.play(layer(0, tone), *([] if keep is None else [layer(1, tone)]))
    await subject.pause(periods * 20 / frequency)
    second = await subject.play(layer(1, again))
    if (
        second.when.latest - first.when.earliest - periods * 20 / frequency
    ) * frequency > 0.25 * 20:
        raise Late("two sets were too far apart in time")
    await subject.status()
    await subject.play(layer(0), layer(1))


@driving(_PLACE)
async def voices(subject: Subject) -> None:
    """It refuses no set for its fades: the oldest fade ends within 2 ms, and what lasts stays."""
    count, ramp = subject.can["voices"], subject.can["ramp_max"]
    sets = min(count, _MAX_VOICES) + 4
    room = max(subject.highest - subject.frequency, 0)
    # Each tone is at its level at once, and falls along the ramp of the next set.
    onset = subject.envelope(0.0001)
    tones = [
        subject.tone(0, 1 / sets, frequency=subject.frequency + min(10 * at, room), onset=onset)
        for at in range(sets)
    ]
    await subject.arm()
    began = (await subject.play(layer(0, tones[0], ramp=ramp))).when.earliest
    for tone in tones[1:]:
        await asyncio.sleep(_PAUSE + onset.step / 10_000)
        last = await subject.play(layer(0, tone, ramp=ramp))
    if last.when.latest - began > 0.8 * ramp / 1000:
        raise Late("sets were too far apart for so many voices")
    cut = 2 * SHORTENED_FADE + 16 * subject.level / sets / (subject.can["slew"] or math.inf)
    await asyncio.sleep(cut)  # in which the oldest fade may end as it likes
    await subject.follow(0.05)
    # A full pool refuses neither another layer nor a layer's silence, nor a fade of all.
    for number in subject.layers[1:3]:
        await subject.play(layer(number, tones[number], ramp=ramp))
    await subject.play(*(layer(number, ramp=ramp) for number in subject.layers[:3]))
    await subject.play(subject.one())
    await asyncio.sleep(cut)
    await subject.follow()


@driving(_PLACE)
async def voices_of_layers(subject: Subject) -> None:
    """It cuts fades only: what lasts on all layers plays on while others fade."""
    ramp, share = subject.can["ramp_max"], 1 / (2 * len(subject.layers))
    room, others = max(subject.highest - subject.frequency, 0), subject.layers[1:]

    def tone(number: int, fraction: float) -> Command:
        higher = subject.frequency + min(10 * number, room)
        return subject.tone(0, fraction, frequency=higher)

    await subject.arm()
    await subject.play(*(layer(number, tone(number, share)) for number in others))
    for number in range(min(subject.can["voices"], _MAX_VOICES) + 2):
        await subject.play(layer(0, tone(number + len(others) + 1, share / 4), ramp=ramp))
    await subject.play(layer(0))
    await subject.follow()


@driving(_PLACE)
async def limited(subject: Subject) -> None:
    """It limits the sum of its layers to full level, and says once that it was limited."""
    if subject.level * 2 <= 1.0:
        raise Optional("tried above half of full level only; see --level")
    await subject.arm()
    over = layer(1, subject.tone(frequency=subject.other))
    for sets, is_limited in (
        ([subject.one()], False),
        ([over, layer(1)], True),
        ([over], True),
        ([layer(1)], None),
        ([], False),
    ):
        for one in sets:
            await subject.play(one)
        status = await subject.request("GetStatus")
        shown = flag(status.values, "limited")
        expect(is_limited in (shown, None), "limited", expected=is_limited, seen=shown)
