"""Checks of transitions: raised cosines, envelopes, endings, kept phases, interference."""

import math

from drivers import clock
from drivers.conformance.check import driving
from drivers.conformance.expected import (
    alike,
    alone,
    cosine,
    later,
    lines,
    polar,
    steady,
    together,
    unsure,
)
from drivers.conformance.findings import Late, Optional, expect, expect_equal
from drivers.conformance.subject import Subject, layer, passed

_PLACE = "protocol.md#what-a-channel-plays"
_RIGHT = math.pi / 2
_SLOW = 400  # steps of frequency: 20 Hz, whose phase is known from times


@driving(_PLACE)
async def ramps(subject: Subject) -> None:
    """It rises and falls along the ramp of a layer, a raised cosine, on every channel."""
    every = subject.channels
    tones = [subject.tone(channel) for channel in every]
    for ramp in {subject.ramp, 20, subject.can["ramp_max"]}:
        time = ramp / 1000
        rise = dict.fromkeys(every, alone(cosine(time, 0, 1)))
        up = layer(0, *tones, ramp=ramp)
        await subject.course(rise, time + 0.01, f"rise along {ramp} ms", up)
        fall = dict.fromkeys(every, alone(cosine(time, 1, 0)))
        down = layer(0, *tones), layer(0, ramp=ramp)
        await subject.course(fall, time + 0.01, f"fall along {ramp} ms", *down)


@driving(_PLACE)
async def cross_fades(subject: Subject) -> None:
    """It cross-fades tones that differ in frequency, each along its own raised cosine."""
    time = subject.ramp / 1000
    first = layer(0, subject.tone(0, 0.5))
    fall, rise = cosine(time, 0.5, 0), cosine(time, 0, 1)
    other = layer(0, subject.tone(0, 1.0, frequency=subject.other), ramp=subject.ramp)
    bounds = {0: together(fall, rise)}
    await subject.course(bounds, time + 0.01, "cross-fade of two frequencies", first, other)
    again = layer(0, subject.tone(0, 0.5, 180.0), ramp=subject.ramp)
    # What two tones of one frequency add up to depends on when each began.
    bounds = {0: lambda at: (0.0, alike(fall, cosine(time, 0, 0.5))(at)[1])}
    await subject.course(bounds, time + 0.01, "cross-fade of one frequency", first, again)


@driving(_PLACE)
async def interrupted_ramps(subject: Subject) -> None:
    """It continues an interrupted ramp from its present level, and prolongs no fade."""
    await subject.arm()
    ramp = subject.ramp
    time, part = ramp / 1000, 0.4
    other = subject.tone(0, 0.5, frequency=subject.other)
    first = await subject.play(layer(0, subject.tone(), ramp=ramp))
    await subject.pause_until(first.latest + part * time)
    started = await subject.play(layer(0, other, ramp=ramp))
    rise = cosine(time, 0, 1)
    bounds = unsure(
        lambda at: together(cosine(time, rise(at), 0), cosine(time, 0, 0.5)), passed(first, started)
    )
    await subject.follow({0: bounds}, started, time + 0.01, "rise that was interrupted")
    await subject.play(layer(0, subject.tone()))
    first = await subject.play(layer(0, other, ramp=ramp))  # the first tone fades until ramp
    await subject.pause_until(first.latest + part * time)
    later_ramp = min(3 * ramp, subject.can["ramp_max"])
    started = await subject.play(layer(0, ramp=later_ramp))
    rest, risen = cosine(time, 1, 0), cosine(time, 0, 0.5)
    bounds = unsure(
        lambda at: together(
            lambda moment: rest(moment + at), cosine(later_ramp / 1000, risen(at), 0)
        ),
        passed(first, started),
    )
    await subject.follow({0: bounds}, started, later_ramp / 1000, "fade that a longer one follows")


