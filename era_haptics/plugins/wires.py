"""Interfaces for further wires to amplifiers: entry points `era_haptics.wires`.

A wire has an address made of a URL, a port of bytes, and one of the three protocols of bytes; a
`CanWire` takes and gives frames as `pack_frames` and `unpack_frames` have them.
"""

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from drivers.errors import CommandError, LinkError
from drivers.hardware import Port
from drivers.host.can_wire import CanWire
from drivers.host.modbus_wire import ModbusWire
from drivers.host.serial_wire import SerialWire
from drivers.host.wire import Wire
from drivers.wires.address import WireAddress

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
