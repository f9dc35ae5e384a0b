"""Motions of ERAs' bases: from the voices of a channel, with the errors of the channel.

An imperfect ERA adds a second harmonic to each tone: at twice its frequency and phase, with an
amplitude that is a complex share of the tone's. Not modeled: sums and differences of several
tones, harmonics of signals, and other distortion.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from drivers.voices import Voice
from model.answer.answer import Layer
from model.transients.base_motion import BaseEnvelope, Motion, Term, along_lines, raised_cosine
from model.vibration import Excitation, Tone
from sim.amplifier.amplifier_clock import StraightClock
from sim.plant.imperfections import ChannelErrors


def motion_of(
    voices: Sequence[Voice], clock: StraightClock, *, stroke: float, delay: float = 0.0
) -> list[Term]:
    """Return the motion of a base due to its channel's voices; level 1 is the stroke [m].

    clock: amplifier clock for the angles; delay: of the base behind its voices [s].
    """
    motion: list[Term] = []
    for voice in voices:
        motion.extend(_voice_terms(voice, clock, stroke, delay))
    return motion


def _voice_terms(
    voice: Voice, clock: StraightClock, stroke: float, delay: float
) -> tuple[Term, ...]:
    """The terms of a base's motion due to one voice."""
    transition = voice.transition
    clock_omega = 2 * math.pi * voice.frequency
    omega = clock_omega * clock.pace
    phasor = stroke * cmath.exp(1j * clock_omega * clock.at(transition.start))
    start = transition.start + delay
    first = phasor * transition.first
    last = phasor * transition.last
    if not transition.knots:
        return raised_cosine(start, transition.step, omega, first, last)
    knots = [phasor * knot for knot in transition.knots]
    return along_lines(start, transition.step, omega, [first, *knots, last])


def realised(motion: Motion, errors: ChannelErrors) -> list[Term]:
    """Base motion with the gain and phase errors of its channel."""
    factor = errors.factor
    return [term._replace(c0=factor * term.c0, c1=factor * term.c1) for term in motion]


def harmonics_of_voices(voices: Sequence[Voice], share: complex) -> list[Voice]:
    """Second harmonics of the voices of a channel; empty for share 0."""
    if not share:
        return []
    harmonics = []
    for voice in voices:
        transition = voice.transition
        knots = tuple([_harmonic_phasor(knot, share) for knot in transition.knots])
        first = _harmonic_phasor(transition.first, share)
        last = _harmonic_phasor(transition.last, share)
        harmonic_transition = replace(transition, first=first, last=last, knots=knots)
        frequency = 2 * voice.frequency
        harmonics.append(replace(voice, frequency=frequency, transition=harmonic_transition))
    return harmonics


def harmonics_of_layer(layer: Layer, shares: Mapping[str, complex]) -> list[Layer]:
    """Second harmonics of a starting layer; shares: by ERA, empty if all are 0."""
    if not any(shares.values()):
        return []
    harmonics = []
    for voice in layer.voices:
        excitation = _harmonic_excitation(voice.excitation, shares)
        onset = voice.onset
        if onset:
            onset = _harmonic_onset(onset, shares)
        harmonics.append(replace(voice, excitation=excitation, onset=onset))
    return harmonics


def _harmonic_excitation(excitation: Excitation, shares: Mapping[str, complex]) -> dict[str, Tone]:
    """Second harmonics of the tones of ERAs."""
    tones = {}
    for name, tone in excitation.items():
        phasor = _harmonic_phasor(tone.phasor, shares[name])
        tones[name] = Tone.from_phasor(2 * tone.frequency, phasor)
    return tones


def _harmonic_onset(
    onset: Mapping[str, BaseEnvelope], shares: Mapping[str, complex]
) -> dict[str, BaseEnvelope]:
    """Second harmonics of the envelopes of ERAs."""
    envelopes = {}
    for name, envelope in onset.items():
        share = shares[name]
        start = _harmonic_phasor(envelope.start, share)
        knots = tuple([_harmonic_phasor(knot, share) for knot in envelope.knots])
        envelopes[name] = BaseEnvelope(2 * envelope.frequency, start, knots, envelope.step)
    return envelopes


def _harmonic_phasor(phasor: complex, share: complex) -> complex:
    """Phasor of a second harmonic: twice the phase, a share of the amplitude."""
    if not phasor:
        return 0j
    return share * phasor * phasor / abs(phasor)
