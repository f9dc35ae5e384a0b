"""Checks of the levels during a cross-fade, when two voices of a channel sound."""

import cmath
import math
from collections.abc import Sequence

from drivers.conformance.bench import Bench, Sample
from drivers.conformance.check import driving
from drivers.conformance.curve import Curve, expect_curve, raised_cosine, samples_until
from drivers.conformance.findings import ContractViolation, NotApplicable
from drivers.guard.channel_state import Interval

_STATUS = "wire-protocol.md#status"
_APART = 1.25  # of two frequencies, so far apart that their voices cannot be one


@driving(_STATUS)
async def levels_of_two_frequencies(bench: Bench) -> None:
    """It adds the levels of two voices that cross-fade, each along its own ramp."""
    other = _other_frequency(bench)
    for first, second in ((1.0, 0.5), (0.5, 1.0)):
        samples, when = await _cross_fade(bench, first, second, frequency=other)
        added = _added(bench, first, second)
        expect_curve(
            bench, samples, added, commit=when, lasts=bench.ramp, what="of two frequencies"
        )
        await bench.expect_levels(second, why="after a cross-fade of two frequencies")
        await bench.amplifier.disarm(0.0)
        await bench.rest()


@driving(_STATUS)
async def levels_of_one_frequency(bench: Bench) -> None:
    """It adds the levels of voices of one frequency, or shows how they interfere."""
    for phase, second in ((0.0, 0.5), (180.0, 1.0)):
        samples, when = await _cross_fade(bench, 1.0, second, phase=phase, keep_phase=True)
        summed = _summed(bench, 1.0, second, phase)
        what = f"of voices of one frequency, {phase:g} degrees apart"
        try:
            expect_curve(bench, samples, summed, commit=when, lasts=bench.ramp, what=what)
        except ContractViolation:
            added = _added(bench, 1.0, second)
            expect_curve(bench, samples, added, commit=when, lasts=bench.ramp, what=what)
        await bench.amplifier.disarm(0.0)
        await bench.rest()


async def _cross_fade(
    bench: Bench,
    first: float,
    second: float,
    *,
    frequency: float | None = None,
    phase: float = 0.0,
    keep_phase: bool = False,
) -> tuple[Sequence[Sample], Interval]:
    """Fade from a set to another, at fractions of the test level; statuses along it, and when."""
    if not bench.ramp:
        raise NotApplicable("it plays without ramps")
    await bench.arm()
    await bench.play(first)
    requested = bench.tones(
        second, frequency=frequency, phase=phase, keep_phase=keep_phase, ramp=bench.ramp
    )
    when = await bench.apply(requested)
    return await samples_until(bench, when.latest + 1.1 * bench.ramp), when


def _added(bench: Bench, first: float, second: float) -> Curve:
    """Make the curve of the magnitudes of both voices, added."""
    start, end = first * bench.level, second * bench.level
    return raised_cosine(bench.ramp, start=start, end=end)


def _summed(bench: Bench, first: float, second: float, phase: float) -> Curve:
    """Make the curve of the magnitude of the sum of both voices, a phase [degrees] apart."""
    end = cmath.rect(second * bench.level, math.radians(phase))
    return raised_cosine(bench.ramp, start=first * bench.level, end=end)


def _other_frequency(bench: Bench) -> float:
    """Return a frequency other than that of the checks, within its range."""
    limits = bench.guard.limits
    for frequency in (bench.frequency * _APART, bench.frequency / _APART):
        if limits.frequency_min <= frequency <= limits.frequency_max:
            return frequency
    raise NotApplicable("its range of frequencies is too narrow for two of them")