@driving("protocol.md#sets")
async def kept_phase(subject: Subject) -> None:
    """It leads a tone whose phase is kept from its present amplitude to the new one."""
    ramp, first = subject.ramp, layer(0, subject.tone())
    time = ramp / 1000
    for phase, fraction in ((0.0, 0.5), (180.0, 1.0), (90.0, 1.0)):
        curve = {0: alone(cosine(time, 1, polar(fraction, phase)))}
        kept = layer(0, subject.tone(0, fraction, phase, keep=True), ramp=ramp)
        why = f"kept phase, led to {phase:g} degrees"
        await subject.course(curve, time + 0.01, why, first, kept)
    # Where another frequency plays, keep phase begins a tone of its own.
    tone = subject.tone(0, 1.0, 180.0, keep=True, frequency=subject.other)
    bounds = {0: together(cosine(time, 1, 0), cosine(time, 0, 1))}
    why = "keep phase at another frequency"
    await subject.course(bounds, time + 0.01, why, first, layer(0, tone, ramp=ramp))


@driving(_PLACE)
async def onsets(subject: Subject) -> None:
    """It leads an onset along straight lines in the complex plane, from 0 or what it keeps."""
    _require_knots(subject)
    for fractions in ([1, 0.25, 0.75], [0.5, -0.5, -0.5j], []):
        shape = subject.envelope(0.05, *fractions)
        step = shape.step / 10_000
        # Without knots there is a step alone, along a raised cosine.
        curve = alone(lines(step, 0, *fractions, 0.5) if fractions else cosine(step, 0, 0.5))
        whole, why = step * (len(fractions) + 1), f"onset of {len(fractions)} knots"
        one = layer(0, subject.tone(0, 0.5, onset=shape))
        await subject.course({0: curve}, whole + 0.01, why, one)
    knots = (0.25, -0.5)
    shape = subject.envelope(0.05, *knots)
    kept = layer(0, subject.tone(0, 0.5, onset=shape, keep=True))
    curve = alone(lines(step, 1, *knots, 0.5))
    why = "onset with kept phase"
    await subject.course({0: curve}, 3 * step + 0.01, why, layer(0, subject.tone()), kept)
    await subject.rest()
    await subject.arm()
    ramp = subject.ramp
    first = await subject.play(layer(0, subject.tone(), ramp=ramp))
    await subject.pause_until(first.latest + 0.4 * ramp / 1000)
    started = await subject.play(layer(0, subject.tone(0, 0.5, onset=shape, keep=True)))
    rise = cosine(ramp / 1000, 0, 1)
    bounds = unsure(lambda at: alone(lines(step, rise(at), *knots, 0.5)), passed(first, started))
    await subject.follow({0: bounds}, started, 3 * step, "onset with kept phase amid a ramp")


@driving(_PLACE)
async def endings(subject: Subject) -> None:
    """It leads a tone to silence by its ending: without a command, at level 0, at its end."""
    _require_knots(subject)
    knots = (0.25, 0.75j)
    shape = subject.envelope(0.05, *knots)
    step, last = shape.step / 10_000, len(subject.channels) - 1
    fall = lines(step, 1, *knots, 0)
    tone = subject.tone(last, ending=shape)
    for why, one in (
        ("a layer without commands", layer(0)),
        ("a command of level 0", layer(0, subject.tone(last, 0.0))),
        ("a layer that does not name it", layer(0, *([subject.tone(0, 0.0)] if last else []))),
    ):
        whole = 3 * step + 0.02
        await subject.course({last: alone(fall)}, whole, f"ending by {why}", layer(0, tone), one)
    curve = {last: alone(later(0.1, steady(1), fall))}
    ended = layer(0, tone, valid_for=100)
    await subject.course(curve, 0.12 + 3 * step, "ending by valid_for", ended)
    ramp = subject.ramp
    gone = {last: alone(cosine(ramp / 1000, 1, 0))}
    silent = layer(0, ramp=ramp)
    for why, sets in (
        ("skip ending", [layer(0, subject.tone(last, 0.0, skip=True), ramp=ramp)]),
        (
            "another tone in place of an ending",
            [layer(0, subject.tone(last, 0.0, onset=subject.envelope(0.1)), ramp=ramp)],
        ),
        ("kept phase without the ending", [layer(0, subject.tone(last, keep=True)), silent]),
    ):
        await subject.course(gone, ramp / 1000 + 0.01, why, layer(0, tone), *sets)


