"""Modbus: modbus+tcp://HOST:PORT/UNIT and modbus+rtu:///dev/ttyS1?baud=115200#UNIT."""

from collections.abc import Callable

from drivers.hardware import Port, number_below
from drivers.host.modbus_wire import ModbusWire
from drivers.host.wire import NETWORK_DELAY
from drivers.ports.opening import open_port
from drivers.ports.tcp import open_connection
from drivers.urls.modbus import ModbusUrl
from drivers.wires.address import WireAddress
from drivers.wires.silent_port import SilentPort

_WRITE = 9 + 8  # bytes of a write of no registers on RTU, and of its response
_READ = 8 + 5  # of a read, and of its response of no registers


class ModbusAddress(WireAddress):
    """A unit over TCP, on a serial port of this machine, or behind a serial server."""

    def __init__(self, url: str) -> None:
        parsed = ModbusUrl.parse(url)
        self.line, self.number = parsed.endpoint, parsed.unit
        self.settings = {
            "protocol": "Modbus RTU" if parsed.is_rtu else "Modbus TCP",
            "baud": parsed.baud,
            "parity": parsed.parity,
            "stop": parsed.stop,
        }
        self._url = parsed

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and its reply of so many words take [s]; 0 over a network.

        A write and a read, each with its response: with the silences before all four frames.
        """
        if not self._url.baud:
            return 0.0
        count = _WRITE + _READ + 2 * (words + 1 + reply + 2)  # tag; tag and result
        return self._url.bits_per_byte * count / self._url.baud + 4 * self.make_wire().silence

    def make_wire(self) -> ModbusWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        url = self._url
        delay = 0.0 if url.device else NETWORK_DELAY
        number = number_below(1 << 16)
        return ModbusWire(url.baud, is_rtu=url.is_rtu, number=number, delay=delay)

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        url = self._url
        if not url.device:
            return await open_connection(url.host, url.port, on_data, on_loss)
        port = SilentPort(self.make_wire().silence, url.bits_per_byte / url.baud, on_data)
        await port.open(
            lambda heard: open_port(
                url.device,
                baud=url.baud,
                parity=url.parity,
                stop=url.stop,
                on_data=heard,
                on_loss=on_loss,
            )
        )
        return port
