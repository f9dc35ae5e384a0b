"""Interfaces for additional wires to amplifiers: entry points `era_haptics.wires`.

A wire consists of an address parsed from a URL, a byte port, and one of the three byte protocols or
its own frames. A `CanWire` sends and receives frames in the format of `pack_frames` and
`unpack_frames`.
"""

from drivers.errors import CommandError, LinkError, WireCounters
from drivers.ports import NETWORK_DELAY, Port
from drivers.protocol.definition import REQUESTS
from drivers.protocol.records import Values
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Arrival, Wire, WireAddress, read_event, read_reply

__all__ = [
    "NETWORK_DELAY",
    "REQUESTS",
    "Arrival",
    "CanFrame",
    "CanWire",
    "CommandError",
    "LinkError",
    "ModbusWire",
    "Port",
    "SerialWire",
    "Values",
    "Wire",
    "WireAddress",
    "WireCounters",
    "pack_frames",
    "read_event",
    "read_reply",
    "unpack_frames",
]