@driving(_PLACE)
async def endings_amid(subject: Subject) -> None:
    """It begins an ending at the present amplitude, plays it once, and lets nothing prolong it."""
    _require_knots(subject)
    await subject.arm()
    onset, ending = subject.envelope(0.1, 1), subject.envelope(0.05, 0.25)
    half, step = onset.step / 20_000, ending.step / 10_000
    rise = lines(2 * half, 0, 1, 0)
    # Towards level 0: a voice counts until its onset has ended.
    first = await subject.play(layer(0, subject.tone(0, 0.0, onset=onset, ending=ending)))
    await subject.pause_until(first.latest + half)
    started = await subject.play(layer(0))
    bounds = unsure(lambda at: alone(lines(step, rise(at), 0.25, 0)), passed(first, started))
    await subject.follow({0: bounds}, started, 2 * step + 0.02, "ending amid an onset to level 0")
    first = await subject.play(layer(0, subject.tone(0, 0.0, onset=onset)))
    await subject.pause_until(first.latest + half)
    started = await subject.play(layer(0, subject.tone(0, 1.0, keep=True), ramp=subject.ramp))
    ramp = subject.ramp / 1000
    bounds = unsure(lambda at: alone(cosine(ramp, rise(at), 1)), passed(first, started))
    await subject.follow({0: bounds}, started, 0.1, "phase kept amid an onset to level 0")
    await subject.play(layer(0, subject.tone(ending=ending)))
    started = await subject.play(layer(0))
    await subject.pause_until(started.latest + step / 2)
    await subject.play(layer(0, ramp=min(500, subject.can["ramp_max"])))
    fall = alone(lines(step, 1, 0.25, 0))
    await subject.follow({0: fall}, started, 2 * step + 0.02, "ending that a longer ramp follows")


@driving(_PLACE)
async def extreme_envelopes(subject: Subject) -> None:
    """It plays as many knots as it states, along its shortest and longest step."""
    _require_knots(subject)
    count = subject.can["knots"]
    levels = [(0.2 + 0.8 * (at % 5) / 4) * (1 if at % 3 else -1) for at in range(count)]
    for step, knots in (
        (subject.can["envelope_step_min"] / 10_000, levels),
        (0.01, levels),
        (subject.can["envelope_step_max"] / 10_000, [1.0]),
    ):
        shape = subject.envelope(step, *knots)
        exact = shape.step / 10_000
        curve = alone(lines(exact, 0, *knots, 0.5))
        whole, why = exact * (len(knots) + 1), f"{len(knots)} knots, {1e3 * exact:g} ms apart"
        one = layer(0, subject.tone(0, 0.5, onset=shape))
        await subject.course({0: curve}, whole + 0.01, why, one)


def _require_knots(subject: Subject) -> None:
    if not subject.can["knots"]:
        raise Optional("it has no knots")


async def _require_interference(subject: Subject) -> None:
    """Raise Optional where levels do not show that tones of one frequency cancel.

    Neither those of opposite phases, nor those that began half a period apart.
    """
    slow = max(subject.lowest, _SLOW)
    tones = [subject.tone(0, 0.5, phase, frequency=slow) for phase in (0.0, 180.0)]
    await subject.play(layer(0, tones[0]), layer(1, tones[1]))
    seen = [(await subject.request("GetStatus"))["levels"][0]]
    first = await subject.play(layer(0, tones[0]), layer(1))
    await subject.pause_until(first.latest + 10 / slow)
    await subject.play(layer(1, tones[0]))
    seen.append((await subject.request("GetStatus"))["levels"][0])
    await subject.play(layer(0), layer(1))
    if min(seen) > 0.8 * subject.level * 10_000:
        raise Optional("its levels do not show that tones of one frequency interfere")


