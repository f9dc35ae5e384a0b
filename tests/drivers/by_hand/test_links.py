"""How the amplifiers of a rig are reached by their URLs, and how closely their lines hold clocks.

Times and errors are calculated by hand.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import pytest

from drivers.by_hand.links import Arrangement, arrangement_of, check_links
from drivers.urls import CLOCK_ERRORS, SIMULATED, UNKNOWN_KIND
from drivers.wires import wire
from drivers.wires.serial_line import SerialAddress
from drivers.wires.wire import line_kind_of
from registry.limits import GuardLimits

BUS = "can+socketcan://can0"
LIMITS = GuardLimits(40.0, 250.0, 1.0)


def check(*urls: str) -> tuple[dict[str, str], list[str]]:
    """Return errors and warnings of amplifiers a, b, ... of four channels at these URLs."""
    named_urls = dict(zip("abcd", urls, strict=False))
    return check_links(named_urls, channels=dict.fromkeys(named_urls, 4), limits=LIMITS)


@pytest.mark.parametrize(("lowest", "highest"), [(5.0, 250.0), (40.0, 5000.0)])
def test_check_links_warns_of_frequencies_that_no_wire_carries(
    lowest: float, highest: float
) -> None:
    """At least 10 Hz, at most 65 535 steps of 1/20 Hz."""
    limits = replace(LIMITS, frequency_min=lowest, frequency_max=highest)

    _, (warning,) = check_links({}, channels={}, limits=limits)

    assert "10 to 3276.75 Hz" in warning


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serail:///dev/ttyUSB0", r"unknown wire 'serail://'; did you mean serial://"),
        ("carrier+pigeon://coop", "known: .*modbus.tcp://, serial://, .*sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud must be.*'fast'"),
        ("modbus+tcp://host/999", "unit must be.*'999'"),
        (f"{BUS}#300", "node must be.*'300'"),
        # The longest part of a set, of 120 words, and its reply: 282 bytes of 11 bits and four
        # silences of 3.5 of them at 19200 baud are 170 ms, plus three heartbeats of 50 ms.
        ("modbus+rtu:///dev/ttyS1?baud=19200#1", "at least 320 ms.*got 250 ms"),
        ("serial:///dev/ttyUSB9?baud=115200&address=2", "baud must be 921600 .*got 115200"),
    ],
)
def test_check_links_names_an_unusable_url(url: str, message: str) -> None:
    """An unknown scheme, an invalid part, too slow for the watchdog, or another speed of a line."""
    errors, warnings = check("serial:///dev/ttyUSB9", url)

    assert list(errors) == ["b"]
    assert re.search(message, errors["b"])
    assert warnings == []


def test_check_links_rejects_two_amplifiers_at_one_address() -> None:
    """The same address with another spelling is an error of the second amplifier."""
    errors, _ = check(f"{BUS}#1", f"{BUS}#2", f"{BUS}?bitrate=500000#1")

    assert list(errors) == ["c"]
    assert "amplifier a" in errors["c"]


@pytest.mark.parametrize(
    ("urls", "time"),
    [
        # 282 bytes of 11 bits, four silences of 1.75 ms, 10 ms for the amplifier: twice each.
        (["modbus+rtu:///dev/ttyS1?baud=38400#1", "modbus+rtu:///dev/ttyS1?baud=38400#2"], 441),
        # At 115 200 baud the longest set is repeated once in 88 ms, a short one twice in 90 ms.
        (["modbus+rtu:///dev/ttyS1?baud=115200#1", "modbus+rtu:///dev/ttyS1?baud=115200#2"], 230),
        (["serial:///dev/ttyUSB0"], None),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], 230),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], None),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], 320),
        ([f"{BUS}#1", f"{BUS}#5"], 230),
    ],
)
def test_check_links_warns_of_late_loss_detection(urls: list[str], time: int | None) -> None:
    """Slow lines, and lines on which several amplifiers wait for each other [ms]."""
    errors, warnings = check(*urls)

    assert errors == {}
    late = [warning for warning in warnings if "later than 150 ms" in warning]
    if time is None:
        assert late == []
    else:
        assert len(late) == 1
        assert f"{time} ms" in late[0]


STATED = 5e-6 / math.sqrt(3)
"""5 us at most in either direction, all errors equally likely, are this many rms [s]."""


def arrange(
    *urls: str, channels: Sequence[int] = (4,) * 4, stated: Sequence[float] = (5e-6,) * 4
) -> Arrangement | None:
    """Arrange amplifiers a, b, ... with numbers of channels and stated clock errors [s]."""
    named_urls = dict(zip("abcd", urls, strict=False))
    named_channels = dict(zip("abcd", channels, strict=False))
    named_errors = dict(zip("abcd", stated, strict=False))
    return arrangement_of(named_urls, channels=named_channels, stated=named_errors)


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
        (["serial:///dev/ttyS0?address=1", "serial:///dev/ttyS0?address=2"], ["native"] * 2, False),
        (["modbus+tcp://host/1", "modbus+tcp://host/2"], ["ethernet"] * 2, True),
        (["sim://r?amplifier=a", "sim://r?amplifier=b&line=ftdi"], [SIMULATED, "ftdi"], True),
    ],
)
def test_arrangement_has_the_clock_errors_of_its_lines(
    urls: list[str], kinds: list[str], has_remedy: bool
) -> None:
    """Separate lines of each kind, one bus, and simulated lines: stated and line errors add up."""
    arrangement = arrange(*urls)

    expected = [math.hypot(STATED, CLOCK_ERRORS[kind]) for kind in kinds]
    assert [*arrangement.errors.values()] == pytest.approx(expected)
    assert bool(arrangement.remedy) == has_remedy


def test_arrangement_suggests_only_improvements() -> None:
    """Marks hold a full-speed bus already; a clock error of 0.2 ms is the amplifier's own."""
    bus = arrange("serial:///dev/ttyACM0?address=1", "serial:///dev/ttyACM0?address=2")
    assert bus.remedy == ""
    assert bus.errors["a"] == pytest.approx(math.hypot(STATED, 7e-6))

    inexact = arrange("serial:///dev/ttyACM0", "serial:///dev/ttyACM1", stated=[5e-6, 2e-4])
    assert "clock_error" in inexact.remedy


@pytest.mark.parametrize(
    ("second_url", "second_channels"),
    [("serial:///dev/ttyUSB1", 0), ("serail:///dev/ttyUSB0", 4)],
)
def test_one_amplifier_with_channels_has_no_arrangement(
    second_url: str, second_channels: int
) -> None:
    """The second amplifier has no channels, or a URL that is an error elsewhere."""
    assert arrange("serial:///dev/ttyUSB0", second_url, channels=[4, second_channels]) is None


def test_kind_of_line_is_stated_or_follows_from_scheme_or_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The wire of a plug-in has no row in a table of schemes, so its kind is unknown."""
    assert line_kind_of("serial:///dev/ttyACM0") == "usb-full-speed"
    assert line_kind_of("can+slcan:///dev/ttyS0") == "can-usb"
    assert line_kind_of("MODBUS+TCP://host/1") == "ethernet"
    assert line_kind_of("example-unix:///run/amplifier?line=native") == "native"
    monkeypatch.setattr(wire, "address_of", SerialAddress)
    monkeypatch.setattr(SerialAddress, "SCHEMES", {})
    assert line_kind_of("serial:///dev/ttyS0") == UNKNOWN_KIND
