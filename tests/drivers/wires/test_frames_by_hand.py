"""A request and its reply on each wire, as bytes worked out by hand from docs/reference.

The checksums of RTU are by the loop over bits of its standard; here 123456789 has 374B.
"""

import pytest

from drivers.protocol.records import Values
from drivers.wires.can_bus.canopen import CanFrame
from drivers.wires.can_bus.frames import pack_frames
from drivers.wires.can_bus.host import CanWire
from drivers.wires.modbus.host import ModbusWire
from drivers.wires.serial_line.host import SerialWire
from drivers.wires.wire import More, Reply, Wire

STATUS: Values = {
    **{"state": 4, "fault": 0, "flags": 1, "latch": 0, "watchdog_left": 250, "temperature": 250},
    **{"high_voltage": 1800, "token": 0x0102, "channels": 4, "layers": 8},
    **{"levels": [3300, 3200, 3600, 1800], "tokens": [0x0102] * 4 + [0] * 4},
}
"""Armed, 25 °C, 1800 V; four layers of the set 0102 have just begun."""
REGISTERS = (
    "0004 0000 0001 0000 00FA 00FA 0708 0102 0408 0CE4 0C80 0E10 0708 "
    "0102 0102 0102 0102 0000 0000 0000 0000"
)
CAN_REPLY = """
    181 09 00 06 15 04 00 00 00
    181 09 01 01 00 00 00 FA 00
    181 09 02 FA 00 08 07 02 01
    181 09 03 08 04 E4 0C 80 0C
    181 09 04 10 0E 08 07 02 01
    181 09 05 02 01 02 01 02 01
    181 09 06 00 00 00 00 00 00
    181 09 07 00 00 00 00 00 00
"""
TALKS: dict[str, tuple[Wire, tuple[str, ...]]] = {
    "serial": (
        SerialWire(921_600, sequence=8),
        (
            "00 05 06 03 01 09 09 17 2A 02 01 BF CE C1 27 00",
            "00 05 86 03 01 09 02 04 01 01 02 01 01 01 02 FA 02 FA 17 08 07 02 01 08 04 E4 0C 80 "
            "0C 10 0E 08 07 02 01 02 01 02 01 02 01 01 01 01 01 01 01 01 05 50 F0 CE 55 00",
        ),
    ),
    "tcp": (
        ModbusWire(0, is_rtu=False, number=2),
        (
            "0003 0000 000D 01 10 0600 0003 06 0003 2A17 0102",
            "0003 0000 0006 01 10 0600 0003",
            "0004 0000 0006 01 04 0680 002B",
            f"0004 0000 0059 01 04 56 0003 0000 {REGISTERS} {'0000 ' * 20}",
        ),
    ),
    "rtu": (
        ModbusWire(115_200, is_rtu=True, number=0),
        (
            "01 10 0600 0003 06 0001 2A17 0102 FD85",
            "01 10 0600 0003 8080",
            "01 04 0680 002B B175",
            f"01 04 56 0001 0000 {REGISTERS} {'0000 ' * 20} 60D1",
        ),
    ),
    "can": (CanWire(500_000, sequence=8), ("201 09 00 06 02 17 2A 02 01", CAN_REPLY)),
}


def as_bytes(kind: str, text: str) -> bytes:
    """Bytes in hexadecimal; on CAN a frame a line, its identifier first."""
    if kind != "can":
        return bytes.fromhex(text)
    lines = [each.strip() for each in text.strip().splitlines()]
    return pack_frames([CanFrame(int(each[:3], 16), bytes.fromhex(each[4:])) for each in lines])


@pytest.mark.parametrize("kind", TALKS)
def test_commit_and_its_status_are_the_bytes_of_the_specification(kind: str) -> None:
    """Session 2A17, token 0102; the wire sends these bytes and reads that status."""
    wire, pieces = TALKS[kind]
    sent, *rest = [as_bytes(kind, each) for each in pieces]
    assert wire.request(1, "Commit", {"session": 0x2A17, "token": 0x0102}) == sent
    if len(rest) > 1:
        echo, read, _ = rest
        assert wire.received(echo) == [More(read)]
    assert wire.received(rest[-1]) == [Reply(STATUS)]
