"""The check of a rig's amplifiers by their URLs alone."""

from dataclasses import replace

import pytest

from drivers.by_hand.reaching import check_links
from registry.limits import GuardLimits

BUS = "can+socketcan://can0"
LIMITS = GuardLimits(40.0, 250.0, 1.0)


def checked(*urls: str, channels: int = 4) -> tuple[dict[str, str], list[str]]:
    """Amplifiers a, b, ... at these URLs, with so many channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return check_links(named, channels=dict.fromkeys(named, channels), limits=LIMITS)


@pytest.mark.parametrize("frequencies", [(5.0, 250.0), (40.0, 5000.0)])
def test_check_links_warns_of_limits_beyond_the_ceilings(frequencies: tuple[float, float]) -> None:
    """10 Hz, and 65 535 steps of 1/20 Hz."""
    low, high = frequencies
    limits = replace(LIMITS, frequency_min=low, frequency_max=high)
    _, (warning,) = check_links({}, channels={}, limits=limits)
    assert "10 to 3276.75 Hz" in warning


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serail:///dev/ttyUSB0", r"unknown wire 'serail://'; did you mean serial://\? known are"),
        ("carrier+pigeon://coop", "known are .*modbus.tcp://, serial://, .*sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud must be.*'fast'"),
        ("modbus+tcp://host/999", "unit must be.*'999'"),
        (f"{BUS}#300", "node must be.*'300'"),
        # The longest part of a set, of 120 words, and its reply: 282 bytes of 11 bits and four
        # silences of 3.5 of them at 19200 baud are 170 ms, beside three heartbeats of 50 ms.
        ("modbus+rtu:///dev/ttyS1?baud=19200#1", "at least 320 ms.*got 250 ms; use a faster"),
        ("serial:///dev/ttyUSB9?baud=115200&address=2", "baud must be 921600 .*got 115200"),
    ],
)
def test_check_links_names_an_unusable_url(url: str, message: str) -> None:
    """Unknown scheme, invalid part of a URL, too slow for the watchdog, another speed of a line."""
    wrong, warnings = checked("serial:///dev/ttyUSB9", url)
    assert list(wrong) == ["b"]
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(wrong["b"])
    assert warnings == []


def test_check_links_refuses_two_amplifiers_at_one_address() -> None:
    """However the URL is spelled; the error is on the second and names the first."""
    wrong, _ = checked(f"{BUS}#1", f"{BUS}#2", f"{BUS}?bitrate=500000#1")
    assert list(wrong) == ["c"]
    assert "amplifier a" in wrong["c"]


@pytest.mark.parametrize(
    ("urls", "times"),
    [
        # 282 bytes of 11 bits, four silences of 1.75 ms, 10 ms for the amplifier: twice each.
        ([f"modbus+rtu:///dev/ttyS1?baud=38400#{unit}" for unit in (1, 2)], ["441 ms"]),
        # At 115 200 baud the longest set is repeated once in 88 ms, a short one twice in 90 ms.
        ([f"modbus+rtu:///dev/ttyS1?baud=115200#{unit}" for unit in (1, 2)], ["230 ms"]),
        (["serial:///dev/ttyUSB0"], []),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], ["230 ms"]),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], []),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], ["320 ms"]),
        ([f"{BUS}#1", f"{BUS}#5"], ["230 ms"]),
    ],
)
def test_check_links_warns_of_late_loss_detection(urls: list[str], times: list[str]) -> None:
    """Slow lines, and lines on which several amplifiers wait for each other; times by hand."""
    wrong, warnings = checked(*urls)
    assert wrong == {}
    late = [warning for warning in warnings if "later than 150 ms" in warning]
    assert len(late) == len(times)
    for warning, time in zip(late, times, strict=True):
        assert time in warning
