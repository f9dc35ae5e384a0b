"""Motion of an ERA's base in parts for which the plate's equations are solved exactly.

Envelopes are complex amplitudes of a base from one steady state to another: the drive stays a
sinusoid at its frequency; its complex amplitude is linear between knots a fixed step apart.
Amplifiers with envelopes play exactly that.
"""

import cmath
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import ComplexArray, FloatArray
from model.structure.sources import Source
from model.vibration import Excitation


class Term(NamedTuple):
    """A part of a base's motion, y(t) = Im[(c0 + c1 tau) exp(i omega tau)] [m], tau = t - start.

    While start <= t < end [s]; omega [rad/s]; c0 [m]; c1 [m/s]. A base moves as the sum of its
    terms and rests outside them.
    """

    start: float
    end: float
    omega: float
    c0: complex
    c1: complex = 0j


Motion: TypeAlias = Sequence[Term]
"""The motion of a base, the sum of its terms."""


def rise(times: FloatArray, ramp: float) -> FloatArray:
    """Return a raised cosine at times (n,) [s], from 0 at time 0 to 1 at the end of a ramp [s]."""
    return (1 - np.cos(np.pi * np.clip(times / ramp, 0, 1))) / 2


def raised_cosine(
    start: float, ramp: float, omega: float, first: complex, last: complex
) -> tuple[Term, ...]:
    """Return the terms of Im[a(t) exp(i omega (t - start))] from start [s] on, omega [rad/s].

    a goes from first to last [m] within ramp [s] along a raised cosine, which has three terms, at
    omega and omega +- pi / ramp, and stays there; a ramp of 0 is a jump.
    """
    settled = start + ramp
    fading: tuple[Term, ...] = ()
    if ramp > 0:
        side, half_swing = math.pi / ramp, (first - last) / 4
        fading = (
            Term(start, settled, omega, (first + last) / 2),
            Term(start, settled, omega + side, half_swing),
            Term(start, settled, omega - side, half_swing),
        )
    if last == 0:
        return fading
    return (*fading, Term(settled, math.inf, omega, last * cmath.exp(1j * omega * ramp)))


def along_lines(
    start: float, step: float, omega: float, values: Sequence[complex]
) -> tuple[Term, ...]:
    """Return the terms of Im[a(t) exp(i omega (t - start))] from start [s] on, omega [rad/s].

    a goes through values [m], one every step [s], along straight lines, and stays at the last.
    """
    # Computed once: rounded differently, ends and starts would overlap or leave samples out.
    moments = [start + number * step for number in range(len(values))]
    factors = [cmath.exp(1j * omega * number * step) for number in range(len(values))]
    terms = list[Term]()
    for number, (value, next_value) in enumerate(pairwise(values)):
        factor = factors[number]
        slope = factor * (next_value - value) / step
        terms.append(Term(moments[number], moments[number + 1], omega, factor * value, slope))
    if values[-1] != 0:
        terms.append(Term(moments[-1], math.inf, omega, factors[-1] * values[-1]))
    return tuple(terms)


class BaseMotions:
    """Sets of motions of all ERAs' bases, as arrays over their terms, ascending in omega.

    number, era (n,): set and base of each term; start, end [s], omega [rad/s], c0, c1 (n,): see
    `Term`, c1 None if all are 0.
    """

    def __init__(self, *sets: Sequence[Motion], since: float = -math.inf) -> None:
        """Collect the terms of sets, each with the motion of every base, that end after `since`."""
        terms = list[Term]()
        bases = list[tuple[int, int]]()
        for number, motions in enumerate(sets):
            for era, motion in enumerate(motions):
                lasting = [term for term in motion if term.end > since]
                terms += lasting
                bases += [(number, era)] * len(lasting)
        order = np.argsort([term.omega for term in terms], kind="stable").astype(np.intp)
        self._moments: dict[int, list[float]] = {}
        self.number, self.era = np.array(bases, dtype=np.intp).reshape(-1, 2)[order].T
        times = np.array([term[:3] for term in terms], dtype=float).reshape(-1, 3)
        self.start, self.end, self.omega = times[order].T
        self.c0: ComplexArray = np.array([term.c0 for term in terms], dtype=complex)[order]
        self.c1: ComplexArray | None = None
        if any(term.c1 for term in terms):
            self.c1 = np.array([term.c1 for term in terms], dtype=complex)[order]

    def moments(self, number: int, since: float, until: float) -> list[float]:
        """Times [s] after since and up to until at which terms of a set start or end, ascending."""
        moments = self._moments.get(number)
        if moments is None:
            is_of_set = self.number == number
            moments = sorted({*self.start[is_of_set].tolist(), *self.end[is_of_set].tolist()})
            self._moments[number] = moments
        return moments[bisect_right(moments, since) : bisect_right(moments, until)]

    def active(self, numbers: ArrayLike, times: ArrayLike) -> NDArray[np.bool_]:
        """Mask (k, n) of the terms that move their bases, if sets (k,) play at times (k,) [s]."""
        now = np.asarray(times)[:, None]
        is_of_set = self.number == np.asarray(numbers)[:, None]
        return np.asarray(is_of_set & (self.start <= now) & (now < self.end))


