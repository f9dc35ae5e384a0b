"""Nodes on a CAN bus, whatever the adapter; frames come and go packed.

How they are packed: `drivers.codec.can_bus.segments`.
"""

import random
from collections.abc import Mapping

from drivers.codec.can_bus.canopen import BITRATE
from drivers.codec.can_bus.segments import NODE_MAX, NUMBER_MAX
from drivers.host.can_wire import CanWire
from drivers.urls import ADDRESS, AmplifierUrl
from drivers.wires.address import WireAddress

_BITRATES = 10_000, 1_000_000


class CanAddress(WireAddress):
    """A node on a CAN bus; its kinds differ in how the bus is opened.

    line: name of the bus; delay [s]: of a network on the way to it; settings: besides the bit rate.
    """

    def __init__(
        self, url: AmplifierUrl, line: str, *, delay: float = 0.0, settings: Mapping[str, object]
    ) -> None:
        low, high = _BITRATES
        self.bitrate = url.whole_option("bitrate", BITRATE, high, low=low)
        self.line, self._delay = line, delay
        self.number = url.whole(url.number, "node", NODE_MAX) if url.number else ADDRESS
        self.settings = {"protocol": "CAN", "bitrate": self.bitrate, **settings}

    def make_wire(self) -> CanWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        sequence = random.randint(0, NUMBER_MAX)  # noqa: S311  no secret
        return CanWire(self.bitrate, sequence=sequence, delay=self._delay)
