"""Checks of playback: layers and their ends, transitions, kept phases, voices, interference.

Checks of the clock: read, shifted by Arm, and steered by Ping.

Checks of measured values: voltages and currents of channels.
"""

import asyncio
import math
from dataclasses import replace
from functools import partial

from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    HIGH_STEPS,
    HIGH_TIME,
    HIGH_WORDS,
    QUANTITIES,
    has_flag,
)
from drivers.protocol.sets import Command, Envelope
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import (
    ContractViolation,
    RequestRows,
    Row,
    UntimedClock,
    expect_equal,
    expect_within,
    layer,
    play_now,
    require,
    require_in_time,
    send,
    stage,
    verify,
)
from era_haptics.lab.conformance.subject import RATE_STEP, Subject
from era_haptics.lab.expected_output import DRIFT
from registry import threads

_SLOW = 400  # steps of frequency: 20 Hz, whose periods are long against an exchange
_LONG = 1.0  # s; in which errors of a phase add up
_MAX_VOICES = 24  # that are tried
_MOMENTS, _OTHER_SETS = 6, 8  # numbers of sets: during the first fade, and added to it
_SHARES = 0.41, 0.1, 0.06  # of the test level, of the voices that are cut
_LEFT = 0.0035, 0.0008  # s; that a fade has left which counts, and one which does not
_BIT_15 = 1 << 15  # ms
_AMID = 0.15  # s; in which a sum comes to its peak


@driving("protocol.md#sum-of-a-channel")
def layers_add(subject: Subject) -> RequestRows:
    """Several layers on a channel: levels add, each layer shows its token.

    Keep voices and tokens for each layer, and add all voices of a channel.
    """
    share, last = 1 / len(subject.layers), len(subject.layers) - 1
    filled = [layer(each, subject.beside(each, share)) for each in reversed(subject.layers)]
    emptied = map(layer, subject.layers[:-1])
    return [subject.arm, *filled, *emptied, play_now(filled[-1], layer(last))]


@driving("protocol.md#layers")
def layers_play_on(subject: Subject) -> RequestRows:
    """Set for one layer: ramps, onsets and ends of other layers continue.

    Change only the layers that the set names.
    """
    first = subject.one(level=0.75, ramp=subject.ramp, valid_for=subject.ramp + 100)
    loud, quiet = (layer(1, subject.beside(1, each)) for each in (0.25, 0.125))
    return [(first, 0.02, loud, quiet, loud)]


@driving("protocol.md#layers")
def valid_for(subject: Subject) -> RequestRows:
    """After valid_for: the layer ends with its ramp, the amplifier stays armed.

    Count valid_for in real time from the start of the layer, as 16-bit milliseconds;
    0 is no end.
    """
    ramp, short = min(100, subject.can["ramp_max"]), subject.lasting(100)
    half, pause = subject.one(level=0.5, valid_for=short), 0.12 * subject.slowness
    lasting = layer(1, subject.beside(1, 0.25), valid_for=60_000)
    several = play_now(half, lasting, layer(2, subject.beside(2, 0.25)))
    return [
        [subject.one(valid_for=1)],
        [subject.one(valid_for=short)],
        [subject.one(ramp=ramp, valid_for=subject.lasting(150))],
        [several, partial(subject.follow, 2 * pause), half, subject.one(level=0.5), pause],
        [subject.one(valid_for=_BIT_15 + short), 2 * pause],
    ]


@driving("protocol.md#layers")
def renew(subject: Subject) -> RequestRows:
    """Renewal of a layer: valid_for restarts, nothing else changes.

    In a renewal, set the end of the layer and leave token, ramp, voices and waiting commands alone.
    A layer that is over stays over.
    """
    first, second = (
        subject.one(level=0.5, ramp=40, valid_for=subject.lasting(200)),
        layer(1, subject.beside(1, 0.25)),
    )
    sooner = layer(0, renew=True, valid_for=subject.lasting(100))
    third = layer(3, subject.beside(3, 0.25), valid_for=subject.lasting(120))
    turned = subject.one(subject.tone(0, 0.5, 90.0), valid_for=subject.lasting(400))
    return [
        (first, second, 0.05, layer(0, renew=True, valid_for=subject.lasting(200))),
        (turned, layer(0, renew=True), send("GetAchieved", layer=0)),
        (layer(2, renew=True, valid_for=subject.lasting(100)), second),
        (third, layer(3, renew=True), send("GetAchieved", layer=3), 0.15 * subject.slowness),
        *((subject.one(valid_for=subject.lasting(before)), sooner) for before in (0, 400)),
    ]


