"""Clocks of several amplifiers, as the control loop's answers count them."""

import logging
import math
from dataclasses import replace

import pytest

from controller.play.routing import CountedClocks
from model.ensemble.draws import EXACT_CLOCKS
from model.rig.rig import Channel
from plates import smooth_rig, smooth_table
from registry import threads

RIG = smooth_rig()
HALVES = replace(
    RIG,
    amplifiers={"a": "sim://", "b": "sim://"},
    wiring={era.name: Channel("ab"[n % 2], n // 2) for n, era in enumerate(RIG.eras)},
)


def test_answers_count_clocks_before_they_are_worse_than_counted() -> None:
    """A quarter more than is known; anew where that is passed, or far too much: not in between."""
    now = {"a": 8e-6, "b": 4e-6}
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    first = clocks.counted_by(table)
    assert first.clocks.errors == pytest.approx((10e-6, 5e-6))
    assert clocks.errors == pytest.approx({"a": 10e-6, "b": 5e-6})
    now |= {"a": 9.9e-6, "b": 3e-6}
    assert clocks.counted_by(first) is first
    now["a"] = 10.1e-6
    worse = clocks.counted_by(first)
    assert worse.clocks.errors[0] == pytest.approx(12.625e-6)
    now["a"] = 5e-6
    assert clocks.counted_by(worse).clocks.errors[0] == pytest.approx(6.25e-6)


def test_a_table_that_is_learned_has_the_same_clocks() -> None:
    """Whatever table is answered by; nothing else of it changes."""
    clocks = CountedClocks(HALVES, lambda: {"a": 8e-6, "b": 4e-6})
    first, learned = clocks.counted_by(smooth_table()), replace(smooth_table())
    other = clocks.counted_by(learned)
    assert other.clocks == first.clocks
    assert other.omega is learned.omega


def test_clocks_that_come_and_go_are_told_once_with_how_often(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lost five times within a second: one warning; held for 10 s: once, after five times.

    Answers follow each change at once.
    """
    seconds, now = [0.0], {"a": 4e-6, "b": 4e-6}
    monkeypatch.setattr(threads, "now", lambda: seconds[0])
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    with caplog.at_level(logging.INFO, logger="controller.play.routing"):
        table = clocks.counted_by(table)
        for _ in range(5):
            for now["b"], groups in ((math.inf, (0, 1, 0, 1)), (4e-6, ())):
                table = clocks.counted_by(table)
                assert table.clocks.groups == groups
                seconds[0] += 0.1
        assert [each.levelno for each in caplog.records] == [logging.WARNING]
        seconds[0] += 9.8  # 9.9 s since it was held
        table = clocks.counted_by(table)
        assert len(caplog.records) == 1
        seconds[0] += 0.2
        table = clocks.counted_by(table)
        table = clocks.counted_by(table)
        assert [each.levelno for each in caplog.records] == [logging.WARNING, logging.INFO]
        assert "losses before: 5" in caplog.records[1].getMessage()
        now["b"] = math.inf
        clocks.counted_by(table)
    levels = [each.levelno for each in caplog.records]
    assert levels == [logging.WARNING, logging.INFO, logging.WARNING]
    assert all("amplifier b" in each.getMessage() for each in caplog.records)


def test_clock_that_is_not_known_yet_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """When its line has just been opened."""
    clocks = CountedClocks(HALVES, lambda: {"a": 4e-6, "b": math.inf})
    with caplog.at_level(logging.INFO, logger="controller.play.routing"):
        assert clocks.counted_by(smooth_table()).clocks.groups == (0, 1, 0, 1)
    assert [each.levelno for each in caplog.records] == [logging.INFO]


def test_one_amplifier_has_no_clock_that_counts() -> None:
    """It is not even asked."""
    one = replace(RIG, wiring={era.name: Channel("a", n) for n, era in enumerate(RIG.eras)})
    clocks = CountedClocks(one, lambda: pytest.fail("not to be asked"))
    assert clocks.counted_by(smooth_table()) is smooth_table()
    assert smooth_table().clocks == EXACT_CLOCKS
