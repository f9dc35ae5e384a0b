"""Serial lines: serial:///dev/ttyUSB0?baud=921600&address=1, on a server serial+tcp://HOST:PORT."""

import random
from collections.abc import Callable

from drivers.ports.port import Port
from drivers.ports.serial_port import open_port
from drivers.protocol.timing import BOOT_TIME
from drivers.urls import ADDRESS, ADDRESS_MAX, BAUD, AmplifierUrl
from drivers.wires.address import WireAddress
from drivers.wires.serial_line.host import SerialWire
from drivers.wires.wire import NETWORK_DELAY

_FORM = (
    "serial:///dev/ttyUSB0?baud=921600&address=1, or serial+tcp://HOST:PORT?baud=921600&address=1 "
    "for a serial server"
)


class SerialAddress(WireAddress):
    """An amplifier on a serial port of this machine, or behind a serial server."""

    boot_time = BOOT_TIME

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _FORM, known=("baud", "address"))
        number = "address must be given as ?address={}"
        parsed.require(not parsed.number, number.format(parsed.number))
        is_server = parsed.scheme == "serial+tcp"
        self.place = parsed.server(number=number) if is_server else parsed.device(BAUD)
        self.number = parsed.whole_option("address", ADDRESS, ADDRESS_MAX)
        self.line = self.place.name
        self.settings = {"protocol": "serial", "baud": self.place.baud}

    def make_wire(self) -> SerialWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        delay = 0.0 if self.place.device else NETWORK_DELAY
        return SerialWire(self.place.baud, sequence=random.getrandbits(16), delay=delay)

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        return await open_port(self.place, on_data, on_loss)
