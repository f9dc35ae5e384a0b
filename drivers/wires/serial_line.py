"""Serial lines: serial:///dev/ttyUSB0?baud=921600&address=1 and serial+tcp://HOST:PORT."""

from collections.abc import Callable

from drivers.codec.serial_line.frame import frame_length
from drivers.hardware import Port, number_below
from drivers.host.serial_wire import SerialWire
from drivers.ports.opening import open_port
from drivers.urls.serial_line import SerialUrl
from drivers.wires.address import WireAddress

_BITS = 10  # of a byte, with start and stop


class SerialAddress(WireAddress):
    """An amplifier on a serial port of this machine, or behind a serial server."""

    def __init__(self, url: str) -> None:
        parsed = SerialUrl.parse(url)
        self.line, self.number = parsed.port, parsed.address
        self.settings = {"protocol": "serial", "baud": parsed.baud}
        self._url = parsed

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and its reply of so many words take [s]; 0 behind a server."""
        count = frame_length(2 * words) + frame_length(2 * reply)
        return _BITS * count / self._url.baud if self._url.is_local else 0.0

    def make_wire(self) -> SerialWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        baud = self._url.baud if self._url.is_local else 0
        return SerialWire(baud, sequence=number_below(1 << 16))

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        return await open_port(self.line, baud=self._url.baud, on_data=on_data, on_loss=on_loss)
