"""How closely clocks are held by the lines of a rig, as `era config check` tells it."""

import math

import pytest

from drivers.by_hand.reaching import Arrangement, arrangement_of
from drivers.urls import CLOCK_ERRORS, SIMULATED
from sim.transport.simulated_line import LINE_KINDS, PROMPT

STATED = 5e-6 / math.sqrt(3)
"""5 us at most either way, all errors alike, are so much rms."""


def arranged(*urls: str) -> Arrangement | None:
    """Amplifiers a, b, ... at these URLs, with four channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return arrangement_of(
        named, channels=dict.fromkeys(named, 4), stated=dict.fromkeys(named, 5e-6)
    )


@pytest.mark.parametrize(
    ("urls", "kinds", "has_remedy"),
    [
        (["serial:///dev/ttyUSB0", "serial:///dev/ttyUSB1"], ["ftdi-low-latency"] * 2, True),
        (["serial:///dev/ttyACM0", "serial:///dev/ttyAMA0"], ["usb-full-speed", "native"], True),
        (["modbus+rtu:///dev/serial/x#1", "can+slcan:///y#1"], ["usb-full-speed", "can-usb"], True),
        (["serial:///dev/ttyS0", "can+socketcan://can0#1"], ["native", "can"], False),
        (["serial+tcp://one:5000?baud=921600", "modbus+tcp://two/1"], ["ethernet"] * 2, True),
        (
            ["serial:///dev/ttyACM0?line=usb-high-speed", "modbus+rtu:///b?line=native#1"],
            ["usb-high-speed", "native"],
            False,
        ),
        ([f"serial:///dev/ttyS0?address={each}" for each in (1, 2, 3)], ["native"] * 3, False),
        (["modbus+tcp://host/1", "modbus+tcp://host/2"], ["ethernet"] * 2, True),
        (["sim://r?amplifier=a", "sim://r?amplifier=b&line=ftdi"], [SIMULATED, "ftdi"], True),
    ],
)
def test_clocks_are_held_as_closely_as_the_line_allows(
    urls: list[str], kinds: list[str], has_remedy: bool
) -> None:
    """By separate lines of each kind, named or not, one bus, simulated; sums of squares."""
    found = arranged(*urls)
    assert found is not None
    errors = [math.hypot(STATED, CLOCK_ERRORS[each]) for each in kinds]
    assert [*found.errors.values()] == pytest.approx(errors)
    assert bool(found.remedy) == has_remedy


def test_what_would_be_better_is_not_there_already() -> None:
    """One bus of full speed is held by Marks, whatever its adapter; 0.2 ms are of the clocks."""
    bus = [f"serial:///dev/ttyACM0?address={each}" for each in (1, 2)]
    found = arranged(*bus)
    assert found is not None
    assert found.remedy == ""
    assert found.errors["a"] == pytest.approx(math.hypot(STATED, 7e-6))
    named = {"a": "serial:///dev/ttyACM0", "b": "serial:///dev/ttyACM1"}
    wide = arrangement_of(named, channels={"a": 4, "b": 4}, stated={"a": 5e-6, "b": 2e-4})
    assert wide is not None
    assert "clock_error" in wide.remedy


def test_every_kind_of_line_that_is_simulated_has_an_error() -> None:
    """Under the same names: what the check says of one is measured with it."""
    assert CLOCK_ERRORS.keys() == {*LINE_KINDS, PROMPT}


def test_one_amplifier_with_eras_has_no_arrangement() -> None:
    """One alone, a second one without ERAs, a URL that is reported elsewhere."""
    pair = {"a": "serial:///dev/ttyUSB0", "b": "serial:///dev/ttyUSB1"}
    assert arranged(pair["a"]) is None
    stated = dict.fromkeys("ab", 5e-6)
    assert arrangement_of(pair, channels={"a": 4, "b": 0}, stated=stated) is None
    assert arranged(pair["a"], "serail:///dev/ttyUSB0") is None


def test_a_clock_that_cannot_be_steered_is_held_to_nothing() -> None:
    """Whatever the line; the other one is as before."""
    pair = {"a": "serial:///dev/ttyS0", "b": "serial:///dev/ttyS1"}
    stated = {"a": 2e-6, "b": math.inf}
    found = arrangement_of(pair, channels={"a": 4, "b": 4}, stated=stated)
    assert found is not None
    assert found.errors == {
        "a": pytest.approx(math.hypot(2e-6 / math.sqrt(3), CLOCK_ERRORS["native"])),
        "b": math.inf,
    }
