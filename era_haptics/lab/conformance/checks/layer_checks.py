"""Checks of layers: how they add, end, are renewed, and wait for each other."""

from dataclasses import replace
from functools import partial

from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import LayerSet
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.outcomes import require_in_time
from era_haptics.lab.conformance.request_rows import (
    SILENCE_NOW,
    RequestRows,
    Row,
    Wait,
    commit,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_BIT_15 = 1 << 15  # ms
_QUARTER = 0.0625  # s; step of an onset with three knots, which is a binary fraction


@driving("protocol.md#sum-of-a-channel")
def layers_add(subject: Subject) -> RequestRows:
    """Several layers on a channel: levels add, each layer shows its token.

    Keep voices and tokens for each layer, and add all voices of a channel.
    """
    share = 1 / len(subject.layers)
    last = len(subject.layers) - 1
    playing = []
    for number in reversed(subject.layers):
        playing.append(subject.separate_layer(number, share))
    silent = [layer(number) for number in subject.layers[:-1]]
    exchange = play_now(playing[-1], layer(last))
    return [subject.arm, *playing, *silent, exchange]


@driving("protocol.md#layers")
def layers_play_on(subject: Subject) -> RequestRows:
    """Set for one layer: ramps, onsets and ends of other layers continue.

    Change only the layers that the set names.
    """
    ramp = subject.ramp
    first = subject.layer_0(level=0.75, ramp=ramp, valid_for=ramp + 100)
    loud = subject.separate_layer(1, 0.25)
    quiet = subject.separate_layer(1, 0.125)
    return [(first, Wait(0.02), loud, quiet, loud)]


@driving("protocol.md#layers")
def valid_for(subject: Subject) -> RequestRows:
    """After valid_for: the layer ends with its ramp, the amplifier stays armed.

    Count valid_for in real time from the start of the layer, as 16-bit milliseconds;
    0 is no end.
    """
    ramp = min(100, subject.ramp_max)
    short = subject.scaled(100)
    pause = 0.12 * subject.timing.slowness
    half = subject.layer_0(level=0.5, valid_for=short)
    endless_half = subject.layer_0(level=0.5)
    lasting = layer(1, subject.separate_tone(1, 0.25), valid_for=60_000)
    endless = subject.separate_layer(2, 0.25)
    return [
        [subject.layer_0(valid_for=1)],
        [subject.layer_0(valid_for=short)],
        [subject.layer_0(ramp=ramp, valid_for=subject.scaled(150))],
        [
            play_now(half, lasting, endless),
            partial(subject.follow, 2 * pause),
            half,
            endless_half,
            Wait(pause),
        ],
        [subject.layer_0(valid_for=_BIT_15 + short), Wait(2 * pause)],
    ]


@driving("protocol.md#layers")
def renew(subject: Subject) -> RequestRows:
    """Renewal of a layer: valid_for restarts, nothing else changes.

    In a renewal, set the end of the layer and leave token, ramp, voices and waiting commands alone.
    A layer that is over stays over.
    """
    scaled = subject.scaled
    fading = subject.layer_0(level=0.5, ramp=40, valid_for=scaled(200))
    turned = subject.layer_0(subject.tone(0, 0.5, 90.0), valid_for=scaled(400))
    second = subject.separate_layer(1, 0.25)
    timed = layer(3, subject.separate_tone(3, 0.25), valid_for=scaled(120))
    earlier_end = layer(0, renew=True, valid_for=scaled(100))
    past_end = Wait(0.15 * subject.timing.slowness)
    return [
        (fading, second, Wait(0.05), layer(0, renew=True, valid_for=scaled(200))),
        (turned, layer(0, renew=True), send("GetAchieved", layer=0)),
        (layer(2, renew=True, valid_for=scaled(100)), second),
        (timed, layer(3, renew=True), send("GetAchieved", layer=3), past_end),
        (subject.layer_0(valid_for=0), earlier_end),
        (subject.layer_0(valid_for=scaled(400)), earlier_end),
    ]


@driving("protocol.md#layers")
def after(subject: Subject) -> RequestRows:
    """Set with `after`: starts when the onset of its layer has arrived, or immediately.

    Keep the commands of the layer until then; a newer `after` replaces them, and every other set
    for this layer or Silence drops them.
    """
    rising = subject.layer_0(subject.tone(onset=subject.long_onset))
    waiting_tone = subject.tone(0, 0.25, frequency=subject.second_frequency)
    waiting = layer(0, waiting_tone, after=True)
    replaced = layer(0, subject.tone(0, 0.75), after=True)
    other_layer = subject.separate_layer(1, 0.25)
    arm_again = send("Arm", watchdog=subject.can["watchdog_max"])
    onset_end = _until_onset_end(subject, 3)
    return [
        (rising, replaced, waiting, arm_again, partial(_read_achieved, subject)),
        (subject.layer_0(), waiting),
        (rising, waiting, layer(0), onset_end),
        (rising, waiting, subject.layer_0(level=0.75), onset_end),
        (rising, waiting, SILENCE_NOW, onset_end),
        # Only one layer of a set waits.
        (rising, stage(waiting, other_layer), commit(2)),
        (rising, stage(other_layer, waiting), commit(2)),
    ]


async def _read_achieved(subject: Subject) -> None:
    """Read the achieved values of layer 0 before the end of its onset."""
    reply = await subject.request("GetAchieved", layer=0)
    is_waiting = subject.judge.outputs.waits(reply.when)
    require_in_time(is_waiting, "the onset may have ended")


def _until_onset_end(subject: Subject, sets: int) -> Wait:
    """Wait, after so many sets, until the long onset of the first is over."""
    onset = subject.long_onset
    step = onset.step / QUANTITIES["envelope_step"].per_unit
    duration = step * (len(onset.knots) + 1)
    return Wait(max(duration + 0.02 - sets * subject.timing.exchange_time, 0.0))


@driving("protocol.md#layers")
def after_the_last_onset(subject: Subject) -> RequestRows:
    """Set with `after`, several onsets: waits for the last onset of its layer that has knots.

    Wait for voices of this layer that are not released and follow an onset with knots; ignore
    ramps, other layers and empty onsets.
    """
    long_onset = subject.long_onset
    last = len(subject.channels) - 1
    waiting = layer(0, subject.tone(last, 0.25), after=True, ramp=20)
    rising = subject.layer_0(level=0.5, ramp=subject.ramp)
    empty_onset = replace(subject.envelope(0.1), knots=())
    unshaped = subject.layer_0(subject.tone(0, 0.5, onset=empty_onset))
    released = subject.layer_0(subject.tone(0, 0.5, ending=long_onset))
    half = subject.layer_0(level=0.5)
    other_tone = replace(subject.separate_tone(1, 0.5), onset=long_onset)
    return [
        *_two_onsets(subject, waiting),
        (released, layer(0), waiting),
        (play_now(half, layer(1, other_tone)), waiting),
        (rising, waiting),
        (unshaped, waiting),
    ]


def _two_onsets(subject: Subject, waiting: LayerSet) -> list[Row]:
    """Return layers with a long and a short onset, and a layer that waits for the long one.

    On an amplifier with one channel there is one onset only.
    """
    step = min(max(0.02, 2 * subject.timing.exchange_time), 0.1)
    long_onset, short_onset = subject.long_onset, subject.envelope(step, 0.5)
    last = len(subject.channels) - 1
    first_is_long = [
        subject.tone(0, 0.5, onset=long_onset),
        subject.tone(last, 0.5, onset=short_onset),
    ]
    last_is_long = [
        subject.tone(0, 0.5, onset=short_onset),
        subject.tone(last, 0.5, onset=subject.short_onset),
    ]
    if last == 0:
        first_is_long = first_is_long[:1]
        last_is_long = last_is_long[1:]
    quiet_tones = [subject.tone(channel, 0.25) for channel in sorted({0, last})]
    return [
        # A channel that is not named falls silent when the waiting commands start.
        (layer(0, *first_is_long), waiting),
        (layer(0, *last_is_long), replace(waiting, commands=tuple(quiet_tones))),
    ]


@driving("protocol.md#layers")
def what_waits_for_an_onset(subject: Subject) -> RequestRows:
    """Start of waiting commands: valid_for counts from then, keep_phase continues voices.

    Start what waits before you remove voices at amplitude 0, and let an earlier end of the layer
    drop it.
    """
    scaled = subject.scaled
    rising = subject.layer_0(subject.tone(0, 0.5, onset=subject.long_onset))
    quarter = subject.tone(0, 0.25)
    timed = layer(0, quarter, after=True, ramp=20, valid_for=scaled(70))
    other_tone = subject.separate_tone(1, 0.5)
    other_rising = layer(1, replace(other_tone, onset=subject.long_onset))
    other_short = layer(1, replace(other_tone, onset=subject.short_onset))
    other_waiting = layer(1, subject.separate_tone(1, 0.25), after=True)
    ending = replace(rising, valid_for=scaled(60), ramp=20)
    renewed = layer(0, renew=True, valid_for=scaled(1000))
    courses: list[Row] = [(rising, replace(timed, valid_for=2 * scaled(70)))]
    if subject.can["frequency_step"] == 1:  # otherwise the frequency can be another
        onset = subject.envelope(0.04, 1.0)
        continued = subject.tone(0, 0.25, keep=True, onset=onset)
        courses.append((rising, layer(0, continued, after=True)))
    courses.append((rising, other_rising, timed, other_waiting))
    courses.append((play_now(rising, other_short), play_now(timed, other_waiting)))
    courses += _ending_with_its_onset(subject, timed)
    courses.append((ending, replace(timed, valid_for=0), _until_onset_end(subject, 2)))
    courses.append((replace(rising, valid_for=scaled(900)), timed, renewed))
    return courses


def _ending_with_its_onset(subject: Subject, waiting: LayerSet) -> list[Row]:
    """Return a layer that ends together with its onset, if the amplifier has such an onset.

    Both times are whole samples and binary fractions.
    """
    onset = subject.envelope(_QUARTER, *[1.0] * 3)
    has_onset = onset.step == 625 and len(onset.knots) == 3
    if not has_onset or subject.timing.slowness != 1:
        return []
    return [(subject.layer_0(subject.tone(0, 0.5, onset=onset), valid_for=250), waiting)]
