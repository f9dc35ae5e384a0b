"""Motion of an ERA's base in terms for which the plate's equations are solved exactly."""

import cmath
import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Term:
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
    terms = []
    settled = start + ramp
    if ramp > 0:
        mean = (gain_from + gain_to) / 2
        swing = (gain_to - gain_from) / 2
        side = math.pi / ramp
        terms += [
            Term(start, settled, omega, mean * amplitude),
            Term(start, settled, omega + side, -swing / 2 * amplitude),
            Term(start, settled, omega - side, -swing / 2 * amplitude),
        ]
    if gain_to > 0:
        terms.append(
            Term(settled, math.inf, omega, gain_to * amplitude * cmath.exp(1j * omega * ramp))
        )
    return tuple(terms)
