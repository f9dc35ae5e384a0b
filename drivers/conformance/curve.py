"""Levels read along a ramp, against the curve that the page defines."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivers import clock
from drivers.conformance.bench import Bench, Sample
from drivers.conformance.findings import ContractViolation, Inconclusive
from drivers.guard.channel_state import Interval
from drivers.operation.plausibility import CYCLE

_PAUSE = 0.004  # s; between samples
_PARTS = 5  # of the curve, in each of which there must be a sharp sample
_SHARP = 0.15  # of the largest level; span of the curve over the interval of a sharp sample
_BEFORE = 0.1  # s; before a commit, in which a delay may still count


@dataclass(frozen=True)
class Curve:
    """A level by the time [s] since its commit; any time.

    breakpoints [s]: all times at which it may begin or cease to rise or fall. Between them it is
    monotonic, so that its values there and at the ends bound it over an interval.
    """

    level: Callable[[float], float]
    breakpoints: tuple[float, ...]

    def __call__(self, time: float) -> float:
        """Return the level at a time [s]."""
        return self.level(time)

    def span(self, first: float, last: float) -> tuple[float, float]:
        """Return the least and the greatest level between two times [s]."""
        within = [time for time in self.breakpoints if first < time < last]
        values = [self.level(time) for time in (first, *within, last)]
        return min(values), max(values)

    def after(self, delay: float) -> "Curve":
        """Make the same curve, a time [s] later."""
        breakpoints = tuple(time + delay for time in self.breakpoints)
        return Curve(lambda time: self.level(time - delay), breakpoints)


def raised_cosine(ramp: float, *, start: complex, end: complex) -> Curve:
    """Make the curve of a ramp [s] from one complex amplitude to another.

    That is how voices of one frequency cross-fade. It is least where it is nearest to zero.
    """

    def level(time: float) -> float:
        share = min(max(time / ramp, 0.0), 1.0) if ramp else float(time >= 0)
        return abs(start + (end - start) * (1 - math.cos(math.pi * share)) / 2)

    lowest = ramp * math.acos(1 - 2 * _nearest_to_zero(start, end)) / math.pi
    return Curve(level, (0.0, lowest, ramp))


def along(step: float, *values: complex) -> Curve:
    """Make the curve along straight lines between complex amplitudes, a step [s] apart."""

    def level(time: float) -> float:
        share = min(max(time / step, 0.0), len(values) - 1.0)
        number = min(int(share), len(values) - 2)
        here, there = values[number : number + 2]
        return abs(here + (there - here) * (share - number))

    breakpoints = []
    for number, (here, there) in enumerate(pairwise(values)):
        breakpoints += [number * step, (number + _nearest_to_zero(here, there)) * step]
    return Curve(level, (*breakpoints, (len(values) - 1) * step))


def _nearest_to_zero(here: complex, there: complex) -> float:
    """Return the share of a straight line at which it is nearest to zero."""
    way = there - here
    if not way:
        return 0.0
    return min(max(-(here * way.conjugate()).real / abs(way) ** 2, 0.0), 1.0)


async def samples_until(bench: Bench, end: float, *, feed: bool = True) -> list[Sample]:
    """Read the status until a time [s], as often as is useful; feed: keep the watchdog fed."""
    taken = []
    while clock.now() < end:
        is_due = feed and clock.now() - bench.fed.latest > bench.watchdog / 4
        taken.append(await (bench.beat() if is_due else bench.sample()))
        await asyncio.sleep(_PAUSE)
    return taken


def expect_curve(
    bench: Bench,
    samples: Sequence[Sample],
    curve: Curve,
    *,
    commit: Interval,
    lasts: float,
    channel: int = 0,
    what: str,
) -> None:
    """Require that the levels of a channel followed a curve for a time [s] since a commit.

    A sample passes if the curve meets it anywhere in the interval in which it was taken. Raises
    Inconclusive if too few samples are sharp enough to tell this curve from others.
    """
    sharp = [0] * _PARTS
    _, peak = curve.span(0.0, lasts)
    for sample in samples:
        low, high = _span(curve, sample.when, commit)
        level = sample.status.levels[channel]
        first = max(sample.when.earliest - commit.latest, 0.0)
        last = sample.when.latest - commit.earliest
        middle = (sample.when.earliest + sample.when.latest - commit.earliest - commit.latest) / 2
        if not low - bench.tolerance <= level <= high + bench.tolerance:
            # If the amplifier did not run for a while, its clock may catch up, too.
            apart = bench.delayed_since(commit.earliest - _BEFORE)
            when = Interval(sample.when.earliest - apart, sample.when.latest + apart)
            lowest, highest = _span(curve, when, commit)
            raise ContractViolation(
                f"level {what} of channel {channel}, {first * 1e3:.1f} to {last * 1e3:.1f} ms "
                "after its request",
                expected=f"{max(low, 0):.4f} to {high:.4f}",
                seen=f"{level:.4f}",
                is_certain=not lowest - bench.tolerance <= level <= highest + bench.tolerance,
            )
        if 0 <= middle < lasts and high - low <= _SHARP * peak:
            sharp[int(middle / lasts * _PARTS)] += 1
    if not all(sharp):
        raise Inconclusive(
            f"level {what}: {len(samples)} statuses, of which {sum(sharp)} were quick enough, "
            "do not cover it"
        )


def _span(curve: Curve, when: Interval, commit: Interval) -> tuple[float, float]:
    """Return the least and the greatest level of a curve in the interval of a sample."""
    first = when.earliest - commit.latest - CYCLE
    return curve.span(first, when.latest - commit.earliest)
