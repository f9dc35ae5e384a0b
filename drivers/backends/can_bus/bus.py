"""A CAN bus shared by the amplifiers of a process; `canopen` dispatches its frames.

The network is fed here and not by python-can's Notifier, which spins on a lost adapter. Callbacks
run in the adapter's thread.
"""

import logging
from collections.abc import Sequence

import canopen

from drivers import clock
from drivers.backends.can_bus.adapter import open_adapter
from drivers.backends.hardware import Adapter
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.backends.urls.can_bus import CanBusUrl
from drivers.codec.can_bus.frame import CanFrame

# Its messages become LinkErrors.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_logger = logging.getLogger(__name__)


class _Network(canopen.Network):
    """A `canopen` network that sends through the bus."""

    def __init__(self, bus: "CanBus") -> None:
        super().__init__()
        self._bus = bus

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._bus.send([CanFrame(can_id, bytes(data))])


class CanBus(SharedLine[Adapter]):
    """A bus, numbered by nodes; see `can_bus`."""

    address_term = "node"

    def __init__(self, url: CanBusUrl) -> None:
        super().__init__(str(url))
        self.url = url
        self.network = _Network(self)

    def send(self, frames: Sequence[CanFrame]) -> None:
        """Send frames back to back; raises LinkError."""
        self._ready().send(frames)

    async def _open(self) -> Adapter:
        return await open_adapter(self.url, on_frame=self._take, on_loss=self._lose)

    def _take(self, frame: CanFrame) -> None:
        """Pass a frame on, in the adapter's thread."""
        try:
            self.network.notify(frame.id, bytearray(frame.data), clock.now())
        except Exception:  # a frame of another device must not end the reader
            _logger.debug("%s: frame %03x raised an exception", self.name, frame.id, exc_info=True)


def can_bus(url: CanBusUrl) -> CanBus:
    """Return the bus of a URL in the running event loop."""
    return shared_line(CanBus, url, lambda: CanBus(url))
