"""CAN on a serial adapter: can+slcan:///dev/ttyACM0?bitrate=500000#NODE, or on HOST:PORT."""

from collections.abc import Callable

from drivers.codec.can_bus.adapter_text import SlcanReader, slcan_line
from drivers.errors import CommandError
from drivers.hardware import Port
from drivers.ports.opening import open_port
from drivers.ports.tcp import open_connection
from drivers.wires.can_address import CanAddress
from drivers.wires.text_port import TextPort

_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
_CLOSE = b"\rC\r"


class SlcanAddress(CanAddress):
    """A node behind a serial adapter with LAWICEL's commands, on a port or behind a TCP port."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        if self.bus.bitrate not in _RATES:
            rates = ", ".join(map(str, _RATES))
            raise CommandError(f"{url!r}: bitrate must be one of {rates}, got {self.bus.bitrate}")

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port, and the adapter's channel at the bit rate; raises LinkError."""
        port = TextPort(SlcanReader(), slcan_line, on_data, cut_off=b"\r", goodbye=_CLOSE)
        if self.bus.host:
            port.below = await open_connection(self.bus.host, self.bus.port, port.received, on_loss)
        else:
            name, baud = self.bus.channel, self.bus.baud
            port.below = await open_port(name, baud=baud, on_data=port.received, on_loss=on_loss)
        # Closed first, where an earlier host has left it open.
        port.below.write(_CLOSE + b"S%d\rO\r" % _RATES.index(self.bus.bitrate))
        return port
