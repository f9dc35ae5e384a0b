"""Modbus: modbus+tcp://HOST:PORT/UNIT and modbus+rtu:///dev/ttyS1?baud=115200#UNIT."""

import random
from collections.abc import Callable
from dataclasses import replace

from drivers.hardware import Port
from drivers.host.modbus_wire import ModbusWire
from drivers.host.wire import NETWORK_DELAY
from drivers.ports.opening import open_port
from drivers.urls import ADDRESS, ADDRESS_MAX, RTU_BAUD, AmplifierUrl
from drivers.wires.address import WireAddress
from drivers.wires.silent_port import SilentPort

_TCP_FORM = "modbus+tcp://HOST:PORT/UNIT (behind a gateway: ?baud=19200, that of its line)"
_RTU_FORM = "modbus+rtu:///dev/ttyS1?baud=115200#UNIT or modbus+rtu://HOST:PORT#UNIT"
_TCP_PORT = 502
_PARITIES = {"even": "E", "odd": "O", "none": "N"}


class ModbusAddress(WireAddress):
    """A unit over TCP, on a serial port of this machine, or behind a serial server."""

    def __init__(self, url: str) -> None:
        self._is_rtu = url.lower().startswith("modbus+rtu")
        if self._is_rtu:
            parsed = AmplifierUrl(url, _RTU_FORM, known=("baud", "parity", "stop"))
            place = parsed.server() if parsed.place else parsed.device(RTU_BAUD)
            unit = parsed.number
        else:
            parsed = AmplifierUrl(url, _TCP_FORM, known=("baud",))
            if parsed.number:
                raise parsed.refused("unit must follow the host")
            place, unit = parsed.server(port=_TCP_PORT, has_path=True), parsed.path.strip("/")
        parity = parsed.options.get("parity", "even")
        if parity not in _PARITIES:
            raise parsed.refused(f"parity must be one of {', '.join(_PARITIES)}, got {parity!r}")
        stop = parsed.whole_option("stop", 1, 2)
        self.place = replace(place, parity=_PARITIES[parity], stop=stop)
        self.number = parsed.whole(unit, "unit", ADDRESS_MAX) if unit else ADDRESS
        self.line = self.place.name
        self.settings = {
            "protocol": "Modbus RTU" if self._is_rtu else "Modbus TCP",
            "baud": self.place.baud,
            "parity": self.place.parity,
            "stop": self.place.stop,
        }

    def make_wire(self) -> ModbusWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        delay = 0.0 if self.place.device else NETWORK_DELAY
        number = random.getrandbits(16)
        return ModbusWire(self.place.baud, is_rtu=self._is_rtu, number=number, delay=delay)

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        if not self.place.device:
            return await open_port(self.place, on_data, on_loss)
        port = SilentPort(self.make_wire().silence, self.place.byte_time, on_data)
        port.below = await open_port(self.place, port.received, on_loss)
        return port
