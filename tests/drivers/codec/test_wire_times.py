"""Durations on each wire, by hand from the frames of the pages for vendors."""

import pytest

from drivers.codec.modbus.timing import ModbusTimes
from drivers.registry import open_backend

SERIAL, RTU, CAN = "serial:///dev/x?baud={}", "modbus+rtu:///dev/x?baud={}", "can+socketcan://can0"
GAP = 0.00175  # s of silence between RTU frames above 19 200 baud, by the standard


@pytest.mark.parametrize(
    ("url", "round_trip", "commit", "loading"),  # [s] of four channels; of two knots
    [
        # bytes of ten bits, there and back
        (SERIAL.format(115_200), 1000 / 115_200, 160 / 115_200, 380 / 115_200),
        (SERIAL.format(9600), 1000 / 9600, 160 / 9600, 380 / 9600),
        # bytes of eleven bits, and silences: 57 and 47 bytes, 19, 29 and 13
        (
            RTU.format(115_200),
            1144 / 115_200 + 2 * GAP,
            209 / 115_200 + GAP,
            462 / 115_200 + 2 * GAP,
        ),
        (RTU.format(9600), 111 * 11 / 9600, 22.5 * 11 / 9600, 49 * 11 / 9600),
        ("modbus+tcp://h/1?baud=9600", 111 * 11 / 9600, 22.5 * 11 / 9600, 49 * 11 / 9600),
        # frames of 135 bits with worst stuffing; two segments and five frames
        (CAN, 6 * 135 / 500_000, 135 / 500_000, 7 * 135 / 500_000),
        # unknown speed
        *(
            (url, 0.0, 0.0, 0.0)
            for url in ("serial+tcp://box:4001", "modbus+tcp://h/1", "sim://r.yaml")
        ),
    ],
)
def test_wire_times_follow_from_the_url(
    url: str, round_trip: float, commit: float, loading: float
) -> None:
    """Apply with its reply, commit, and envelope with its reply."""
    times = open_backend(url).wire_times
    assert times.round_trip(4) == pytest.approx(round_trip)
    assert times.commit() == pytest.approx(commit)
    assert times.loading(2) == pytest.approx(loading)


def test_can_fd_is_faster_and_rtu_keeps_silent() -> None:
    """One CAN FD frame per set; 3.5 characters, and never less than the standard's gap."""
    assert open_backend(f"{CAN}?fd=2000000").wire_times.round_trip(4) < 0.6e-3
    assert ModbusTimes(9600).silence == pytest.approx(3.5 * 11 / 9600)
    assert ModbusTimes(115_200).silence == GAP
