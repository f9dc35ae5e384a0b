"""Wires by the scheme of a URL: those of this project, and entry points of installed packages.

Entry points are of the group `era_haptics.wires`, named by scheme; each is a class derived from
`WireAddress`, and made with the URL.
"""

from collections.abc import Callable

from drivers.errors import CommandError
from drivers.wires.can_bus import PythonCanAddress, SlcanAddress, SocketcandAddress
from drivers.wires.modbus import ModbusAddress
from drivers.wires.serial_line import SerialAddress
from drivers.wires.wire import WireAddress
from registry.plugins import PluginRegistry

_WIRES: PluginRegistry[Callable[[str], WireAddress]] = PluginRegistry(
    "wire",
    "era_haptics.wires",
    WireAddress,
    error=CommandError,
    own={
        "can+python-can": PythonCanAddress,
        "can+slcan": SlcanAddress,
        "can+socketcan": PythonCanAddress,
        "can+socketcand": SocketcandAddress,
        "modbus+rtu": ModbusAddress,
        "modbus+tcp": ModbusAddress,
        "serial": SerialAddress,
        "serial+tcp": SerialAddress,
        "sim": "sim.memory_line:SimulatedAddress",
    },
    ending="://",
    example="serial:///dev/ttyUSB0?baud=921600",
)


def address_of(url: str) -> WireAddress:
    """Parse the URL of an amplifier; CommandError for an unknown or invalid one."""
    return _WIRES.make(url)
