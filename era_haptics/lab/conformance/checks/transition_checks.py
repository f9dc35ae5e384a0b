"""Checks of transitions: ramps, cross-fades, kept phases, onsets and endings."""

import math
from dataclasses import replace
from functools import partial

from drivers.protocol.sets import Envelope
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.request_rows import (
    SILENCE_NOW,
    RequestRows,
    Row,
    Wait,
    layer,
    send,
)
from era_haptics.lab.conformance.subject import Subject

_STEPS_PER_MS = 10  # of an envelope's step


@driving("protocol.md#ramps-and-envelopes")
def ramps(subject: Subject) -> RequestRows:
    """Ramp up and down on every channel: Status follows the raised cosine.

    Use (1 - cos(pi s)) / 2 between the amplitude found and the new one, over the ramp of the layer.
    """
    playing = subject.all_channels()
    ramp_max = subject.ramp_max
    during_ramp = partial(subject.follow, 0.4 * ramp_max / 1000)
    courses: list[Row] = []
    for ramp in {subject.ramp, 20}:
        courses.append([replace(playing, ramp=ramp)])
    for ramp in (subject.ramp, 20):
        courses.append([playing, layer(0, ramp=ramp)])
    courses.append([replace(playing, ramp=ramp_max), during_ramp, SILENCE_NOW])
    return courses


@driving("protocol.md#ramps-and-envelopes")
def cross_fades(subject: Subject) -> RequestRows:
    """New tone without keep_phase: the old voice and the new one follow their own ramps.

    Begin a new voice at amplitude 0 and fade the old one, each from the amplitude found at the
    change.
    """
    ramp = subject.ramp
    during_ramp = Wait(0.4 * ramp / 1000)
    half = subject.layer_0(level=0.5)
    other_loud = layer(0, subject.tone(frequency=subject.second_frequency), ramp=ramp)
    other_half = layer(0, subject.tone(0, 0.5, frequency=subject.second_frequency), ramp=ramp)
    opposite = layer(0, subject.tone(0, 0.5, 180.0), ramp=ramp)
    slow_silence = layer(0, ramp=min(3 * ramp, subject.ramp_max))
    return [
        (half, other_loud),
        (half, opposite),
        (subject.layer_0(ramp=ramp), during_ramp, other_half),
        (subject.layer_0(), other_half, during_ramp, slow_silence),
    ]


@driving("protocol.md#layers")
def kept_phase(subject: Subject) -> RequestRows:
    """keep_phase with the same frequency: the voice continues from its current amplitude.

    Continue a voice of the same layer, channel and frequency that is not released; otherwise begin
    a new one.
    """
    ramp = subject.ramp
    during_ramp = Wait(0.4 * ramp / 1000)
    half = subject.layer_0(level=0.5)
    knots = min(1, subject.can["knots"])
    onset = subject.envelope(0.1, *[0.25] * knots)
    ending = subject.envelope(0.1, *[0.75] * knots)
    continued = layer(0, subject.tone(0, 0.5, keep=True), ramp=ramp)
    courses: list[Row] = []
    for level, phase, frequency in (
        (0.5, 0, 0),
        (1, 180, 0),
        (1, 90, 0),
        (1, 180, subject.second_frequency),
    ):
        tone = subject.tone(0, level, phase, keep=True, frequency=frequency)
        courses.append((subject.layer_0(), layer(0, tone, ramp=ramp)))
    # A voice of another layer does not continue, nor does a released one.
    other_layer = layer(1, subject.tone(0, 0.5, keep=True, onset=onset))
    ended = subject.layer_0(subject.tone(0, 0.5, ending=ending))
    courses.append((half, other_layer))
    courses.append((half, layer(0, ramp=ramp), during_ramp, continued))
    courses.append((ended, layer(0), Wait(0.02), continued))
    return courses


@driving("protocol.md#ramps-and-envelopes")
def onsets(subject: Subject) -> RequestRows:
    """Onset: straight lines in the complex plane from knot to knot.

    Interpolate real and imaginary parts, not level and phase, beginning at 0 or at the amplitude of
    the kept voice, with knots + 1 steps.
    """
    subject.require_knots()
    ramp = subject.ramp
    during_ramp = Wait(0.4 * ramp / 1000)
    courses: list[Row] = []
    for amplitudes in ([0.25, -0.5], [1, 0.25, 0.75], [0.5, -0.5, -0.5j], []):
        onset = subject.envelope(0.04, *amplitudes)
        courses.append([subject.layer_0(subject.tone(0, 0.5, 90.0, onset=onset))])
    onset = subject.envelope(0.04, 0.25, -0.5)
    continued = subject.layer_0(subject.tone(0, 0.5, onset=onset, keep=True))
    new = subject.layer_0(subject.tone(0, 0.5, onset=onset), ramp=ramp)
    courses.append((subject.layer_0(), continued))
    courses.append((subject.layer_0(ramp=ramp), during_ramp, continued))
    courses.append((subject.layer_0(), new))
    return courses


