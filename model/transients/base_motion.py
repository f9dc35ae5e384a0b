"""Motion of an ERA's base in parts for which the plate's equations are solved exactly."""

import cmath
import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


class Fade(NamedTuple):
    """y(t) = Im[gain(t) amplitude exp(i omega (t - start))] [m] from start [s] on.

    omega [rad/s]; amplitude [m], complex. The gain goes from gain_from to gain_to within ramp [s]
    along a raised cosine and stays there; a ramp of 0 is a jump.
    """

    start: float
    ramp: float
    omega: float
    amplitude: complex
    gain_from: float
    gain_to: float

    def terms(self) -> tuple[Term, ...]:
        """The same motion in terms: the raised cosine is three, at omega and omega +- pi / ramp."""
        settled = self.start + self.ramp
        fading: tuple[Term, ...] = ()
        if self.ramp > 0:
            mean = (self.gain_from + self.gain_to) / 2
            half_swing = (self.gain_from - self.gain_to) / 4 * self.amplitude
            side = math.pi / self.ramp
            fading = (
                Term(self.start, settled, self.omega, mean * self.amplitude),
                Term(self.start, settled, self.omega + side, half_swing),
                Term(self.start, settled, self.omega - side, half_swing),
            )
        if not self.gain_to > 0:
            return fading
        lasting = self.gain_to * self.amplitude * cmath.exp(1j * self.omega * self.ramp)
        return (*fading, Term(settled, math.inf, self.omega, lasting))


Motion: TypeAlias = Sequence[Term | Fade]
"""The motion of a base, the sum of its parts."""


class BaseMotions:
    """Sets of motions of all ERAs' bases, in terms that ascend in omega.

    sets: in each the motion of each base. number, era (n,): set and base of each term; start, end
    [s], omega, c0, c1 (n,): those of the terms, c1 None for 0. Terms that end by `since` [s] are
    left out.
    """

    def __init__(self, *sets: Sequence[Motion], since: float = -math.inf) -> None:
        terms: list[tuple[complex, ...]] = []
        fades: list[tuple[complex, ...]] = []
        for number, motions in enumerate(sets):
            for era, motion in enumerate(motions):
                for part in motion:
                    if isinstance(part, Term):
                        terms.append((number, era, *part))
                    elif part.gain_to or part.start + part.ramp > since:
                        fades.append((number, era, *part))
        *reals, c0, c1 = zip(*terms, strict=True) if terms else ((),) * 7
        columns, amplitude = np.array(reals, dtype=float), np.array(c0, dtype=complex)
        if fades:
            added, faded = _terms_of_fades(fades)
            columns = np.concatenate([columns, added], axis=1)
            amplitude = np.concatenate([amplitude, faded])
        self._moments: dict[int, list[float]] = {}
        order = np.argsort(columns[4], kind="stable")
        order = order[columns[3][order] > since]
        number, era, self.start, self.end, self.omega = columns[:, order]
        self.number, self.era = number.astype(np.intp), era.astype(np.intp)
        self.c0: ComplexArray = amplitude[order]
        self.c1: ComplexArray | None = None
        if any(c1):
            growth = np.zeros(len(amplitude), dtype=complex)
            growth[: len(c1)] = c1
            self.c1 = growth[order]

    def moments(self, number: int, since: float, until: float) -> list[float]:
        """When terms of a set start or end, after a time [s] and up to another, ascending."""
        moments = self._moments.get(number)
        if moments is None:
            is_of_set = self.number == number
            each = self.start[is_of_set].tolist() + self.end[is_of_set].tolist()
            moments = self._moments[number] = sorted({*each})
        return moments[bisect_right(moments, since) : bisect_right(moments, until)]

    def active(self, numbers: ArrayLike, times: ArrayLike) -> NDArray[np.bool_]:
        """Whether each term moves its base (k, n), if sets (k,) play at times (k,) [s]."""
        now = np.asarray(times)[:, None]
        is_of_set = self.number == np.asarray(numbers)[:, None]
        return np.asarray(is_of_set & (self.start <= now) & (now < self.end))


def _terms_of_fades(fades: Sequence[tuple[complex, ...]]) -> tuple[FloatArray, ComplexArray]:
    """Number of the set, ERA, start, end and omega (5, n) of the terms of fades, and c0 (n,)."""
    number, era, start, ramp, omega, amplitude, gain_from, gain_to = zip(*fades, strict=True)
    reals = np.array([number, era, start, ramp, omega, gain_from, gain_to], dtype=float)
    amplitudes = np.array(amplitude, dtype=complex)
    is_ramped, is_lasting = reals[3] > 0, reals[6] > 0
    ramped, lasting = reals[:, is_ramped], reals[:, is_lasting]
    count = ramped.shape[1]
    columns = np.empty((5, 3 * count + lasting.shape[1]))
    c0 = np.empty(columns.shape[1], dtype=complex)
    start, ramp, omega, gain_from, gain_to = ramped[2:]
    side = math.pi / ramp
    fading, swings = columns[:, : 3 * count].reshape(5, 3, count), c0[: 3 * count].reshape(3, count)
    fading[:3], fading[3] = ramped[:3, None], start + ramp
    fading[4] = omega, omega + side, omega - side
    swings[0] = (gain_from + gain_to) / 2 * amplitudes[is_ramped]
    swings[1:] = (gain_from - gain_to) / 4 * amplitudes[is_ramped]
    start, ramp, omega, _, gain_to = lasting[2:]
    settled = columns[:, 3 * count :]
    settled[:2], settled[2], settled[3], settled[4] = lasting[:2], start + ramp, math.inf, omega
    c0[3 * count :] = gain_to * amplitudes[is_lasting] * np.exp(1j * omega * ramp)
    return columns, c0
