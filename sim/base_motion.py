"""How the base of an ERA moves, in pieces that the plate's equations can be solved for exactly."""

import cmath
import math
from dataclasses import dataclass

from sim.waveform import FadingTone


@dataclass(frozen=True, slots=True)
class Term:
    """y(t) = Im[(c0 + c1 (t - start)) exp(i omega (t - start))] [m] while start <= t < end [s].

    omega [rad/s]; c0 [m]; c1 [m/s]. The base moves as the sum of its terms; outside them it rests.
    """

    start: float
    end: float
    omega: float
    c0: complex
    c1: complex = 0j


def terms_of(tone: FadingTone, *, stroke: float) -> tuple[Term, ...]:
    """The base motion of an ERA with this stroke [m] whose channel plays the tone.

    The raised cosine of a fade is three exponentials: at omega and at omega +- pi / ramp.
    """
    omega = 2 * math.pi * tone.frequency
    amplitude = stroke * tone.level
    at_start = amplitude * cmath.exp(1j * (tone.phase + omega * (tone.start - tone.origin)))
    terms = []
    if tone.ramp > 0:
        mean = (tone.gain_from + tone.gain_to) / 2
        swing = (tone.gain_to - tone.gain_from) / 2
        side = math.pi / tone.ramp
        terms += [
            Term(tone.start, tone.settled, omega, mean * at_start),
            Term(tone.start, tone.settled, omega + side, -swing / 2 * at_start),
            Term(tone.start, tone.settled, omega - side, -swing / 2 * at_start),
        ]
    if tone.gain_to > 0:
        at_settled = at_start * cmath.exp(1j * omega * tone.ramp)
        terms.append(Term(tone.settled, math.inf, omega, tone.gain_to * at_settled))
    return tuple(terms)
