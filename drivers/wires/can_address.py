"""Nodes on a CAN bus, whatever the adapter; frames come and go packed.

How they are packed: `drivers.codec.can_bus.segments`.
"""

from drivers.codec.can_bus.canopen import frame_time
from drivers.codec.can_bus.segments import NUMBER_MAX, frames_of
from drivers.hardware import number_below
from drivers.host.can_wire import CanWire
from drivers.host.wire import NETWORK_DELAY
from drivers.urls.can_bus import CanBusUrl, CanUrl
from drivers.wires.address import WireAddress


class CanAddress(WireAddress):
    """A node on a CAN bus; its kinds differ in how the bus is opened."""

    def __init__(self, url: str) -> None:
        parsed = CanUrl.parse(url)
        self.bus: CanBusUrl = parsed.bus
        self.line, self.number = str(parsed.bus), parsed.node
        self.settings = {
            "protocol": "CAN",
            "bitrate": parsed.bus.bitrate,
            "baud": parsed.bus.baud,
            "options": parsed.bus.options,
        }

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and its reply of so many words take [s]."""
        return (frames_of(words) + frames_of(reply)) * frame_time(self.bus.bitrate)

    def make_wire(self) -> CanWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        delay = NETWORK_DELAY if self.bus.host else 0.0
        return CanWire(self.bus.bitrate, sequence=number_below(NUMBER_MAX + 1), delay=delay)
