"""How closely clocks are held by the lines of a rig, as `era config check` tells it."""

import math

import pytest

from drivers.by_hand.arrangement import Arrangement, arrangement_of

STATED = 5e-6 / math.sqrt(3)
"""5 us at most either way, all errors alike, are so much rms."""


def arranged(*urls: str) -> Arrangement | None:
    """Amplifiers a, b, ... at these URLs, with four channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return arrangement_of(
        named, channels=dict.fromkeys(named, 4), stated=dict.fromkeys(named, 5e-6)
    )


@pytest.mark.parametrize(
    ("urls", "line_us", "has_remedy"),
    [
        (["serial:///dev/ttyUSB0", "serial:///dev/ttyUSB1"], [17, 17], True),
        (["serial:///dev/ttyACM0", "serial:///dev/ttyAMA0"], [17, 3], True),
        (["serial:///dev/ttyS0", "can+socketcan://can0#1"], [3, 3], False),
        (["serial+tcp://one:5000?baud=921600", "modbus+tcp://two/1"], [12, 12], True),
        ([f"serial:///dev/ttyUSB0?address={each}" for each in (1, 2, 3)], [3, 3, 3], False),
        (["can+socketcan://can0#1", "can+socketcan://can0#2"], [3, 3], False),
        (["modbus+tcp://host/1", "modbus+tcp://host/2"], [12, 12], True),
    ],
)
def test_clocks_are_held_as_closely_as_the_line_allows(
    urls: list[str], line_us: list[float], has_remedy: bool
) -> None:
    """By separate lines of each kind, one bus, one connection; sums of squares by hand."""
    found = arranged(*urls)
    assert found is not None
    errors = [math.hypot(STATED, each * 1e-6) for each in line_us]
    assert [*found.errors.values()] == pytest.approx(errors)
    assert bool(found.remedy) == has_remedy


def test_one_amplifier_with_eras_has_no_arrangement() -> None:
    """One alone, a second one without ERAs, simulated ones, a URL that is reported elsewhere."""
    pair = {"a": "serial:///dev/ttyUSB0", "b": "serial:///dev/ttyUSB1"}
    assert arranged(pair["a"]) is None
    stated = dict.fromkeys("ab", 5e-6)
    assert arrangement_of(pair, channels={"a": 4, "b": 0}, stated=stated) is None
    assert arranged("sim://rig.yaml?amplifier=a", "sim://rig.yaml?amplifier=b") is None
    assert arranged(pair["a"], "serail:///dev/ttyUSB0") is None


def test_a_clock_that_cannot_be_steered_is_held_to_nothing() -> None:
    """Whatever the line; the other one is as before."""
    pair = {"a": "serial:///dev/ttyS0", "b": "serial:///dev/ttyS1"}
    stated = {"a": 2e-6, "b": math.inf}
    found = arrangement_of(pair, channels={"a": 4, "b": 4}, stated=stated)
    assert found is not None
    assert found.errors == {
        "a": pytest.approx(math.hypot(2e-6 / math.sqrt(3), 3e-6)),
        "b": math.inf,
    }
