"""Raw access by the URL of an amplifier."""

from collections.abc import Callable, Mapping

from drivers.backend import Backend
from drivers.backends.can_bus.backend import CanBackend
from drivers.backends.modbus.backend import ModbusBackend
from drivers.backends.serial_line.backend import SerialBackend
from drivers.conformance.raw.can_bus import CanRaw
from drivers.conformance.raw.line import RawLine
from drivers.conformance.raw.modbus import ModbusRaw
from drivers.conformance.raw.serial_line import SerialRaw
from drivers.registry import open_backend

_RAW: Mapping[type[Backend], Callable[[str], RawLine]] = {
    SerialBackend: SerialRaw,
    ModbusBackend: ModbusRaw,
    CanBackend: CanRaw,
}


def raw_line(url: str) -> RawLine | None:
    """Make raw access to the line of an amplifier that is open in this event loop, if it can be."""
    make = _RAW.get(type(open_backend(url)))
    return make(url) if make else None
