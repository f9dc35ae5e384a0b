"""Base motion of an ERA whose channel plays a tone."""

import cmath
import math
from itertools import pairwise

from model.transients.base_motion import Term, fade
from sim.waveform.fading_tone import FadingTone
from sim.waveform.shaped_tone import ShapedTone


def terms_of(tone: FadingTone | ShapedTone, *, stroke: float) -> tuple[Term, ...]:
    """Base motion of an ERA with this stroke [m] while its channel plays the tone."""
    omega = 2 * math.pi * tone.frequency
    if isinstance(tone, ShapedTone):
        return _along_knots(tone, omega, stroke)
    phase_factor = cmath.exp(1j * omega * (tone.start - tone.origin))
    return fade(
        stroke * tone.full * phase_factor,
        omega=omega,
        start=tone.start,
        ramp=tone.ramp,
        gains=(tone.gain_from, tone.gain_to),
    )


def _along_knots(tone: ShapedTone, omega: float, stroke: float) -> tuple[Term, ...]:
    """Terms of linearly varying complex amplitude, solved exactly."""
    terms = []
    for number, (here, there) in enumerate(pairwise(tone.values)):
        since = tone.start + number * tone.step
        phase_factor = stroke * cmath.exp(1j * omega * (since - tone.origin))
        slope = (there - here) / tone.step
        terms.append(
            Term(since, since + tone.step, omega, here * phase_factor, slope * phase_factor)
        )
    if tone.lasts:
        phase_factor = stroke * cmath.exp(1j * omega * (tone.settled - tone.origin))
        terms.append(Term(tone.settled, math.inf, omega, tone.values[-1] * phase_factor))
    return tuple(terms)
