"""CAN on a serial adapter: can+slcan:///dev/ttyACM0?bitrate=500000#NODE, or on HOST:PORT."""

from collections.abc import Callable

from drivers.codec.can_bus.adapter_text import SLCAN, SLCAN_RATES
from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.host.wire import NETWORK_DELAY
from drivers.ports.opening import open_port
from drivers.urls import AmplifierUrl
from drivers.wires.can_address import CanAddress
from drivers.wires.text_port import TextPort

_FORM = "can+slcan:///dev/ttyACM0?bitrate=500000#NODE or can+slcan://HOST:PORT#NODE"
_BAUD = 115_200  # of the adapter's serial port
_CLOSE = b"\rC\r"


class SlcanAddress(CanAddress):
    """A node behind a serial adapter with LAWICEL's commands, on a port or behind a TCP port."""

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _FORM, known=("bitrate", "baud"))
        self.place = parsed.server() if parsed.place else parsed.device(_BAUD)
        super().__init__(
            parsed,
            f"can+slcan://{self.place.name}",
            delay=NETWORK_DELAY if self.place.host else 0.0,
            settings={"baud": self.place.baud},
        )
        if self.bitrate not in SLCAN_RATES:
            raise parsed.refused(f"bitrate must be one of {', '.join(map(str, SLCAN_RATES))}")

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port, and the adapter's channel at the bit rate; raises LinkError."""
        port = TextPort(SLCAN, on_data, cut_off=b"\r", goodbye=_CLOSE)
        port.below = await open_port(self.place, port.received, on_loss)
        # Closed first, where an earlier host has left it open.
        try:
            port.below.write(_CLOSE + b"S%d\rO\r" % SLCAN_RATES.index(self.bitrate))
        except LinkError:
            port.close()
            await port.wait_closed()
            raise
        return port
