"""A request and its reply on each wire, as bytes worked out by hand from docs/reference.

The checksums are by other programs: zlib and `cobs`, and the loop over bits of Modbus.
"""

import pytest

from drivers.protocol.records import Values
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import More, Reply, Wire

PART: Values = {
    **{"session": 0x2A17, "token": 0x0102, "index": 0, "parts": 1, "now": 1},
    "stream": [0x01A0, 0, 800],
}
"""A Set that is played at once: layer 3 is renewed for 800 ms."""
TAKEN: Values = {"token": 0x0102, "exact": 1, "staged": 0, "played": 1, "missing": 0}
TALKS: dict[str, tuple[Wire, tuple[str, ...]]] = {
    "serial": (
        SerialWire(921_600, sequence=7),
        (
            "00 05 05 04 01 08 06 17 2A 02 01 03 03 A0 01 01 07 20 03 93 C9 91 CA 00",
            "00 05 85 04 01 08 04 02 01 05 01 01 05 34 FF 32 E7 00",
        ),
    ),
    "tcp": (
        ModbusWire(0, is_rtu=False, number=0),
        (
            "0001 0000 0015 01 10 0500 0007 0E 0001 2A17 0102 0003 01A0 0000 0320"
            "0002 0000 0006 01 04 0580 0005",
            "0001 0000 0006 01 10 0500 0007",
            "0002 0000 000D 01 04 0A 0001 0000 0102 0005 0000",
        ),
    ),
    "rtu": (
        ModbusWire(115_200, is_rtu=True, number=0),
        (
            "01 10 0500 0007 0E 0001 2A17 0102 0003 01A0 0000 0320 E774",
            "01 10 0500 0007 8107",
            "01 04 0580 0005 312D",
            "01 04 0A 0001 0000 0102 0005 0000 B4FD",
        ),
    ),
    "can": (
        CanWire(500_000, sequence=7),
        (
            "201 0800 0506 172A 0201 · 201 0801 0300 A001 0000 · 201 0802 2003 0000 0000",
            "181 0800 0503 0201 0500 · 181 0801 0000 0000 0000",
        ),
    ),
}


def as_bytes(kind: str, text: str) -> bytes:
    """Bytes in hexadecimal; of a frame on CAN its identifier comes first."""
    if kind != "can":
        return bytes.fromhex(text)
    return pack_frames(
        CanFrame(int(each[:3], 16), bytes.fromhex(each[4:])) for each in text.split(" · ")
    )


@pytest.mark.parametrize("kind", TALKS)
def test_part_of_a_set_and_its_reply_are_the_bytes_of_the_specification(kind: str) -> None:
    """The wire sends these bytes and reads that reply.

    On Modbus twice: over TCP together, on RTU once the first have their response.
    """
    wire, pieces = TALKS[kind]
    sent, *between, reply = [as_bytes(kind, each) for each in pieces]
    assert wire.request(1, "Set", PART) == sent
    if between:
        echo, *read = between
        assert wire.received(echo) == [*map(More, read)]
    assert wire.received(reply) == [Reply(TAKEN)]
