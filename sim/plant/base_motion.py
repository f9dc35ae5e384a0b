"""How the base of an ERA moves when its channel plays a tone."""

import cmath
import math
from itertools import pairwise

from model.transients.base_motion import Term, fade
from sim.waveform.fading_tone import FadingTone
from sim.waveform.shaped_tone import ShapedTone


def terms_of(tone: FadingTone | ShapedTone, *, stroke: float) -> tuple[Term, ...]:
    """The base motion of an ERA with this stroke [m] whose channel plays the tone."""
    omega = 2 * math.pi * tone.frequency
    if isinstance(tone, ShapedTone):
        return _along_knots(tone, omega, stroke)
    turn = cmath.exp(1j * omega * (tone.start - tone.origin))
    return fade(
        stroke * tone.full * turn,
        omega=omega,
        start=tone.start,
        ramp=tone.ramp,
        gains=(tone.gain_from, tone.gain_to),
    )


def _along_knots(tone: ShapedTone, omega: float, stroke: float) -> tuple[Term, ...]:
    """Straight lines in the complex amplitude, which the plate is solved for exactly."""
    terms = []
    for number, (here, there) in enumerate(pairwise(tone.values)):
        since = tone.start + number * tone.step
        turn = stroke * cmath.exp(1j * omega * (since - tone.origin))
        slope = (there - here) / tone.step
        terms.append(Term(since, since + tone.step, omega, here * turn, slope * turn))
    if tone.lasts:
        turn = stroke * cmath.exp(1j * omega * (tone.settled - tone.origin))
        terms.append(Term(tone.settled, math.inf, omega, tone.values[-1] * turn))
    return tuple(terms)
