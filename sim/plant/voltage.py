"""Motion of an ERA's base by the voltage of its amplifier.

The square of a sum of sinusoids is a sum of sinusoids at the sums and differences of their
frequencies; each passes the actuator's response at its own frequency, a constant one that at the
lowest row. Not modelled: the actuator's transients beyond that, the force of a bias at rest, what
it does to stiffness, and how a base yields to the plate.
"""

import cmath
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations_with_replacement, pairwise

from model.transients.base_motion import Term
from registry.voltage import Law, VoltageDrive

_PARTS = 8  # of a product of two linear transitions, which is linear in none of them


def moved_by_voltage(voltage: Sequence[Term], drive: VoltageDrive, *, stroke: float) -> list[Term]:
    """Return the motion [m] of a base; voltage: about its bias, as shares of the full one."""
    terms: Iterable[Term] = voltage
    if drive.law is Law.QUADRATIC:
        terms = [*_scaled(voltage, 2 * drive.bias), *_square_of(voltage)]
    return [
        term._replace(c0=gain * term.c0, c1=gain * term.c1)
        for term in terms
        for gain in (stroke * drive.at(term.omega / (2 * cmath.pi)),)
        if term.c0 or term.c1
    ]


def _scaled(terms: Iterable[Term], factor: float) -> Iterator[Term]:
    return (term._replace(c0=factor * term.c0, c1=factor * term.c1) for term in terms)


def _square_of(terms: Sequence[Term]) -> Iterator[Term]:
    """Terms of the square of a sum: Im A Im B = Im[i/2 A conj(B)] - Im[i/2 A B]."""
    for one, other in combinations_with_replacement(terms, 2):
        twice = 1.0 if one is other else 2.0
        for start, end in _overlap(one, other):
            a, b = _amplitudes(one, start, end), _amplitudes(other, start, end)
            for values, omega, factor in (
                ([x * y.conjugate() for x, y in zip(a, b, strict=True)], -other.omega, 0.5j),
                ([x * y for x, y in zip(a, b, strict=True)], other.omega, -0.5j),
            ):
                first, last = values
                slope = (last - first) / (end - start) if last != first else 0j
                yield Term(
                    start,
                    end,
                    one.omega + omega,
                    twice * factor * first,
                    twice * factor * slope,
                )


def _overlap(one: Term, other: Term) -> Iterator[tuple[float, float]]:
    """Intervals in which both play; in parts where an amplitude changes."""
    start, end = max(one.start, other.start), min(one.end, other.end)
    if start >= end:
        return
    count = _PARTS if one.c1 or other.c1 else 1
    step = (end - start) / count
    bounds = [start, *(start + number * step for number in range(1, count)), end]
    yield from pairwise(bounds)


def _amplitudes(term: Term, start: float, end: float) -> tuple[complex, complex]:
    """Complex amplitudes at two times, both with the phase of the first."""
    factor = cmath.exp(1j * term.omega * (start - term.start))
    return (
        factor * (term.c0 + term.c1 * (start - term.start)),
        factor * (term.c0 + (term.c1 * (end - term.start) if term.c1 else 0j)),
    )
