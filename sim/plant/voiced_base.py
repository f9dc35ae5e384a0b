"""Motion of an ERA's base by the voices of its channel, in terms for the plate in time."""

import cmath
import math
from collections.abc import Sequence

from drivers.playing.playback import Voice
from model.transients.base_motion import Term, along_lines, raised_cosine
from sim.amplifier.readings import StraightClock


def motion_of(
    voices: Sequence[Voice], clock: StraightClock, *, stroke: float, delay: float = 0.0
) -> list[Term]:
    """Return the motion of a base by the voices of its channel, level 1 being the stroke [m].

    clock: of the amplifier, on which angles count; delay [s]: of the base behind its voices.
    """
    return [term for voice in voices for term in _terms(voice, clock, stroke, delay)]


def _terms(voice: Voice, clock: StraightClock, stroke: float, delay: float) -> tuple[Term, ...]:
    way, omega = voice.transition, 2 * math.pi * voice.frequency
    factor = stroke * cmath.exp(1j * omega * clock.at(way.start))
    start, omega = way.start + delay, omega * clock.pace
    if not way.knots:
        return raised_cosine(start, way.step, omega, factor * way.first, factor * way.last)
    values = [factor * value for value in (way.first, *way.knots, way.last)]
    return along_lines(start, way.step, omega, values)
