"""How the amplitude of a tone gets from one value to another: a pure function of time.

Amplitudes are complex, in full levels; times [s] are of any one clock.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivers.protocol.sets import Command, Envelope
from drivers.protocol.table import QUANTITIES

_STEP = QUANTITIES["envelope_step"]
_PER_FULL, _PER_DEGREE = QUANTITIES["level"].per_unit, QUANTITIES["phase"].per_unit


def amplitude_of(level: int, phase: int) -> complex:
    """Return the complex amplitude in full levels of a level and phase of the wire."""
    return cmath.rect(level / _PER_FULL, math.radians(phase / _PER_DEGREE))


def amplitudes_of(envelope: Envelope | None) -> tuple[complex, ...]:
    """Return the complex amplitudes of the knots of an envelope in full levels, if there is one."""
    if envelope is None:
        return ()
    return tuple([amplitude_of(*knot) for knot in envelope.knots])


@dataclass(slots=True)  # frozen, each takes three times as long to make, and every set makes many
class Transition:
    """From one complex amplitude to another, from start [s] on until end.

    Along straight lines through knots a step [s] apart, or without knots along a raised cosine that
    lasts one step; a step of 0 changes at once.
    """

    start: float
    step: float
    first: complex
    last: complex
    end: float
    knots: tuple[complex, ...] = ()

    def at(self, time: float) -> complex:
        """Return the amplitude at a time [s], before start the first one."""
        if time >= self.end:
            return self.last
        if time <= self.start:
            return self.first
        steps = (time - self.start) / self.step
        if not self.knots:
            return self.first + (self.last - self.first) * (1 - math.cos(math.pi * steps)) / 2
        points = (self.first, *self.knots, self.last)
        index = int(steps)
        return points[index] + (points[index + 1] - points[index]) * (steps - index)

    def reached(self, time: float, uncertainty: float) -> complex:
        """Return the amplitude at a time, or the largest within an uncertainty [s] around it."""
        if time - uncertainty >= self.end:
            return self.last
        if not uncertainty:
            return self.at(time)
        since, until = max(time - uncertainty, self.start), max(time + uncertainty, self.start)
        moments = (self.start + self.step * (index + 1) for index in range(len(self.knots)))
        between = [
            knot for moment, knot in zip(moments, self.knots, strict=True) if since < moment < until
        ]
        return max((self.at(since), *between, self.at(until)), key=abs)

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on."""
        passed = math.floor((time - self.start) / self.step) if self.step else len(self.knots)
        points = (self.at(time), self.last, *self.knots[max(passed, 0) :])
        return max(map(abs, points))

    def slope(self, time: float) -> float:
        """Return the steepest change [full levels/s] from a time on; infinite for a jump."""
        if time >= self.end and (time > self.end or self.step):
            return 0.0
        points = (self.first, *self.knots, self.last)
        passed = int((time - self.start) / self.step) if self.knots else 0
        return steepest(points[passed:], self.step, is_cosine=not self.knots)[1]


def along(envelope: Envelope, time: float, first: complex, last: complex) -> Transition:
    """Return a transition along an envelope, from a time [s] on."""
    step = _STEP.from_wire(envelope.step)
    end = time + step * (len(envelope.knots) + 1)
    return Transition(time, step, first, last, end, amplitudes_of(envelope))


def towards(command: Command, time: float, ramp: float, first: complex) -> Transition:
    """Return the transition to what a command plays: along its onset, or a ramp [s] without one."""
    last = amplitude_of(command.level, command.phase)
    if command.onset is None:
        return Transition(time, ramp, first, last, time + ramp)
    return along(command.onset, time, first, last)


def steepest(points: Sequence[complex], step: float, *, is_cosine: bool) -> tuple[float, float]:
    """Return the steepest rise of the magnitude, and the fastest change, along points.

    Both in full levels a second; the points are a step [s] apart, on straight lines or, two of
    them, on a raised cosine.
    """
    rise = change = 0.0
    for one, other in pairwise(points):
        if one == other:
            continue
        fastest = abs(other - one) / step if step else math.inf
        change = max(change, fastest)
        # The way rises only where its end is farther out than the foot of the perpendicular.
        if ((other - one) * other.conjugate()).real > 0:
            rise = max(rise, fastest)
    factor = math.pi / 2 if is_cosine else 1.0
    return rise * factor, change * factor