@driving("protocol.md#layers")
def after(subject: Subject) -> RequestRows:
    """Set with `after`: starts when the onset of its layer has arrived, or immediately.

    Keep the commands of the layer until then; a newer `after` replaces them, and every other set
    for this layer or Silence drops them.
    """
    first = subject.one(subject.tone(onset=subject.long_onset))
    waiting = layer(0, subject.tone(0, 0.25, frequency=subject.other), after=True)
    newer, over = layer(0, subject.tone(0, 0.75), after=True), _passed(subject, 3)
    both = waiting, layer(1, subject.beside(1, 0.25))  # only one of them waits

    async def achieved() -> None:
        answer = await subject.request("GetAchieved", layer=0)
        require_in_time(subject.shown.outputs.waits(answer.when), "the onset may have ended")

    return [
        (first, newer, waiting, send("Arm", watchdog=subject.can["watchdog_max"]), achieved),
        (subject.one(), waiting),
        (first, waiting, layer(0), over),
        (first, waiting, subject.one(level=0.75), over),
        (first, waiting, send("Silence", ramp=0), over),
        *((first, stage(*each), send("Commit", token=2)) for each in (both, both[::-1])),
    ]


def _passed(subject: Subject, sets: int) -> float:
    """Return how long after so many sets [s] the long onset of the first is over."""
    onset = subject.long_onset
    duration = onset.step * (len(onset.knots) + 1) / QUANTITIES["envelope_step"].per_unit
    return max(duration + 0.02 - sets * subject.exchange_time, 0.0)


@driving("protocol.md#layers")
def after_the_last_onset(subject: Subject) -> RequestRows:
    """Set with `after`, several onsets: waits for the last onset of its layer that has knots.

    Wait for voices of this layer that are not released and follow an onset with knots; ignore
    ramps, other layers and empty onsets.
    """
    long = subject.long_onset
    short = subject.envelope(min(max(0.02, 2 * subject.exchange_time), 0.1), 0.5)
    last = len(subject.channels) - 1
    both, exchanged = (
        [subject.tone(0, 0.5, onset=each), subject.tone(last, 0.5, onset=other)]
        for each, other in ((long, short), (short, subject.short_onset))
    )
    named = tuple(subject.tone(each, 0.25) for each in sorted({0, last}))
    waiting = layer(0, subject.tone(last, 0.25), after=True, ramp=20)
    rising = subject.one(level=0.5, ramp=subject.ramp)
    unshaped = subject.one(subject.tone(0, 0.5, onset=replace(subject.envelope(0.1), knots=())))
    other = layer(1, subject.beside(1, 0.5))
    shaped = replace(other, commands=(replace(other.commands[0], onset=long),))
    return [
        # A channel that is not named falls silent with what waited.
        (layer(0, *both[: last + 1]), waiting),
        (layer(0, *exchanged[1 - min(last, 1) :]), replace(waiting, commands=named)),
        # Nothing waits for a released voice.
        (subject.one(subject.tone(0, 0.5, ending=long)), layer(0), waiting),
        (play_now(subject.one(level=0.5), shaped), waiting),
        (rising, waiting),
        (unshaped, waiting),
    ]


@driving("protocol.md#layers")
def what_waits_for_an_onset(subject: Subject) -> RequestRows:
    """Start of waiting commands: valid_for counts from then, keep_phase continues voices.

    Start what waits before you remove voices at amplitude 0, and let an earlier end of the layer
    drop it.
    """
    long, short, lasts = subject.long_onset, subject.envelope(0.04, 1.0), subject.lasting(70)
    half = subject.one(subject.tone(0, 0.5, onset=long))
    other = layer(1, replace(subject.beside(1, 0.5), onset=subject.long_onset))
    kept = layer(0, subject.tone(0, 0.25, keep=True, onset=short), after=True)
    timed = layer(0, subject.tone(0, 0.25), after=True, ramp=20, valid_for=lasts)
    beside = layer(1, subject.beside(1, 0.25), after=True)
    ends = replace(half, valid_for=subject.lasting(60), ramp=20)
    renewed = layer(0, renew=True, valid_for=subject.lasting(1000))
    # Layer and onset end together: whole samples, and times that are binary fractions.
    quarter = subject.envelope(0.0625, *[1.0] * 3)
    is_quarter = (quarter.step, len(quarter.knots)) == (625, 3) and subject.slowness == 1
    together = subject.one(subject.tone(0, 0.5, onset=quarter), valid_for=250)
    sooner = replace(other, commands=(replace(other.commands[0], onset=subject.short_onset),))
    return [
        (half, replace(timed, valid_for=2 * lasts)),
        *([(half, kept)] if subject.can["frequency_step"] == 1 else []),  # else it may be another
        (half, other, timed, beside),
        (play_now(half, sooner), play_now(timed, beside)),
        *([(together, timed)] if is_quarter else []),
        (ends, replace(timed, valid_for=0), _passed(subject, 2)),
        (replace(half, valid_for=subject.lasting(900)), timed, renewed),
    ]


