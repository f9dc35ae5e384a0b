"""Replies that are missing, late or replaced by other bytes, and the causes that errors name."""

import asyncio
import re

import pytest

from drivers.errors import LinkTimeout
from drivers.host.requests import Job, Priority
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, encode_frame
from kit.clock import MemoryLine, in_virtual_time, unaltered


@in_virtual_time
async def test_status_is_awaited_when_the_response_to_its_write_was_found_late() -> None:
    """Modbus: only the last look at the port finds that response; the status comes 20 ms later."""
    line = MemoryLine("tcp", "a")
    host = line.hosts["a"]
    await host.open()
    unread: list[bytes] = []

    def poll() -> None:
        line.outward = lambda _, data: [(0.02, data)]
        while unread:
            line.line.received(unread.pop())

    def keep(_: str, data: bytes) -> list[tuple[float, bytes]]:
        unread.append(data)
        return []

    line.poll = poll  # type: ignore[method-assign]
    line.outward = keep

    await host.read_status()

    assert host.counts.retries == 0


def can_frames(*frames: tuple[int, bytes]) -> bytes:
    """Return frames of identifiers and data, as a port of frames has them."""
    return pack_frames(CanFrame(identifier, data) for identifier, data in frames)


@pytest.mark.parametrize(
    ("wire", "prefix", "replacement", "cause"),
    [
        ("serial", 0, b"\xf8\x80" * 9, "bytes .*f8 80.*baud rate"),
        ("serial", 0, encode_frame(Frame(9, 1, 4, b"", 3)), "request itself came back"),
        ("serial", 0, encode_frame(Frame(0x89, 1, 3, b"", 3)), "to another request.*delays"),
        ("rtu", 0, b"\xf8\x80" * 9, "18 bytes .*f8 80.*parity"),
        ("rtu", 0, bytes.fromhex("02 90 01 7d c0"), "unit 2.*check the unit"),
        ("tcp", 0, bytes.fromhex("00 00 00 00 00 03 01 90 01"), "transaction 0, unit 1.*gateway"),
        ("tcp", 5, bytes.fromhex("03 ff 90 01"), "unit 255.*check the unit"),
        ("tcp", 5, bytes.fromhex("03 01 90 0a"), "no path to unit 1"),
        ("tcp", 5, bytes.fromhex("03 01 90 0b"), "no response of unit 1"),
        ("tcp", 0, b"\1\x10\x09\0\0\1\2\x55", r"Modbus TCP.*modbus\+rtu"),
        ("can", 0, can_frames((0x800, b"\xf8")), r"\(f8\).*baud rate"),
        ("can", 0, can_frames((0x705, b"\5")), "node 5 came .* of node 1:"),
        ("can", 0, can_frames((0x701, b"\5"), (0x702, b"\5")), "node 1 came in place of"),
        ("can", 0, can_frames((0x800, b"\7")), r"adapter .*\(07\).*termination"),
    ],
)
@in_virtual_time
async def test_missing_reply_is_explained_by_the_bytes_in_its_place(
    wire: str, prefix: int, replacement: bytes, cause: str
) -> None:
    """So many bytes of the reply precede the replacement; the error names what to check."""
    line = MemoryLine(wire, "a")
    host = line.hosts["a"]
    await host.open()
    line.outward = lambda _, data: [(0.0002, data[:prefix] + replacement)]
    with pytest.raises(LinkTimeout, match=cause):
        await host.read_status()
    assert host.no_reply_cause
    assert re.search(cause, host.no_reply_cause)

    line.outward = unaltered
    await host.read_status()

    assert host.no_reply_cause is None


@pytest.mark.parametrize(("wire", "cause"), [("serial", "flow control"), ("can", "acknowledges")])
@in_virtual_time
async def test_blocked_port_is_explained_by_its_wire(wire: str, cause: str) -> None:
    """A bus on which no node acknowledges fills the queue of its adapter."""
    line = MemoryLine(wire, "a")
    line.is_blocked = True
    line.inward = lambda *_: []

    with pytest.raises(LinkTimeout, match=cause):
        await line.hosts["a"].open()


async def test_stop_supersedes_requests_that_feed_play_arm_or_acknowledge() -> None:
    """Requests that only read continue to wait."""
    superseded = set()
    for priority in Priority:
        result = asyncio.get_running_loop().create_future()
        job = Job(None, priority, "", 0.03, 0.0, result=result)
        if job.is_superseded_by(Priority.STOP, None):
            superseded.add(priority)

    assert superseded == {Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR}
