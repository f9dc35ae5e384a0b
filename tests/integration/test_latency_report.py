"""Repeated attempts and the reports of benchmarks on a disturbed machine."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.latency.match import Command, Matched, match, read_commands
from benchmarks.latency.programs import Ended
from benchmarks.latency.report import cases, report
from benchmarks.latency.run import Case, Disturbed, Failed, Found, attempt
from benchmarks.plate.problem import DAMPING, PAPER, STIFFNESS, STROKE, accelerations
from controller.api.schema import LatencySummary
from drivers.codec.serial_line.frame import pack_words
from drivers.protocol.sets import Command as ToneOnWire
from drivers.protocol.sets import LayerSet, pack_layers, parts
from drivers.protocol.table import MESSAGES

CASES = cases(0.01, 1)


def found(case: Case, *, milliseconds: float, others: float = 0.0) -> Found:
    """Ten touches with equal latency."""
    times = np.full(10, 1e-3 * milliseconds)
    own = None
    if case.touch_wait is not None:
        own = LatencySummary(count=10, median=1.0, p99=1.0, p999=1.0, histogram=[])
    return Found(case, Matched(np.arange(10), times, times, 0), own, 10, 0.01, others, True)


def measuring(*outcomes: Found | Exception) -> Callable[[], Found]:
    """A function with these outcomes, one per attempt."""
    left = list(outcomes)

    def measured() -> Found:
        outcome = left.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    return measured


def test_attempt_repeats_a_disturbed_case_once() -> None:
    """A second success counts; a second failure reports both causes."""
    case = CASES[0]
    good = found(case, milliseconds=1.0)
    assert attempt(case, measuring(Disturbed("FAULT"), good)) is good
    failed = attempt(case, measuring(Disturbed("FAULT"), Ended("the panel")))
    assert isinstance(failed, Failed)
    assert [why.partition(" (load average")[0] for why in failed.why] == ["FAULT", "the panel"]


def test_report_compares_each_quantile_with_its_target() -> None:
    """The targets of the first case are 2 ms (median), 5 ms (99th percentile), 10 ms (99.9th)."""
    slow = [found(CASES[0], milliseconds=6.0), found(CASES[1], milliseconds=3.0)]
    page = report(slow, seconds=100, seed=1, minutes=9)
    assert "median 6.00 of 2 ms (**missed**), 99th percentile 6.00 of 5 ms (**missed**)" in page
    assert "99.9th 6.00 of 10 ms (met)" in page
    assert "median 2.0, 99th percentile 2.0" in page  # times the plain exchange


def test_match_falls_back_to_the_touch_without_the_flood() -> None:
    """A set that matches no touch beside the flood's finger may match one without it."""
    sent = np.array([0.0, 0.001, 0.002])
    commands = [Command(0.0015, 1, 1, ()), Command(0.003, 2, 2, ()), Command(0.0035, 3, 3, ())]

    def flooded(touch: int, command: Command) -> float:
        return 0.0 if (touch, command.token) == (1, 1) else 9.0

    def alone(touch: int, command: Command) -> float:
        return 0.0 if (touch, command.token) in ((0, 1), (2, 2)) else 9.0

    matched = match(commands, sent, flooded, alone, first=lambda before, touch: before + 1)
    assert matched.touch.tolist() == [1, 2]
    assert matched.newest == pytest.approx([0.0005, 0.001])
    assert matched.unmatched == 1


def set_values(token: int, level: int, *, now: bool = False) -> dict[str, object]:
    """A set of one channel, 100 Hz, level in 1/10000, silent where it is 0."""
    commands = (ToneOnWire(0, 2000, level, 0),)
    stream = pack_layers([LayerSet(0, 20, 0, commands)])
    (part,) = parts(stream, session=9, token=token, now=now)
    return part


def line(
    milliseconds: int, amplifier: str, name: str, values: dict[str, object]
) -> tuple[int | str, ...]:
    """What the far end writes of a request."""
    message = MESSAGES[name]
    payload = pack_words(message.request.pack(values)).hex()
    return (milliseconds * 1_000_000, amplifier, message.number, milliseconds, payload)


def test_set_of_two_amplifiers_plays_at_the_commit_of_the_second() -> None:
    """What is staged has no moment, nor has a repeated commit; silence needs no commit."""
    commit = {"session": 9, "token": 5}
    lines = [
        line(1, "a", "Set", set_values(5, 5000)),
        line(2, "b", "Set", set_values(5, 2500)),
        line(3, "a", "Commit", commit),
        line(4, "a", "Commit", commit),
        line(6, "b", "Commit", commit),
        line(7, "b", "Set", set_values(7, 0, now=True)),
        line(9, "a", "Set", set_values(7, 0, now=True)),
    ]
    first, second = read_commands(lines, ("a", "b"))
    assert (first.time, first.token, first.sequence) == (pytest.approx(0.006), 5, 6)
    assert [(name, each.frequency, each.level) for name, each in first.commands] == [
        ("a", pytest.approx(100.0), pytest.approx(0.5)),
        ("b", pytest.approx(100.0), pytest.approx(0.25)),
    ]
    assert (second.time, second.token) == (pytest.approx(0.009), 7)


def test_set_in_parts_plays_once_it_is_whole() -> None:
    """A set of two parts, the second first; the tones of both layers are read."""
    commands = tuple(ToneOnWire(channel, 2000, 1000, 0) for channel in range(16))
    layers = [LayerSet(number, 20, 0, commands) for number in (0, 1)]
    first, second = parts(pack_layers(layers), session=9, token=3, now=True)
    lines = [line(1, "a", "Set", second), line(2, "a", "Set", first)]
    (read,) = read_commands(lines, ("a",))
    assert (read.time, read.sequence, len(read.commands)) == (pytest.approx(0.002), 2, 32)


def test_a_rigid_mass_on_one_era_is_an_oscillator() -> None:
    """x = (k + i omega c) s / (k + i omega c - m omega²), by hand."""
    omega, mass = PAPER.omega, 0.28
    receptance = (-1 / (mass * omega**2))[:, None, None].astype(complex)
    spring = STIFFNESS + 1j * omega * DAMPING
    expected = -(omega**2) * spring * STROKE / (spring - mass * omega**2)
    found = accelerations(PAPER, receptance, receptance)
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-12)