@driving("protocol.md#ramps-and-envelopes")
def ramps(subject: Subject) -> RequestRows:
    """Ramp up and down on every channel: Status follows the raised cosine.

    Use (1 - cos(pi s)) / 2 between the amplitude found and the new one, over the ramp of the layer.
    """
    whole, ramp_max = subject.whole(), subject.can["ramp_max"]
    part = partial(subject.follow, 0.4 * ramp_max / 1000)
    return [
        *([replace(whole, ramp=time)] for time in {subject.ramp, 20}),
        *([whole, layer(0, ramp=time)] for time in (subject.ramp, 20)),
        [replace(whole, ramp=ramp_max), part, send("Silence", ramp=0)],
    ]


@driving("protocol.md#ramps-and-envelopes")
def cross_fades(subject: Subject) -> RequestRows:
    """New tone without keep_phase: the old voice and the new one follow their own ramps.

    Begin a new voice at amplitude 0 and fade the old one, each from the amplitude found at the
    change.
    """
    ramp, part = subject.ramp, 0.4 * subject.ramp / 1000
    half, other = subject.one(level=0.5), subject.tone(0, 0.5, frequency=subject.other)
    fade = layer(0, other, ramp=ramp)
    return [
        (half, layer(0, subject.tone(frequency=subject.other), ramp=ramp)),
        (half, layer(0, subject.tone(0, 0.5, 180.0), ramp=ramp)),
        (subject.one(ramp=ramp), part, fade),
        (subject.one(), fade, part, layer(0, ramp=min(3 * ramp, subject.can["ramp_max"]))),
    ]


@driving("protocol.md#layers")
def kept_phase(subject: Subject) -> RequestRows:
    """keep_phase with the same frequency: the voice continues from its current amplitude.

    Continue a voice of the same layer, channel and frequency that is not released; otherwise begin
    a new one.
    """
    tones = [
        subject.tone(0, fraction, phase, keep=True, frequency=frequency)
        for fraction, phase, frequency in (
            (0.5, 0, 0),
            (1, 180, 0),
            (1, 90, 0),
            (1, 180, subject.other),
        )
    ]
    ramp, amid = subject.ramp, 0.4 * subject.ramp / 1000
    knots = min(1, subject.can["knots"])
    ending = subject.envelope(0.1, *[0.75] * knots)
    again = layer(0, subject.tone(0, 0.5, keep=True), ramp=ramp)
    shaped = subject.tone(0, 0.5, keep=True, onset=subject.envelope(0.1, *[0.25] * knots))
    return [
        *((subject.one(), layer(0, tone, ramp=ramp)) for tone in tones),
        # Nothing goes on that is of another layer, or has been released.
        (subject.one(level=0.5), layer(1, shaped)),
        (subject.one(level=0.5), layer(0, ramp=ramp), amid, again),
        (subject.one(subject.tone(0, 0.5, ending=ending)), layer(0), 0.02, again),
    ]


