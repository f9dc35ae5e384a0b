"""Levels against curves: bounds over the time in which a status was taken, however long."""

import asyncio
import cmath
import math

import pytest

from conformance_bench import results_on
from drivers import clock
from drivers.conformance import Result
from drivers.conformance.bench import Bench, Sample
from drivers.conformance.check import Check
from drivers.conformance.curve import along, expect_curve, raised_cosine
from drivers.conformance.envelopes import load, step_of
from drivers.guard.channel_state import Interval
from model.rig.rig import Rig

STEP = 0.1  # s; of the envelope
ASKED, TAKEN, ANSWERED = 0.051, 0.104, 0.301  # s after a commit; of a status on a busy machine


def test_span_has_the_levels_between_its_ends() -> None:
    """A knot, and the point of a straight line that is nearest to zero, are lower than both."""
    assert along(STEP, 0.2, 0.1, 0.2).span(ASKED, ANSWERED) == pytest.approx((0.1, 0.2))
    assert along(STEP, 1.0, -0.5).span(0.0, STEP) == pytest.approx((0.0, 1.0))
    # An equilateral triangle: its height.
    third = cmath.rect(1.0, math.pi / 3)
    assert along(STEP, 1.0, third).span(0.01, 0.09)[0] == pytest.approx(math.sqrt(3) / 2)
    assert along(STEP, 0.0, 1.0).span(0.025, 0.075) == pytest.approx((0.25, 0.75))


def test_span_of_a_cross_fade_has_the_moment_of_least_level() -> None:
    """Equal voices of one frequency in opposite phase cancel amid their ramp, and never before."""
    fade = raised_cosine(0.3, start=1.0, end=-1.0)
    assert fade.span(0.0, 0.3) == pytest.approx((0.0, 1.0))
    # A quarter of the ramp: cos(pi / 4) of both together.
    assert fade.span(0.0, 0.075) == pytest.approx((math.sqrt(0.5), 1.0))
    quarter = raised_cosine(0.3, start=1.0, end=1j)
    assert quarter.span(0.0, 0.3)[0] == pytest.approx(math.sqrt(0.5))


def test_later_curve_turns_later() -> None:
    """By its delay, so that its span has the knot."""
    assert along(STEP, 0.2, 0.1, 0.2).after(0.5).span(0.55, 0.65) == pytest.approx((0.1, 0.15))


def test_level_of_a_status_that_took_long_is_right(coarse_rig: Rig) -> None:
    """Near a knot, in a status whose request and reply were both late: no false failure."""
    seen = []

    async def late_status(bench: Bench, commit: Interval) -> Sample:
        await bench.pause_until(commit.latest + ASKED)
        earliest = clock.now()
        await bench.pause_until(commit.latest + TAKEN)
        status = (await bench.sample()).status
        await asyncio.sleep(commit.latest + ANSWERED - clock.now())
        return Sample(Interval(earliest, clock.now()), status)

    async def steps(bench: Bench) -> None:
        assert step_of(bench) == STEP
        await load(bench, 1, 0.5)
        await bench.arm()
        await bench.play(1.0)
        when = await bench.apply(bench.tones(1.0, onset=1, keep_phase=True))
        late = await late_status(bench, when)
        level = bench.level
        seen.append(late.status.levels[0])
        curve = along(STEP, level, 0.5 * level, level)
        expect_curve(bench, [late], curve, commit=when, lasts=2 * STEP, what="of an onset")

    check = Check("named", "does as told", ("wire-protocol.md#envelopes",), drives=True, run=steps)
    (found,) = results_on("modbus+tcp", coarse_rig, [check])
    assert seen[0] == pytest.approx(0.104, abs=0.001)  # 0.1 at the knot, 0.001 more each ms
    assert found.result is Result.INCONCLUSIVE  # one status does not show the curve