@driving(_PLACE)
async def phases(subject: Subject) -> None:
    """It plays the phases of a set on every channel and layer, counted from their commit."""
    await subject.arm()
    await _require_interference(subject)
    for channel in subject.channels:
        for number in subject.layers[1:]:
            await subject.play(
                layer(0, subject.tone(channel, 0.5, 30.0)),
                layer(number, subject.tone(channel, 0.5, 30.0 + 40.0 * number)),
            )
            levels = [0.0] * channel + [abs(polar(0.5, 0) + polar(0.5, 40.0 * number))]
            await subject.expect_levels(*levels, why=f"layers 0 and {number}, phases apart")
            await subject.play(layer(0), layer(number))
        for phase in (90.0, -90.0):
            await _expect_turned(subject, channel, phase, 0.25)


async def _expect_turned(subject: Subject, channel: int, phase: float, periods: float) -> None:
    """Require the phase between tones that began some periods apart, at the lowest frequency."""
    frequency = max(subject.lowest, _SLOW)
    hertz = frequency / 20
    first = await subject.play(layer(0, subject.tone(channel, 0.5, frequency=frequency)))
    await subject.pause_until(first.latest + periods / hertz)
    second = await subject.play(layer(1, subject.tone(channel, 0.5, phase, frequency=frequency)))
    status = (await subject.request("GetStatus")).values
    apart = second.earliest - first.latest, second.latest - first.earliest
    if 2 * math.pi * hertz * (apart[1] - apart[0]) > _RIGHT:
        raise Late("two sets were too far apart in time")
    turns = [
        math.radians(phase) - 2 * math.pi * hertz * (apart[0] + (apart[1] - apart[0]) * at / 32)
        for at in range(33)
    ]
    levels = [0.5 * abs(1 + polar(1, math.degrees(angle))) * subject.level for angle in turns]
    seen = status["levels"][channel] / 10_000
    # One may begin 2 ms later than the other.
    slack = subject.tolerance + subject.level * math.pi * hertz * 0.001
    await subject.play(layer(0), layer(1))
    expect(
        min(levels) - slack <= seen <= max(levels) + slack,
        f"level of channel {channel}, two tones {periods:g} periods and {phase:g} degrees apart",
        expected=f"{min(levels):.4f} to {max(levels):.4f}",
        seen=seen,
    )


@driving(_PLACE)
async def frequency(subject: Subject) -> None:
    """It plays the frequency that it says: tones a second apart are in the phase that follows."""
    await subject.arm()
    await _require_interference(subject)
    hertz = max(subject.lowest, _SLOW) / 20
    for quarter in (0.25, 0.5):
        periods = round(0.9 * hertz) + quarter
        await _expect_turned(subject, 0, 0.0, periods)
    began = clock.now()
    for keep in (True, False):
        await _kept(subject, keep=keep)
    expect(clock.now() >= began, "time", expected="forward", seen="backward")


async def _kept(subject: Subject, *, keep: bool) -> None:
    """Require that a kept phase counts from the first commit, another from its own."""
    slow = max(subject.lowest, _SLOW)
    hertz = slow / 20
    tones = [subject.tone(0, 0.5, frequency=slow, keep=each) for each in (False, keep)]
    first = await subject.play(layer(0, tones[0]), layer(1, tones[0]))
    await subject.pause_until(first.latest + 0.5 / hertz)
    second = await subject.play(layer(1, tones[1]))
    width = second.latest - second.earliest + first.latest - first.earliest
    if width * hertz > 0.3:  # as on a slow line: 15 ms of 50
        raise Late("two sets were too far apart in time")
    status = (await subject.request("GetStatus")).values
    seen = status["levels"][0] / 10_000 / subject.level
    await subject.play(layer(0), layer(1))
    highest = 0.05 + math.sin(math.pi * width * hertz)  # of tones so far from opposite phases
    is_met = seen > 0.95 if keep else seen < highest
    what = f"level of two layers, one begun again half a period later, keep phase {keep}"
    expect(is_met, what, expected="1" if keep else f"at most {highest:.3f}", seen=f"{seen:.3f}")
    expect_equal(status["levels"][1:], [0] * (len(subject.channels) - 1), "levels of the others")
