"""Envelopes: how the complex amplitude of an ERA's base goes from one steady state to another.

The drive stays a sinusoid at its frequency; level and phase follow knots a fixed step apart, linear
between them in the complex amplitude. That is what an amplifier with envelopes plays.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.actuator import Era
from model.transients.base_motion import Term, fade
from model.vibration.excitation import Excitation

KNOT_STEP = 0.005
"""Time between knots [s]; five of them fit into the shortest ring of a plate worth braking."""

MOST_KNOTS = 32
"""More than an amplifier takes."""


@dataclass(frozen=True)
class Envelope:
    """y(t) = Im[a(t) exp(2 pi i f t)] [m], with a(t) linear between knots.

    a is `start` [m] at time 0, knots[k] [m] after k + 1 steps [s], and what the last knot says from
    then on. frequency f [Hz].
    """

    frequency: float
    start: complex
    knots: tuple[complex, ...]
    step: float = KNOT_STEP

    def __post_init__(self) -> None:
        """Refuse envelopes that no amplifier could play."""
        if not 1 <= len(self.knots) <= MOST_KNOTS:
            raise InputError(
                f"an envelope has {len(self.knots)} knots; 1 to {MOST_KNOTS} are possible"
            )
        if not all(cmath.isfinite(value) for value in (self.start, *self.knots)):
            raise InputError("an envelope has a knot that is no number")
        if not (0 < self.step < math.inf and 0 < self.frequency < math.inf):
            raise InputError(
                f"an envelope of {self.frequency:g} Hz in steps of {self.step:g} s; both must be "
                "above zero"
            )

    @property
    def duration(self) -> float:
        """How long it takes to its last knot [s]."""
        return self.step * len(self.knots)

    @property
    def largest(self) -> float:
        """The largest amplitude [m] that it ever has."""
        return max(abs(value) for value in (self.start, *self.knots))

    def amplitude(self, times: FloatArray) -> ComplexArray:
        """a at times [s] (n,)."""
        values = np.array([self.start, *self.knots])
        moments = self.step * np.arange(len(values))
        return np.asarray(np.interp(times, moments, values))

    def terms(self) -> tuple[Term, ...]:
        """The motion of the base from time 0 on."""
        omega = 2 * math.pi * self.frequency
        values = (self.start, *self.knots)
        pieces = []
        for number, (here, there) in enumerate(pairwise(values)):
            since, until = number * self.step, (number + 1) * self.step
            turn = cmath.exp(1j * omega * since)
            slope = (there - here) / self.step
            pieces.append(Term(since, until, omega, here * turn, slope * turn))
        if self.knots[-1] != 0:
            last = self.knots[-1] * cmath.exp(1j * omega * self.duration)
            pieces.append(Term(self.duration, math.inf, omega, last))
        return tuple(pieces)


Envelopes: TypeAlias = Mapping[str, Envelope]
"""An envelope per ERA, by the ERA's name."""

Bases: TypeAlias = tuple[tuple[Term, ...], ...]
"""How every base of a rig moves, in the order of its ERAs."""


def ramped_onset(excitation: Excitation, eras: Sequence[Era], *, ramp: float) -> Bases:
    """The bases when an excitation starts at time 0 along a raised cosine of ramp [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(0.0, 1.0))


def ramped_ending(excitation: Excitation, eras: Sequence[Era], *, ramp: float) -> Bases:
    """The bases when an excitation ends from time 0 on along a raised cosine of ramp [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(1.0, 0.0))


def shaped(envelopes: Envelopes, eras: Sequence[Era]) -> Bases:
    """The bases when envelopes begin at time 0."""
    return tuple(envelopes[era.name].terms() if era.name in envelopes else () for era in eras)


def _faded(
    excitation: Excitation, eras: Sequence[Era], *, ramp: float, gains: tuple[float, float]
) -> Bases:
    return tuple(
        fade(
            tone.phasor,
            omega=2 * math.pi * tone.frequency,
            start=0.0,
            ramp=ramp,
            gains=gains,
        )
        if (tone := excitation.get(era.name))
        else ()
        for era in eras
    )
