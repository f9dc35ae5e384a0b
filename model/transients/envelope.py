"""Envelopes: complex amplitudes of an ERA's base from one steady state to another.

The drive stays a sinusoid at its frequency; its complex amplitude is linear between knots a fixed
step apart. Amplifiers with envelopes play exactly that.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.actuator import Era
from model.transients.base_motion import Term, along_lines, raised_cosine
from model.vibration.excitation import Excitation

KNOT_STEP = 0.005
"""Time between knots [s]; five fit into the shortest decay of a plate that needs shaped endings."""

MAX_KNOTS = 32
"""More than any amplifier accepts."""


@dataclass(frozen=True)
class BaseEnvelope:
    """Motion of an ERA's base, y(t) = Im[a(t) exp(2 pi i f t)] [m], with a(t) linear between knots.

    a is `start` [m] at time 0, knots[k] [m] after k + 1 steps [s], and constant after the last
    knot. frequency f [Hz]. The last knot is the final amplitude, unlike in the amplifier's
    `drivers.command.Envelope`, where the command is.
    """

    frequency: float
    start: complex
    knots: tuple[complex, ...]
    step: float = KNOT_STEP

    def __post_init__(self) -> None:
        """Refuse envelopes that no amplifier can play."""
        if not 1 <= len(self.knots) <= MAX_KNOTS:
            raise InputError(f"envelope: knots must be 1 to {MAX_KNOTS}, got {len(self.knots)}")
        if not all(cmath.isfinite(value) for value in (self.start, *self.knots)):
            raise InputError("envelope: knots must be finite numbers")
        if not (0 < self.step < math.inf and 0 < self.frequency < math.inf):
            raise InputError(
                f"envelope: frequency and step must be above zero, got {self.frequency:g} Hz and "
                f"{self.step:g} s"
            )

    @property
    def duration(self) -> float:
        """Time of the last knot [s]."""
        return self.step * len(self.knots)

    @property
    def largest(self) -> float:
        """The largest amplitude [m]."""
        return max(abs(value) for value in (self.start, *self.knots))

    def amplitude(self, times: FloatArray) -> ComplexArray:
        """Complex amplitude a [m] at times [s] (n,)."""
        values = np.array([self.start, *self.knots])
        moments = self.step * np.arange(len(values))
        return np.asarray(np.interp(times, moments, values))

    def terms(self) -> tuple[Term, ...]:
        """Motion of the base from time 0 on."""
        omega = 2 * math.pi * self.frequency
        return along_lines(0.0, self.step, omega, (self.start, *self.knots))


Envelopes: TypeAlias = Mapping[str, BaseEnvelope]
"""An envelope per ERA, by the ERA's name."""

Bases: TypeAlias = tuple[tuple[Term, ...], ...]
"""Motion of every base of a rig, in the order of its ERAs."""


def ramped_onset(excitation: Excitation, eras: Sequence[Era], *, ramp: float) -> Bases:
    """Motion of the bases when an excitation starts at time 0 along a raised cosine of ramp [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(0.0, 1.0))


def ramped_ending(excitation: Excitation, eras: Sequence[Era], *, ramp: float) -> Bases:
    """Motion of the bases when an excitation ends at time 0 along a raised cosine of ramp [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(1.0, 0.0))


def ramped_pulse(
    excitation: Excitation, eras: Sequence[Era], *, ramp: float, duration: float
) -> Bases:
    """Motion of the bases when an excitation starts at time 0 and ends after a duration [s].

    Both along a raised cosine of ramp [s], at most the duration.
    """
    ramp = min(ramp, duration)
    onset = ramped_onset(excitation, eras, ramp=ramp)
    release: list[tuple[Term, ...]] = []
    for era in eras:
        tone = excitation.get(era.name)
        if tone is None:
            release.append(())
            continue
        # What rises from the end on is the tone itself, in opposite phase.
        omega = 2 * math.pi * tone.frequency
        opposite = -tone.phasor * cmath.exp(1j * omega * duration)
        release.append(raised_cosine(duration, ramp, omega, 0j, opposite))
    return tuple((*rise, *fall) for rise, fall in zip(onset, release, strict=True))


def shaped(envelopes: Envelopes, eras: Sequence[Era]) -> Bases:
    """Motion of the bases when envelopes begin at time 0."""
    return tuple(envelopes[era.name].terms() if era.name in envelopes else () for era in eras)


def _faded(
    excitation: Excitation, eras: Sequence[Era], *, ramp: float, gains: tuple[float, float]
) -> Bases:
    return tuple(
        raised_cosine(
            0.0, ramp, 2 * math.pi * tone.frequency, *(gain * tone.phasor for gain in gains)
        )
        if (tone := excitation.get(era.name))
        else ()
        for era in eras
    )