@driving("protocol.md#ramps-and-envelopes")
def onsets(subject: Subject) -> RequestRows:
    """Onset: straight lines in the complex plane from knot to knot.

    Interpolate real and imaginary parts, not level and phase, beginning at 0 or at the amplitude of
    the kept voice, with knots + 1 steps.
    """
    subject.require_knots()
    shapes = [
        subject.envelope(0.04, *fractions)
        for fractions in ([0.25, -0.5], [1, 0.25, 0.75], [0.5, -0.5, -0.5j], [])
    ]
    alone = [[subject.one(subject.tone(0, 0.5, 90.0, onset=shape))] for shape in shapes]
    kept = subject.one(subject.tone(0, 0.5, onset=shapes[0], keep=True))
    again = subject.one(subject.tone(0, 0.5, onset=shapes[0]), ramp=subject.ramp)
    rising = subject.one(ramp=subject.ramp), 0.4 * subject.ramp / 1000
    return [*alone, (subject.one(), kept), (*rising, kept), (subject.one(), again)]


@driving("protocol.md#layers")
def endings(subject: Subject) -> RequestRows:
    """Layer without a new command, or at its end: each voice follows its ending to zero.

    Store the ending with its voice. Use it for a command left out, for level 0 and for valid_for;
    use the ramp if a new command drives or skip_ending is set.
    """
    subject.require_knots()
    last, ramp = len(subject.channels) - 1, subject.ramp
    tone = subject.tone(last, 1.0, 90.0, ending=subject.envelope(0.03, 0.25j, 0.75, 0.5))
    unshaped = replace(tone, ending=subject.envelope(0.07))
    first, quiet = layer(0, tone), subject.tone(last, 0.0)
    replaced = replace(quiet, onset=subject.envelope(0.1))
    return [
        (first, layer(0)),
        (first, layer(0, replace(quiet, ending=subject.envelope(0.02, 1.0)))),  # its own counts
        (first, layer(0, subject.tone(0, 0.0))),
        (layer(0, tone, valid_for=100),),
        (layer(0, unshaped), layer(0)),
        (first, layer(0, replace(quiet, skip_ending=True), ramp=ramp)),
        (first, layer(0, replaced, ramp=ramp)),
        (first, layer(0, subject.tone(last, keep=True), ramp=ramp), layer(0, ramp=ramp)),
        (layer(0, unshaped), layer(0, replace(tone, keep_phase=True)), layer(0)),
    ]


@driving("protocol.md#layers")
def endings_amid(subject: Subject) -> RequestRows:
    """Ending during an onset or fade: starts at the current amplitude, once.

    Begin an ending at the amplitude found, never restart it, and let a later fade shorten it but
    not prolong it.
    """
    subject.require_knots()
    slowest = min(subject.exchange_time, 0.1)
    knots = 1 if subject.slowness == 1 else math.ceil(slowest / 0.01)
    onset, ending = subject.envelope(0.1, *[1.0] * knots), subject.envelope(0.05, *[0.25] * knots)
    half, part = knots * onset.step / 20_000, knots * ending.step / 20_000
    over = [(knots + 1) * each.step / 10_000 + 0.02 for each in (onset, ending)]
    towards_0 = subject.tone(0, 0.0, onset=onset)  # a voice counts until its onset has ended
    long = min(500, subject.can["ramp_max"])
    return [
        (layer(0, replace(towards_0, ending=ending)), half, layer(0)),
        (layer(0, replace(towards_0, ending=ending)), over[0], layer(0)),
        (layer(0, replace(towards_0, ending=ending), valid_for=round(1000 * half)),),
        *(
            (subject.one(subject.tone(ending=ending)), layer(0), at, layer(0))
            for at in (part, over[1])
        ),
        (layer(0, towards_0), half, subject.one(subject.tone(keep=True), ramp=subject.ramp + 75)),
        (subject.one(subject.tone(ending=ending)), layer(0), part, send("Silence", ramp=long)),
        (layer(0, towards_0), half, send("Silence", ramp=long)),
    ]


@driving("protocol.md#ramps-and-envelopes")
def extreme_envelopes(subject: Subject) -> RequestRows:
    """Envelope with the most knots, the shortest and the longest step: followed exactly.

    State only the knots and steps that you can play.
    """
    subject.require_knots()
    count = range(subject.can["knots"])
    levels = [(0.2 + 0.8 * (at % 5) / 4) * (1 if at % 3 else -1) for at in count]
    ends = subject.can["envelope_step_min"], subject.can["envelope_step_max"]
    cases = (ends[0], levels), (100, levels), (ends[1], [1.0])
    shapes = [subject.envelope(step / 10_000, *knots) for step, knots in cases]
    return [[subject.one(subject.tone(0, 0.5, onset=shape))] for shape in shapes]


