"""Motion of an ERA's base in terms for which the plate's equations are solved exactly."""

import cmath
import math
from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray


class Term(NamedTuple):
    """y(t) = Im[(c0 + c1 (t - start)) exp(i omega (t - start))] [m] while start <= t < end [s].

    omega [rad/s]; c0 [m]; c1 [m/s]. The base moves as the sum of its terms; outside them it rests.
    """

    start: float
    end: float
    omega: float
    c0: complex
    c1: complex = 0j


def fade(
    amplitude: complex, *, omega: float, start: float, ramp: float, gains: tuple[float, float]
) -> tuple[Term, ...]:
    """Terms of a tone whose gain goes from the first to the second along a raised cosine.

    amplitude: complex [m], its phase that at start; omega [rad/s]; start, ramp [s]. The raised
    cosine is three exponentials: at omega and at omega +- pi / ramp; a ramp of 0 is a jump.
    """
    gain_from, gain_to = gains
    settled = start + ramp
    fading: tuple[Term, ...] = ()
    if ramp > 0:
        mean = (gain_from + gain_to) / 2
        half_swing = (gain_from - gain_to) / 4 * amplitude
        side = math.pi / ramp
        fading = (
            Term(start, settled, omega, mean * amplitude),
            Term(start, settled, omega + side, half_swing),
            Term(start, settled, omega - side, half_swing),
        )
    if not gain_to > 0:
        return fading
    lasting = gain_to * amplitude * cmath.exp(1j * omega * ramp)
    return (*fading, Term(settled, math.inf, omega, lasting))


class BaseMotions:
    """The motions of several ERAs' bases from a time [s] on: their terms, ascending in omega.

    terms: of each ERA. era (n,): whose base each term moves; start, end [s], omega, c0, c1 (n,):
    those of the terms, c1 None for 0; moments: their starts and ends [s], ascending, each once.
    """

    def __init__(self, terms: Sequence[Sequence[Term]], *, since: float = -math.inf) -> None:
        columns = zip(*chain.from_iterable(terms), strict=True)
        start, end, omega, c0, c1 = columns if any(terms) else ((),) * 5
        ends, omegas = np.array(end, dtype=float), np.array(omega, dtype=float)
        order = np.argsort(omegas, kind="stable")
        if ends.min(initial=math.inf) <= since:
            order = order[ends[order] > since]
        self.start: FloatArray = np.array(start, dtype=float)[order]
        self.end: FloatArray = ends[order]
        self.omega: FloatArray = omegas[order]
        self.c0: ComplexArray = np.array(c0, dtype=complex)[order]
        self.c1: ComplexArray | None = np.array(c1, dtype=complex)[order] if any(c1) else None
        self.era = np.repeat(np.arange(len(terms)), [len(each) for each in terms])[order]
        self.moments: list[float] = sorted({*start, *end})

    def active(self, time: float) -> NDArray[np.intp]:
        """Numbers of the terms that move their bases at a time [s]."""
        return np.flatnonzero((self.start <= time) & (time < self.end))
