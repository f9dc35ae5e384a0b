"""Levels read along a ramp, against the curve that the page defines."""

import asyncio
import math
from collections.abc import Callable, Sequence

from drivers import clock
from drivers.conformance.bench import Bench, Sample
from drivers.conformance.findings import ContractViolation, Inconclusive
from drivers.guard.channel_state import Interval
from drivers.operation.plausibility import CYCLE

Curve = Callable[[float], float]
"""A level by the time [s] since its commit; any time."""

_PAUSE = 0.004  # s; between samples
_PARTS = 5  # of the curve, in each of which there must be a sharp sample
_FINE = 8  # points of an interval at which the curve is looked at
_SHARP = 0.15  # of the largest level; span of the curve over the interval of a sharp sample
_BEFORE = 0.1  # s; before a commit, in which a delay may still count
_LATEST_PAUSE = 0.04  # s


def raised_cosine(ramp: float, *, start: float, end: float) -> Curve:
    """Make the curve of a ramp [s] from one level to another."""

    def level(time: float) -> float:
        share = min(max(time / ramp, 0.0), 1.0) if ramp else float(time >= 0)
        return start + (end - start) * (1 - math.cos(math.pi * share)) / 2

    return level


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
    peak = max(abs(curve(lasts * number / _FINE)) for number in range(_FINE + 1))
    for sample in samples:
        low, high = _span(curve, sample.when, commit)
        level = sample.status.levels[channel]
        middle = (sample.when.earliest + sample.when.latest - commit.earliest - commit.latest) / 2
        if not low - bench.tolerance <= level <= high + bench.tolerance:
            raise ContractViolation(
                f"level {what} of channel {channel}, {middle * 1e3:.0f} ms after its commit",
                expected=f"{max(low, 0):.4f} to {high:.4f}",
                seen=f"{level:.4f}",
                is_certain=_is_never(bench, level, curve, sample.when, commit),
            )
        if 0 <= middle < lasts and high - low <= _SHARP * peak:
            sharp[int(middle / lasts * _PARTS)] += 1
    if not all(sharp):
        raise Inconclusive(
            f"level {what}: {len(samples)} statuses, of which {sum(sharp)} were quick enough, "
            "do not cover it"
        )


def _is_never(bench: Bench, level: float, curve: Curve, when: Interval, commit: Interval) -> bool:
    """Whether a level is none of a curve's even if the amplifier did not run for a while."""
    apart = bench.delayed_since(commit.earliest - _BEFORE)  # its clock may catch up, too
    low, high = _span(curve, Interval(when.earliest - apart, when.latest + apart), commit)
    return not low - bench.tolerance <= level <= high + bench.tolerance


def _span(curve: Curve, when: Interval, commit: Interval) -> tuple[float, float]:
    """Return the least and the greatest level of a curve in the interval of a sample."""
    first = when.earliest - commit.latest - CYCLE
    last = when.latest - commit.earliest
    values = [curve(first + (last - first) * number / _FINE) for number in range(_FINE + 1)]
    return min(values), max(values)