@driving("protocol.md#the-clock")
async def phases(subject: Subject) -> None:
    """Two tones at the same frequency: they add by phase, whenever each began.

    Compute the angle as n times clock modulo 2^32 at every sample; do not start a phase at the
    commit, and do not accumulate rounded steps.
    """
    await subject.arm()
    await subject.require_interference()
    first = layer(0, *(subject.tone(each, 0.5, 30.0) for each in subject.channels))
    for number in subject.layers[1:]:
        angle = 30.0 + 40.0 * number
        tones = [subject.tone(each, 0.5, angle + 5.0 * each) for each in subject.channels]
        silent = [layer(each) for each in subject.layers[1:] if each != number]
        await subject.run([play_now(first, layer(number, *tones), *silent)])
    for phase, periods in ((0.0, 0.25), (0.0, 0.5), (90.0, 0.75), (180.0, 0.5)):
        time = periods * 20 / max(subject.lowest, _SLOW)
        await subject.in_time(partial(_expect_alike, subject, phase, time))
    await subject.in_time(partial(_expect_cancelled, subject))


async def _expect_cancelled(subject: Subject) -> None:
    """Play the opposite of a tone of seconds before, amid which the clock has gone round."""
    await subject.status()
    left = HIGH_WORDS - subject.shown.clock.present - round(_LONG / 2 / HIGH_TIME)
    await subject.arm(shift=left % HIGH_WORDS)
    subject.shown.outputs.interferes = True
    one, opposite = (
        layer(number, subject.tone(0, 0.5, 180.0 * number, frequency=subject.near(1) | 1))
        for number in (0, 1)
    )
    await subject.run([one, _LONG, opposite, subject.status])


async def _expect_alike(subject: Subject, phase: float, time: float) -> None:
    """Play two slow tones a time [s] apart, the first renewed, then again, that time later."""
    await subject.arm()
    subject.shown.outputs.interferes = True
    first, second = (
        layer(number, subject.tone(0, 0.5, each, frequency=max(subject.lowest, _SLOW)))
        for number, each in enumerate((0.0, phase))
    )
    renewed = layer(0, renew=True)
    await subject.run([first, time, renewed, second, time, first, time, subject.status])


@driving("protocol.md#voices")
def voices(subject: Subject) -> RequestRows:
    """More voices than `voices` on a channel: the oldest fades end within 2 ms, no refusal.

    Count only voices that last longer than 2 ms, keep a spare voice for each layer, and shorten
    released voices in the order in which their paths began.
    """
    channels, last = sorted({0, subject.channels[-1]}), subject.layers[-1]
    count = min(subject.can["voices"], _MAX_VOICES)
    fades = count - last
    at_once, shape = subject.envelope(0.0001), subject.envelope(0.1, *[_SHARES[1]] * 8)
    pause = 0.004 + at_once.step / 10_000  # s; until a tone is at its level
    first, bulk = len(_SHARES), subject.layers[1:-1]
    sets = first + max(math.ceil((fades - first) / len(bulk)), 0) + _OTHER_SETS
    time = sets * (subject.exchange_time + pause)
    lead = subject.lead(_MOMENTS, subject.can["ramp_max"] / 1000 - time)
    time += _MOMENTS * lead
    subject.require_ramp(time)
    ramp = min(max(math.ceil(2500 * time), 200), subject.can["ramp_max"])
    ending = shape if shape.step * (len(shape.knots) + 1) >= 10 * ramp / 3 else None
    quiet = (1 - sum(_SHARES)) / (count + 2)

    def tones(at: int, ending: Envelope | None = None) -> list[Command]:
        share = _SHARES[at] if at < len(_SHARES) else quiet
        made = partial(subject.tone, fraction=share, frequency=subject.near(at), onset=at_once)
        return [made(each, ending=ending) for each in channels]

    async def fade(number: int) -> None:
        """Start fading tones, then lasting ones: the first fade is the longest, the next uses its
        ending.

        Those behind the few that are cut fade together, in as many layers as there are.
        """
        for at in range(min(number, first) + 1):
            await subject.play(layer(0, *tones(at, ending if at == 1 else None), ramp=ramp - at))
            await asyncio.sleep(pause)
            if at == 1 and ending:
                await subject.play(layer(0))
        for left in range(number - first, 0, -len(bulk)):
            several = [(each, last + count + left + each) for each in bulk[:left]]
            await subject.play(*(layer(each, *tones(at), ramp=ramp) for each, at in several))
            await asyncio.sleep(pause)

    async def count_until(left: float) -> None:
        """Begin a tone while the fade that began last has a time left [s]."""
        apart = math.ceil(2000 * lead)
        await subject.at(layer(0, *tones(fades - 1), ramp=apart), lead=lead)
        await subject.at(layer(0, *tones(fades), ramp=ramp), lead=lead, apart=apart / 1000 - left)

    look = partial(subject.follow, 0.015)
    cuts: list[Row] = []
    for at in range(fades, fades + len(_SHARES)):
        cuts += [partial(subject.at, layer(0, *tones(at), ramp=ramp), lead=lead), look]
    lasting = play_now(*(layer(number, *tones(count + number)) for number in subject.layers[1:]))
    # A full pool refuses neither another layer nor a layer's silence, nor a fade of all.
    fade_all = play_now(*(layer(each, ramp=ramp) for each in subject.layers[:3]))
    silence = send("Silence", ramp=0)
    full = layer(1, *tones(count + 1), ramp=ramp), fade_all, play_now(subject.one()), silence
    counted = [(partial(count_until, left), look) for left in _LEFT]
    return [
        # The oldest tone fades last: the fade that began first is cut off.
        (lasting, partial(fade, fades - 1), layer(1, ramp=ramp), *cuts, *full),
        *((lasting, partial(fade, fades - 2), *each, silence) for each in counted),
    ]


