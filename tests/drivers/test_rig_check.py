"""Checks of a rig's amplifiers by their URLs, as in `era config check`."""

import math
from dataclasses import fields

import pytest

from drivers.guard.limits import FREQUENCY_CEILING, LEVEL_CEILING, RATE_CEILING
from drivers.rig_check import COMMIT_SKEW, check_links, phase_error, remaining_contrast
from model.rig.sections import LimitsSection
from registry.limits import GuardLimits

LIMITS = GuardLimits(40.0, 250.0, 1.0)
BUS = "can+socketcan://can0"


def checked(*urls: str, channels: int = 2) -> tuple[dict[str, str], list[str]]:
    """Amplifiers a, b, ... of these URLs, each with so many channels wired."""
    by_name = dict(zip("abcd", urls, strict=False))
    return check_links(by_name, channels=dict.fromkeys(by_name, channels), limits=LIMITS)


@pytest.mark.parametrize("frequencies", [(5.0, 250.0), (40.0, FREQUENCY_CEILING + 1)])
def test_check_links_warns_of_limits_beyond_the_ceilings(frequencies: tuple[float, float]) -> None:
    """The guard would reduce them silently."""
    limits = GuardLimits(*frequencies, 1.0)
    _, warnings = check_links({}, channels={}, limits=limits)
    assert len(warnings) == 1
    assert check_links({}, channels={}, limits=LIMITS) == ({}, [])


def test_limits_of_a_rig_file_are_those_of_the_guard() -> None:
    """A rig file states every limit of the guard, within the guard's ceilings."""
    names = {field.name.removesuffix("_min").removesuffix("_max") for field in fields(GuardLimits)}
    assert LimitsSection.model_fields.keys() == names
    for beyond in ({"level": LEVEL_CEILING + 0.1}, {"rate": RATE_CEILING + 1}):
        with pytest.raises(ValueError, match=next(iter(beyond))):
            LimitsSection.model_validate(beyond)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "serail:///dev/ttyUSB0",
            r"unknown backend 'serail://'; did you mean serial://\? known are can",
        ),
        ("carrier+pigeon://coop", "known are .*modbus.tcp://, serial://, .*sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud must be.*'fast'"),
        ("modbus+tcp://host/999", "unit must be.*'999'"),
        (f"{BUS}#300", "node after # must be.*'300'"),
        ("modbus+rtu:///dev/ttyS1?baud=9600#1", "got 250 ms"),
    ],
)
def test_check_links_names_an_unusable_url(url: str, message: str) -> None:
    """Unknown scheme, invalid part of a URL, wire too slow for the watchdog."""
    wrong, warnings = checked("serial:///dev/ttyUSB9", url, channels=4)
    assert list(wrong) == ["b"]
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(wrong["b"])
    assert warnings == []


def test_check_links_refuses_two_amplifiers_at_one_address() -> None:
    """The error is on the second and names the first."""
    wrong, _ = checked(f"{BUS}#1", f"{BUS}#2", f"{BUS}#1")
    assert list(wrong) == ["c"]
    assert "amplifier a" in wrong["c"]


def test_check_links_warns_of_eras_on_several_links() -> None:
    """No warning for one bus, one link, or a second link without ERAs."""
    assert checked(f"{BUS}#1", f"{BUS}#5") == ({}, [])
    assert checked("modbus+tcp://host/1", "sim://rig.yaml") == ({}, [])
    urls = {"a": "serial:///dev/ttyUSB0", "b": f"{BUS}#1"}
    assert check_links(urls, channels={"a": 4}, limits=LIMITS) == ({}, [])
    wrong, (warning,) = check_links(urls, channels={"a": 2, "b": 2}, limits=LIMITS)
    assert wrong == {}
    assert "2 links (/dev/ttyUSB0, can+socketcan://can0)" in warning
    assert "36 degrees at 100 Hz and 90 at 250 Hz" in warning


@pytest.mark.parametrize(
    ("urls", "times"),
    [
        # 57 + 47 bytes of 11 bits there and back, twice 3.5 characters of silence (Modbus over
        # serial line), 10 ms for the amplifier's answer to begin: 73.6 ms, asked twice.
        (["modbus+rtu:///dev/ttyS1?baud=19200#1"], ["197 ms"]),
        (["modbus+rtu:///dev/ttyS1?baud=115200#1"], []),
        (["serial:///dev/ttyUSB0"], []),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], ["230 ms"]),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], []),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], ["320 ms"]),
        ([f"{BUS}#1", f"{BUS}#5"], []),  # each is missed by its own heartbeats
    ],
)
def test_check_links_warns_of_late_loss_detection(urls: list[str], times: list[str]) -> None:
    """Slow lines, and lines on which several amplifiers wait for each other; times by hand."""
    wrong, warnings = checked(*urls, channels=4)
    assert wrong == {}
    late = [warning for warning in warnings if "later than 150 ms" in warning]
    assert len(late) == len(times)
    for warning, time in zip(late, times, strict=True):
        assert time in warning


def test_remaining_contrast_of_a_skew() -> None:
    """1 ms is a tenth of a period of 100 Hz; 2 sin(18 degrees) of one half remains at the null."""
    assert phase_error(100.0, COMMIT_SKEW) == pytest.approx(36.0)
    assert remaining_contrast(100.0, COMMIT_SKEW) == pytest.approx(
        -20 * math.log10(2 * math.sin(math.pi / 10))
    )
    assert remaining_contrast(250.0, COMMIT_SKEW) == 0.0
    assert remaining_contrast(1000.0, COMMIT_SKEW) == 0.0
    assert remaining_contrast(100.0, 1e-5) == pytest.approx(44.04, abs=0.01)