KNOT_STEP = 0.005
"""Time between knots [s]; five fit into the shortest decay of a plate that needs shaped endings."""


@dataclass(frozen=True)
class BaseEnvelope:
    """Motion of an ERA's base, y(t) = Im[a(t) exp(2 pi i f t)] [m], with a(t) linear between knots.

    The last knot is the final amplitude, unlike in the amplifiers' envelopes, where the command is.
    """

    frequency: float
    """f [Hz]."""
    start: complex
    """a [m] at time 0."""
    knots: tuple[complex, ...]
    """a [m] after 1, 2, ... steps; constant after the last."""
    step: float = KNOT_STEP
    """Time between knots [s]."""

    @property
    def duration(self) -> float:
        """Time of the last knot [s]."""
        return self.step * len(self.knots)

    @property
    def largest(self) -> float:
        """The largest amplitude [m]."""
        return max(map(abs, (self.start, *self.knots)))

    def scaled(self, factor: float) -> "BaseEnvelope":
        """Return the envelope with all amplitudes multiplied by a factor."""
        knots = tuple([factor * knot for knot in self.knots])
        return replace(self, start=factor * self.start, knots=knots)

    def amplitude(self, times: FloatArray) -> ComplexArray:
        """Complex amplitude a [m] at times [s] (n,)."""
        values = np.array([self.start, *self.knots])
        moments = self.step * np.arange(len(values))
        return np.asarray(np.interp(times, moments, values))

    def terms(self) -> tuple[Term, ...]:
        """Return the motion of the base from time 0 on."""
        omega = 2 * math.pi * self.frequency
        return along_lines(0.0, self.step, omega, (self.start, *self.knots))


Envelopes: TypeAlias = Mapping[str, BaseEnvelope]
"""An envelope per ERA, by the ERA's name."""

Bases: TypeAlias = tuple[tuple[Term, ...], ...]
"""Motion of every base of a rig, in the order of its ERAs."""


def ramped_onset(excitation: Excitation, eras: Sequence[Source], *, ramp: float) -> Bases:
    """Return the bases' motion if an excitation starts at time 0 along a raised cosine [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(0.0, 1.0))


def ramped_ending(excitation: Excitation, eras: Sequence[Source], *, ramp: float) -> Bases:
    """Return the bases' motion if an excitation ends at time 0 along a raised cosine [s]."""
    return _faded(excitation, eras, ramp=ramp, gains=(1.0, 0.0))


def ramped_pulse(
    excitation: Excitation, eras: Sequence[Source], *, ramp: float, duration: float
) -> Bases:
    """Return the bases' motion if an excitation starts at time 0 and ends after a duration [s].

    Both along a raised cosine of ramp [s], which is limited to the duration.
    """
    ramp = min(ramp, duration)
    onset = ramped_onset(excitation, eras, ramp=ramp)
    # From the end on the tone rises in opposite phase.
    release = _faded(excitation, eras, ramp=ramp, gains=(0.0, -1.0), start=duration)
    return tuple((*rise, *fall) for rise, fall in zip(onset, release, strict=True))


def shaped(envelopes: Envelopes, eras: Sequence[Source]) -> Bases:
    """Return the bases' motion if envelopes begin at time 0."""
    return tuple(envelopes[era.name].terms() if era.name in envelopes else () for era in eras)


def _faded(
    excitation: Excitation,
    eras: Sequence[Source],
    *,
    ramp: float,
    gains: tuple[float, float],
    start: float = 0.0,
) -> Bases:
    """Return the bases' motion from one gain of an excitation to another, from start [s] on."""
    bases = list[tuple[Term, ...]]()
    for era in eras:
        tone = excitation.get(era.name)
        if tone is None:
            bases.append(())
            continue
        omega = 2 * math.pi * tone.frequency
        phasor = tone.phasor * cmath.exp(1j * omega * start)
        first, last = gains
        bases.append(raised_cosine(start, ramp, omega, first * phasor, last * phasor))
    return tuple(bases)