@driving("protocol.md#sum-of-a-channel")
async def limited(subject: Subject) -> None:
    """Sum above full level: cut off, and flagged once.

    Note every sample whose sum exceeds full level by more than a step of level, show the flag in
    the next Status, then clear it.
    """
    require(subject.level * 2 > 1.0, "tested only above half of full level; see --level")
    require(
        abs(subject.other - subject.frequency) >= subject.can["frequency_step"],
        "all tones have the same frequency and interfere",
    )
    last = subject.channels[-1]
    over = layer(1, subject.tone(frequency=subject.other))
    near, just = (layer(1, subject.tone(last, each / subject.level - 1.0)) for each in (1.0, 1.01))
    shown = _AMID, over, _AMID, layer(1), near, _AMID
    await subject.run([subject.arm, subject.whole(), near, *shown, just, _AMID, *shown])

    async def unseen(name: str, **values: int) -> None:
        """Play a tone during a fade that no earlier status shows."""
        beside = play_now(subject.whole(), layer(1, ramp=subject.ramp))
        await subject.send_all([play_now(layer(0), over), beside])
        await asyncio.sleep(_AMID)
        await subject.request("GetAchieved", layer=0)
        flags = await subject.request(name, **values)
        expect_equal(
            has_flag(flags.values, "limited"), True, "flag limited after a sum above full level"
        )

    await unseen("Ping")
    opposite = layer(1, subject.tone(0, 1.0, 180.0))
    await subject.run([layer(1), play_now(subject.one(), opposite), _AMID])
    flags = await subject.request("GetStatus")
    expect_equal(has_flag(flags.values, "limited"), False, "flag limited for tones that cancel")
    await unseen("Stop", ramp=0)


_LOWEST, _HIGHEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_READINGS, _APART = 8, 0.03  # readings of one state; at most this many s between two
_MAX_DURATION = 8.0  # s; in which a rate must show
_LASTING, _QUICK = 1.5, 0.01  # s; of a layer, whose end shows a wrong rate; for an exchange
_SHIFTS = 1, 0x4000, 0xC001


_UNSTATED = (
    "clock_error is 65535, unknown; measure the largest error of a clock reading and state it in "
    "the capabilities"
)


def _require_known(subject: Subject) -> None:
    require(subject.can["clock_error"] != CLOCK_UNKNOWN, _UNSTATED)


async def _read(subject: Subject, otherwise: type[ContractViolation] = ContractViolation) -> None:
    low = set()
    for at in range(_READINGS):
        low.add((await subject.status())["clock"] % HIGH_STEPS)
        await asyncio.sleep(_APART * (at % 7) / 7)
    await subject.request("GetStatus")
    subject.dating.expect_steady(otherwise)
    is_coarse = subject.can["clock_error"] > QUANTITIES["clock_error"].to_wire(HIGH_TIME)
    verify(is_coarse or len(low) > 1, "low words of the clock", expected="several values", seen=low)


