"""Checks of layers: each plays on until it is named, ends by itself, is renewed, or follows."""

import asyncio
from collections.abc import Mapping, Sequence

from drivers.conformance.check import driving
from drivers.conformance.client import When
from drivers.conformance.expected import Bounds, alone, cosine, later, lines, steady, together
from drivers.conformance.findings import Optional, expect, expect_equal
from drivers.conformance.subject import DRIFT, SLACK, Subject, flag, is_silent, layer
from drivers.protocol.sets import LayerSet

_PLACE = "protocol.md#sets"
_EARLY = 0.002  # s; by which an end may come later than its time


@driving(_PLACE)
async def layers_add(subject: Subject) -> None:
    """It plays the sum of its layers, each with its own token, and those not named play on."""
    await subject.arm()
    frequencies = [subject.apart(each) for each in subject.layers]
    share, sums, tokens = 1 / len(subject.layers), 0.0, [0] * len(subject.layers)
    for number in reversed(subject.layers):
        tone = subject.tone(0, share, frequency=frequencies[number])
        await subject.play(layer(number, tone))
        sums, tokens[number] = sums + share, subject.token
        status = await subject.expect_levels(sums, why=f"layers from {number} on")
        expect_equal(status["tokens"], tokens, "tokens of layers")
    for number in subject.layers[:-1]:
        await subject.play(layer(number))
        sums, tokens[number] = sums - share, 0
        status = await subject.expect_levels(sums, why=f"layer {number} silenced")
        expect_equal(status["tokens"], tokens, "tokens of layers")
    first = subject.tone(0, share, frequency=subject.apart(0))
    await subject.play(layer(0, first), layer(len(subject.layers) - 1))
    status = await subject.expect_levels(share, why="one layer begun, one silenced by one set")
    tokens = [subject.token] + [0] * (len(subject.layers) - 1)
    expect_equal(status["tokens"], tokens, "tokens of layers")


@driving(_PLACE)
async def layers_play_on(subject: Subject) -> None:
    """It lets ramps, onsets and ends of layers that a set does not name go on as they were."""
    await subject.arm()
    ramp, low = subject.ramp, 0.25
    slow = layer(0, subject.tone(0, 0.75), ramp=ramp, valid_for=ramp + 100)
    started = await subject.play(slow)
    await asyncio.sleep(0.02)
    for fraction in (low, low / 2, low):
        other = subject.tone(0, fraction, frequency=subject.other)
        await subject.play(layer(1, other))
    rise = cosine(ramp / 1000, 0, 0.75)
    bounds: Mapping[int, Bounds] = {0: together(rise, steady(low))}
    await subject.follow(
        bounds, started, ramp / 1000 + 0.05, "layer 0 beside sets of layer 1", since=0.04
    )
    await _expect_end(subject, [low], started, ramp / 1000 + 0.1, ramp / 1000, "layer 0")
    status = await subject.expect_levels(low, why="layer 1 after layer 0 has ended")
    expect_equal(status["tokens"][:2], [0, subject.token], "tokens of layers 0 and 1")


@driving("protocol.md#what-a-channel-plays")
async def limited(subject: Subject) -> None:
    """It limits the sum of its layers to full level, and says once that it was limited."""
    if subject.level * 2 <= 1.0:
        raise Optional("tried above half of full level only; see --level")
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    status = (await subject.request("GetStatus")).values
    expect_equal(flag(status, "limited"), False, "flag limited with one layer")
    for end in (True, False):
        await subject.play(layer(1, subject.tone(frequency=subject.other)))
        if end:
            await subject.play(layer(1))
        status = (await subject.request("GetStatus")).values
        expect_equal(
            flag(status, "limited"), True, "flag limited, first status after a sum above 1"
        )
    expect_equal(status["levels"][0], 10_000, "level of a sum above 1")
    await subject.play(layer(1))
    await subject.request("GetStatus")
    status = (await subject.request("GetStatus")).values
    expect_equal(flag(status, "limited"), False, "flag limited, read again")


async def _expect_end(
    subject: Subject, after: Sequence[float], started: When, time: float, ramp: float, why: str
) -> None:
    """Require that levels end a time [s] after a commit, then along a ramp [s]."""
    await subject.pause_until(started.earliest + time * (1 - DRIFT) - 0.02)
    required = [round(each * subject.level * 10_000) for each in after] + [0] * len(
        subject.channels
    )
    slack = subject.tolerance * 10_000

    def is_over(status: Mapping[str, Sequence[int]]) -> bool:
        return all(abs(a - b) <= slack for a, b in zip(status["levels"], required, strict=False))

    when, _ = await subject.until(is_over, f"end of {why}", timeout=ramp + 0.3)
    end = time + ramp
    earliest = started.earliest + (time + 0.8 * ramp) * (1 - DRIFT) - SLACK
    latest = started.latest + end * (1 + DRIFT) + _EARLY + SLACK
    seen = f"{1e3 * (when.latest - started.earliest):.1f} ms after its commit"
    is_met = earliest <= when.latest and when.earliest <= latest
    expect(is_met, f"end of {why}", expected=f"{1e3 * end:.0f} ms", seen=seen)


