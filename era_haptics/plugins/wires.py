"""Interfaces for further wires to amplifiers: entry points `era_haptics.wires`.

A wire has an address made of a URL, a port of bytes, and one of the three protocols of bytes; a
`CanWire` takes and gives frames as `pack_frames` and `unpack_frames` have them.
"""

from drivers.errors import CommandError, LinkError
from drivers.ports import Port
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire, WireAddress

__all__ = [
    "CanFrame",
    "CanWire",
    "CommandError",
    "LinkError",
    "ModbusWire",
    "Port",
    "SerialWire",
    "Wire",
    "WireAddress",
    "pack_frames",
    "unpack_frames",
]
