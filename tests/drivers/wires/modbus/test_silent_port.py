"""Silence before each frame of Modbus RTU, in virtual time."""

import asyncio
from itertools import pairwise

import pytest

from drivers.wires.modbus import ModbusWire, SilentPort
from virtual_lines import in_virtual_time

BYTE = 11 / 19_200  # s
SILENCE = 3.5 * BYTE  # Modbus over serial line V1.02, 2.5.1.1


class Below:
    """A port that keeps when what was written."""

    is_blocked = False

    def __init__(self) -> None:
        self.sent: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        self.sent.append((asyncio.get_running_loop().time(), data))

    def poll(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    async def wait_closed(self) -> None:
        """Return at once."""


async def opened() -> tuple[SilentPort, Below]:
    """A port at 19 200 baud."""
    assert ModbusWire(19_200, is_rtu=True, number=0).silence == pytest.approx(SILENCE)
    below = Below()
    port = SilentPort(SILENCE, BYTE, lambda data: None)
    port.below = below
    await asyncio.sleep(1.0)
    return port, below


@in_virtual_time
async def test_frame_waits_for_the_line_to_be_silent() -> None:
    """After a frame of 8 bytes for 11.5 characters, after what is heard for 3.5 from there on."""
    port, below = await opened()
    loop = asyncio.get_running_loop()
    port.write(b"\1first")
    port.write(b"\0second ")
    port.write(b"\1third")
    await asyncio.sleep(0.1)
    assert [data for _, data in below.sent] == [b"\1first", b"\0second ", b"\1third"]
    (first, _), (second, _), (third, _) = below.sent
    assert second - first == pytest.approx((6 + 3.5) * BYTE)
    assert third - second == pytest.approx((8 + 3.5) * BYTE)
    port.received(b"reply")
    heard = loop.time()
    port.write(b"\1fourth")
    await asyncio.sleep(0.1)
    assert below.sent[-1][0] - heard == pytest.approx(SILENCE)


@in_virtual_time
async def test_newer_request_replaces_one_that_waits_but_no_broadcast() -> None:
    """A stop need not wait behind the request that it has preempted."""
    port, below = await opened()
    for frame in (b"\1first", b"\0commit", b"\1read", b"\1stop"):
        port.write(frame)
    await asyncio.sleep(0.1)
    assert [data for _, data in below.sent] == [b"\1first", b"\0commit", b"\1stop"]
    assert all(after > before for (before, _), (after, _) in pairwise(below.sent))


@in_virtual_time
async def test_noise_does_not_keep_a_stop_waiting_for_ever() -> None:
    """It goes after the longest frame, of 256 characters, and one that follows after that."""
    port, below = await opened()
    loop = asyncio.get_running_loop()
    begin = loop.time()
    port.received(b"?")
    port.write(b"\0stops")
    port.write(b"\1stop")
    while len(below.sent) < 2:
        assert loop.time() < begin + 1.0
        await asyncio.sleep(BYTE)
        port.received(b"?")
    (first, _), (second, _) = below.sent
    assert first - begin == pytest.approx((256 + 3.5) * BYTE, abs=BYTE)
    assert second - first == pytest.approx((6 + 3.5) * BYTE)
