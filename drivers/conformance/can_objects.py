"""Objects of a CAN node, read and written by SDO."""

import asyncio
import struct

from drivers.codec.can_bus.canopen import cob_id
from drivers.conformance.can_frames import CanClient
from drivers.conformance.client import Violation, expect, expect_equal

_ABORT, _UPLOAD, _WRITTEN = 0x80, 0x40, 0x60
_TRIES, _POLL = 500, 0.001  # s


async def _exchange(client: CanClient, data: bytes) -> bytes:
    client.frames.clear()
    client.put(cob_id("sdo_request", client.address), data)
    for _ in range(_TRIES):
        await asyncio.sleep(_POLL)
        if replies := client.data_of("sdo_answer"):
            return replies[0]
    raise Violation("reply to an SDO", expected="one within 0.5 s", seen="none")


async def write_object(
    client: CanClient, index: int, data: bytes, subindex: int = 0, *, is_taken: bool = True
) -> None:
    """Write an object of up to four bytes, which must be taken or refused."""
    command = 0x23 | 4 - len(data) << 2
    answer = await _exchange(client, struct.pack("<BHB4s", command, index, subindex, data))
    required = _WRITTEN if is_taken else _ABORT
    expect_equal(answer[0], required, f"reply to a write of object {index:04x}")


async def read_object(
    client: CanClient, index: int, subindex: int = 0, *, is_there: bool = True
) -> bytes:
    """Read an object, expedited or in segments, which must be there or not; returns its bytes."""
    answer = await _exchange(client, struct.pack("<BHB4x", _UPLOAD, index, subindex))
    what = f"reply to a read of {index:04x}/{subindex}"
    expect_equal(answer[0] & 0xE0, _UPLOAD if is_there else _ABORT, what)
    if answer[0] & 2 or not is_there:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    (size,) = struct.unpack_from("<L", answer, 4)
    data, toggle = b"", 0
    while len(data) < size:
        answer = await _exchange(client, bytes([0x60 | toggle]) + bytes(7))
        is_next = answer[0] & 0xF0 == toggle
        expect(is_next, f"segment of the {what}", expected="the next", seen=answer.hex())
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
    return data