@driving("protocol.md#layers")
def endings(subject: Subject) -> RequestRows:
    """Layer without a new command, or at its end: each voice follows its ending to zero.

    Store the ending with its voice. Use it for a command left out, for level 0 and for valid_for;
    use the ramp if a new command drives or skip_ending is set.
    """
    subject.require_knots()
    last, ramp = len(subject.channels) - 1, subject.ramp
    ending = subject.envelope(0.03, 0.25j, 0.75, 0.5)
    tone = subject.tone(last, 1.0, 90.0, ending=ending)
    playing = layer(0, tone)
    without_knots = replace(tone, ending=subject.envelope(0.07))
    level_0 = subject.tone(last, 0.0)
    other_ending = replace(level_0, ending=subject.envelope(0.02, 1.0))
    skipped_ending = replace(level_0, skip_ending=True)
    new_onset = replace(level_0, onset=subject.envelope(0.1))
    continued = subject.tone(last, keep=True)
    return [
        (playing, layer(0)),
        (playing, layer(0, other_ending)),  # the ending of the voice counts
        (playing, layer(0, subject.tone(0, 0.0))),
        (layer(0, tone, valid_for=100),),
        (layer(0, without_knots), layer(0)),
        (playing, layer(0, skipped_ending, ramp=ramp)),
        (playing, layer(0, new_onset, ramp=ramp)),
        (playing, layer(0, continued, ramp=ramp), layer(0, ramp=ramp)),
        (layer(0, without_knots), layer(0, replace(tone, keep_phase=True)), layer(0)),
    ]


@driving("protocol.md#layers")
def endings_amid(subject: Subject) -> RequestRows:
    """Ending during an onset or fade: starts at the current amplitude, once.

    Begin an ending at the amplitude found, never restart it, and let a later fade shorten it but
    not prolong it.
    """
    subject.require_knots()
    exchange_time = min(subject.timing.exchange_time, 0.1)
    knots = 1 if subject.timing.slowness == 1 else math.ceil(exchange_time / 0.01)
    onset = subject.envelope(0.1, *[1.0] * knots)
    ending = subject.envelope(0.05, *[0.25] * knots)
    onset_middle = _middle(onset, knots)
    during_onset = Wait(onset_middle)
    during_ending = Wait(_middle(ending, knots))
    to_zero = layer(0, subject.tone(0, 0.0, onset=onset))  # a voice until its onset has ended
    to_zero_ending = layer(0, subject.tone(0, 0.0, onset=onset, ending=ending))
    timed = replace(to_zero_ending, valid_for=round(1000 * onset_middle))
    with_ending = subject.layer_0(subject.tone(ending=ending))
    continued = subject.layer_0(subject.tone(keep=True), ramp=subject.ramp + 75)
    slow_silence = send("Silence", ramp=min(500, subject.ramp_max))
    return [
        (to_zero_ending, during_onset, layer(0)),
        (to_zero_ending, _past_end(onset, knots), layer(0)),
        (timed,),
        (with_ending, layer(0), during_ending, layer(0)),
        (with_ending, layer(0), _past_end(ending, knots), layer(0)),
        (to_zero, during_onset, continued),
        (with_ending, layer(0), during_ending, slow_silence),
        (to_zero, during_onset, slow_silence),
    ]


def _middle(envelope: Envelope, knots: int) -> float:
    """Return a time [s] within an envelope with this number of knots."""
    return knots * envelope.step / _STEPS_PER_MS / 2000


def _past_end(envelope: Envelope, knots: int) -> Wait:
    """Wait until the end of an envelope with this number of knots."""
    return Wait((knots + 1) * envelope.step / _STEPS_PER_MS / 1000 + 0.02)


@driving("protocol.md#ramps-and-envelopes")
def extreme_envelopes(subject: Subject) -> RequestRows:
    """Envelope with the most knots, the shortest and the longest step: followed exactly.

    State only the knots and steps that you can play.
    """
    subject.require_knots()
    amplitudes = []
    for number in range(subject.can["knots"]):
        level = 0.2 + 0.8 * (number % 5) / 4
        amplitudes.append(level if number % 3 else -level)
    step_min = subject.can["envelope_step_min"] / 10_000
    step_max = subject.can["envelope_step_max"] / 10_000
    onsets = [
        subject.envelope(step_min, *amplitudes),
        subject.envelope(0.01, *amplitudes),
        subject.envelope(step_max, 1.0),
    ]
    return [[subject.layer_0(subject.tone(0, 0.5, onset=onset))] for onset in onsets]