@driving(_PLACE)
async def valid_for(subject: Subject) -> None:
    """It ends a layer after its valid_for, along its ramp, and stays armed; 0 and 60 s last."""
    await subject.arm()
    for time, ramp in ((1, 0), (100, 0), (150, min(100, subject.can["ramp_max"]))):
        started = await subject.play(layer(0, subject.tone(), ramp=ramp, valid_for=time))
        if ramp:
            rise = cosine(ramp / 1000, 0, 1)
            fall = cosine(ramp / 1000, 1, 0)
            curve = {0: alone(later(time / 1000, rise, fall))}
            whole = (time + ramp) / 1000
            await subject.follow(curve, started, whole, f"valid_for {time} ms")
        await _expect_end(subject, [0], started, time / 1000, ramp / 1000, f"valid_for {time} ms")
        status = await subject.expect_levels(why="after valid_for")
        shown = status["tokens"][0], status["token"], is_silent(status)
        expect_equal(shown, (0, subject.token, True), "token of layer 0, token, silent")
    started = await subject.play(
        layer(0, subject.tone(0, 0.5), valid_for=100),
        layer(1, subject.tone(0, 0.25, frequency=subject.apart(1)), valid_for=60_000),
        layer(2, subject.tone(0, 0.25, frequency=subject.apart(2))),
    )
    await _expect_end(subject, [0.5], started, 0.1, 0.0, "layer 0 of three")
    await subject.pause_until(started.latest + 0.3)
    await subject.expect_levels(0.5, why="layers of valid_for 60 s and 0")
    await subject.play(layer(0, subject.tone(0, 0.5), valid_for=60))
    started = await subject.play(layer(0, subject.tone(0, 0.5)))
    await subject.pause_until(started.latest + 0.1)
    await subject.expect_levels(1.0, why="valid_for of the set before")


@driving("protocol.md#sets")
async def renew(subject: Subject) -> None:
    """It starts valid_for anew by a renewal, and changes nothing else."""
    await subject.arm()
    ramp = 40
    await subject.play(layer(0, subject.tone(0, 0.5), ramp=ramp, valid_for=200))
    token = subject.token
    await subject.play(layer(1, subject.tone(0, 0.25, frequency=subject.apart(1))))
    await asyncio.sleep(0.1)
    started = await subject.play(layer(0, renew=True, valid_for=250, ramp=0))
    status = await subject.expect_levels(0.75, why="after a renewal")
    shown = status["token"], status["tokens"][:2]
    expect_equal(shown, (subject.token, [token, token + 1]), "token, tokens after a renewal")
    await subject.pause_until(started.latest + 0.2)
    await subject.expect_levels(0.75, why="200 ms after a renewal of 250 ms")
    whole = f"layer that was renewed, along its ramp of {ramp} ms"
    await _expect_end(subject, [0.25], started, 0.25, ramp / 1000, whole)
    await subject.play(layer(2, renew=True, valid_for=100))
    await subject.expect_levels(0.25, why="renewal of a silent layer")
    third = subject.tone(0, 0.25, frequency=subject.apart(3))
    await subject.play(layer(3, third, valid_for=60))
    started = await subject.play(layer(3, renew=True))
    await subject.pause_until(started.latest + 0.12)
    await subject.expect_levels(0.5, why="renewal without an end")


@driving("protocol.md#sets")
async def after(subject: Subject) -> None:
    """It starts commands with *after* once the onsets of the layer have ended, at once without."""
    await subject.arm()
    onset = subject.envelope(0.05, 0.5, 1, 0.5)
    step, long = onset.step / 10_000, 4 * onset.step / 10_000
    started = await subject.play(layer(0, subject.tone(onset=onset)))
    token = subject.token
    waiting = layer(0, subject.tone(0, 0.25, frequency=subject.other), after=True)
    for one in (layer(0, subject.tone(0, 0.75), after=True), waiting):  # the newer replaces
        await subject.play(one)
    status = (await subject.request("GetStatus")).values
    shown = status["token"], status["tokens"][0]
    expect_equal(shown, (subject.token, token), "token, that of a layer whose next set waits")
    plays = (await subject.request("GetAchieved", layer=0)).values["commands"]
    expect_equal(plays[0]["frequency"], subject.frequency, "frequency that is achieved")
    bounds = {0: alone(later(long, lines(step, 0, 0.5, 1, 0.5, 1), steady(0.25)))}
    await subject.follow(bounds, started, long + 0.05, "an onset and the set that waits for it")
    status = await subject.expect_levels(0.25, why="set that has waited")
    expect_equal(status["tokens"][0], subject.token, "token of a set that has waited")
    started = await subject.play(
        layer(0, subject.tone(0, 0.5, frequency=subject.other), after=True)
    )
    await subject.expect_levels(0.5, why="set with *after* where no onset lasts")
    await _dropped(subject, layer(0, subject.tone(onset=onset)), waiting)


async def _dropped(subject: Subject, first: LayerSet, waiting: LayerSet) -> None:
    """Require that what silences the layer drops the set that waits."""
    for name in ("layer", "Silence", "set"):
        started = await subject.play(first)
        await subject.play(waiting)
        level = 0.0
        if name == "Silence":
            await subject.request(name, session=subject.session, ramp=0)
        elif name == "layer":
            await subject.play(layer(0))
        else:
            await subject.play(layer(0, subject.tone(0, 0.75)))
            level = 0.75
        await subject.pause_until(started.latest + 0.25)
        await subject.expect_levels(level, why=f"waiting set after a {name} that ends its layer")
