"""What `era config check` says of a rig's amplifiers, without opening any."""

import math

import pytest

from drivers.rig_check import APART, check_links, contrast_left, phase_error

BUS = "can+socketcan://can0"


def checked(*urls: str, channels: int = 2) -> tuple[dict[str, str], list[str]]:
    """Amplifiers a, b, ... of these URLs, each with so many channels wired."""
    by_name = dict(zip("abcd", urls, strict=False))
    return check_links(by_name, channels=dict.fromkeys(by_name, channels), frequency_max=250.0)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "serail:///dev/ttyUSB0",
            r"unknown backend 'serail://'; did you mean serial://\? known are can",
        ),
        ("carrier+pigeon://coop", "known are .*modbus.tcp://, .*serial://, sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud is 'fast'"),
        ("modbus+tcp://host/999", "unit is '999'"),
        (f"{BUS}#300", "node after # is '300'"),
        ("modbus+rtu:///dev/ttyS1?baud=9600#1", "got 250 ms"),
    ],
)
def test_what_cannot_be_used_is_named(url: str, message: str) -> None:
    """Unknown schemes with those that are known, bad parts of a URL, wires that are too slow."""
    wrong, warnings = checked("serial:///dev/ttyUSB9", url, channels=4)
    assert list(wrong) == ["b"]
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(wrong["b"])
    assert warnings == []


def test_two_amplifiers_of_one_address_are_named() -> None:
    """The second of them, with the name of the first."""
    wrong, _ = checked(f"{BUS}#1", f"{BUS}#2", f"{BUS}#1")
    assert list(wrong) == ["c"]
    assert "amplifier a's already" in wrong["c"]


def test_only_ERAs_on_several_links_are_warned_of() -> None:  # noqa: N802
    """One bus, one link, or another link without ERAs: nothing. Two links: the numbers of both."""
    assert checked(f"{BUS}#1", f"{BUS}#5") == ({}, [])
    assert checked("modbus+tcp://host/1", "sim://rig.yaml") == ({}, [])
    urls = {"a": "serial:///dev/ttyUSB0", "b": f"{BUS}#1"}
    assert check_links(urls, channels={"a": 4}, frequency_max=250.0) == ({}, [])
    wrong, (warning,) = check_links(urls, channels={"a": 2, "b": 2}, frequency_max=250.0)
    assert wrong == {}
    assert "2 links (/dev/ttyUSB0, can+socketcan://can0)" in warning
    assert "36 degrees out of phase at 100 Hz and 90 at 250 Hz" in warning


@pytest.mark.parametrize(
    ("urls", "told"),
    [
        # 57 + 49 bytes of 11 bits there and back, twice 3.5 characters of silence (Modbus over
        # serial line), 10 ms for the amplifier's answer to begin: 74.7 ms, asked twice.
        (["modbus+rtu:///dev/ttyS1?baud=19200#1"], ["199 ms"]),
        (["modbus+rtu:///dev/ttyS1?baud=115200#1"], []),
        (["serial:///dev/ttyUSB0"], []),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], ["230 ms"]),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], []),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], ["320 ms"]),
        ([f"{BUS}#1", f"{BUS}#5"], []),  # each is missed by its own heartbeats
    ],
)
def test_what_cannot_be_told_within_three_heartbeats_is_warned_of(
    urls: list[str], told: list[str]
) -> None:
    """A line that is too slow for its sets, and several that are asked one after the other: with
    how long it may take, in one line each; by hand."""
    wrong, warnings = checked(*urls, channels=4)
    assert wrong == {}
    late = [warning for warning in warnings if "3 heartbeats, 150 ms" in warning]
    assert len(late) == len(told)
    for warning, time in zip(late, told, strict=True):
        assert time in warning
        assert "\n" not in warning


def test_what_skew_costs_is_arithmetic() -> None:
    """1 ms is a tenth of a period of 100 Hz; 2 sin(18 degrees) of one half is left at the null."""
    assert phase_error(100.0, APART) == pytest.approx(36.0)
    assert contrast_left(100.0, APART) == pytest.approx(
        -20 * math.log10(2 * math.sin(math.pi / 10))
    )
    assert contrast_left(250.0, APART) == 0.0
    assert contrast_left(1000.0, APART) == 0.0
    assert contrast_left(100.0, 1e-5) == pytest.approx(44.04, abs=0.01)