@reading("protocol.md#the-clock")
async def clock_goes_on(subject: Subject) -> None:
    """Two GetStatus: the clock advances by the time between them.

    Derive the clock from the sample count, and add the time since the last sample by a timer.
    Nothing is driven until this check passes, because all times are judged by this clock.
    """
    _require_known(subject)
    await _read(subject, UntimedClock)


@driving("protocol.md#the-clock")
def clock_readings(subject: Subject) -> RequestRows:
    """Status while armed: its clock was read between the request and the reply.

    Read the clock when you build the reply, between samples too, without a constant or growing
    error above clock_error.
    """
    _require_known(subject)
    return [subject.arm, subject.one(), partial(_read, subject)]


@driving("protocol.md#the-clock")
def clock_shifts(subject: Subject) -> RequestRows:
    """Arm with a shift: the clock moves by this shift; with the session held: no shift.

    Add shift times 65536 to the clock, modulo 2^32, before you build the reply, and only if the
    session is new.
    """
    _require_known(subject)
    again = send("Arm", watchdog=subject.can["watchdog_max"], shift=_SHIFTS[1])

    async def shift() -> None:
        for steps in _SHIFTS:
            await subject.arm(shift=steps)
            await subject.run([again, send("Disarm", ramp=0), subject.settle])
            await subject.request("GetStatus")
            subject.dating.expect_steady()

    return [shift]


@driving("protocol.md#the-clock")
async def clock_rate(subject: Subject) -> None:
    """Ping with a rate: the clock keeps this rate until the next Ping; unarmed: rate 0.

    Scale the increment of the clock only. Times such as valid_for, ramps and the watchdog stay real
    time; leaving OPERATION_ENABLED resets the rate.
    """
    _require_known(subject)
    await subject.request("GetStatus")  # whose exchanges all rests on
    duration = max(0.35, 1.5 * subject.read_time / (_HIGHEST * RATE_STEP - DRIFT))
    require(duration <= _MAX_DURATION, "the line is too slow to observe the rate")

    lasting = _LASTING if subject.exchange_time <= _QUICK else duration / 2  # s; not of the clock
    timed = subject.one(valid_for=round(1000 * lasting), ramp=subject.ramp)

    async def read(duration: float = duration) -> None:
        end = threads.now() + duration
        while threads.now() < end:  # a Commit feeds, and leaves the rate as it is
            again = send("Commit", token=subject.token)
            await subject.run([again if subject.is_hungry else send("GetStatus")])
            await asyncio.sleep(_APART / 2)
        await subject.request("GetStatus")
        subject.dating.expect_steady()

    fast, slow = (send("Ping", rate=each) for each in (_HIGHEST, _LOWEST))
    changing_nothing: RequestRows = (
        send("Ping", session=77, rate=_LOWEST, code="WRONG_SESSION"),
        send("Silence", ramp=0),
        send("Arm", watchdog=subject.can["watchdog_max"], shift=1),
        timed,
    )
    falls_silent = send("Disarm", ramp=subject.ramp), slow, subject.settle
    trips = subject.starve, subject.shortest_watchdog / 1000, subject.settle, slow
    await subject.run(
        [
            subject.arm,
            fast,
            *changing_nothing,
            partial(read, lasting + duration),
            slow,
            read,
            fast,
            send("Stop", ramp=0),
            slow,
            read,
            subject.clear,
            subject.arm,
            subject.one(),
            fast,
            *falls_silent,
            slow,
            read,
            partial(subject.arm, 0.0),
            fast,
            *trips,
            read,
        ]
    )


@driving("protocol.md#readings")
async def measured(subject: Subject) -> None:
    """GetMeasured: a row for every channel, more voltage on a channel that plays.

    Measure rms values over at least one period, on every channel, armed or not.
    """
    subject.require("electrical")

    async def voltages() -> list[int]:
        rows = (await subject.request("GetMeasured"))["channels"]
        expect_equal(len(rows), len(subject.channels), "number of measured channels")
        return [each["channel_voltage"] for each in rows]

    silent = await voltages()
    await subject.arm()
    for channel in subject.channels:
        await subject.play(layer(0, subject.tone(channel)))
        await asyncio.sleep(0.05)
        playing = (await voltages())[channel]
        expect_within(
            playing, silent[channel] + 1, math.inf, f"voltage of channel {channel} while it plays"
        )
