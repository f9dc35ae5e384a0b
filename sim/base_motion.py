"""How the base of an ERA moves when its channel plays a tone."""

import cmath
import math

from model.base_motion import Term, fade
from sim.waveform import FadingTone


def terms_of(tone: FadingTone, *, stroke: float) -> tuple[Term, ...]:
    """The base motion of an ERA with this stroke [m] whose channel plays the tone."""
    omega = 2 * math.pi * tone.frequency
    turn = cmath.exp(1j * (tone.phase + omega * (tone.start - tone.origin)))
    return fade(
        stroke * tone.level * turn,
        omega=omega,
        start=tone.start,
        ramp=tone.ramp,
        gains=(tone.gain_from, tone.gain_to),
    )
