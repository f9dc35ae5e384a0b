"""Motion of an ERA's base by the voices of its channel, in terms for the plate in time."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.playing.playback import Voice
from model.transients.base_motion import Term, along_lines, raised_cosine


def motion_of(voices: Sequence[Voice], *, stroke: float) -> list[Term]:
    """Return the motion of a base by the voices of its channel, level 1 being the stroke [m]."""
    return [term for voice in voices for term in _terms(voice, stroke)]


def _terms(voice: Voice, stroke: float) -> tuple[Term, ...]:
    way, omega = voice.transition, 2 * math.pi * voice.frequency
    factor = stroke * cmath.exp(1j * omega * (way.start - voice.origin))
    if not way.knots:
        return raised_cosine(way.start, way.step, omega, factor * way.first, factor * way.last)
    values = [factor * value for value in (way.first, *way.knots, way.last)]
    return along_lines(way.start, way.step, omega, values)


def delayed(voices: Sequence[Voice], delay: float) -> tuple[Voice, ...]:
    """Return the voices of a channel, delayed [s]."""
    return tuple(
        replace(
            voice,
            origin=voice.origin + delay,
            transition=replace(
                voice.transition,
                start=voice.transition.start + delay,
                end=voice.transition.end + delay,
            ),
        )
        for voice in voices
    )
