"""A CAN bus shared by the amplifiers of a process; `canopen` dispatches its frames.

The network is fed here and not by python-can's Notifier, which spins on a lost adapter. Callbacks
run in the adapter's thread.
"""

import asyncio
import logging
import time
from collections.abc import Sequence

import canopen

from drivers import clock, trace
from drivers.backends.can_bus.adapter import FULL_PAUSE, open_adapter
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.codec.can_bus.frame import CanFrame, meaning
from drivers.errors import LinkTimeout
from drivers.hardware import Adapter
from drivers.trace import Direction
from drivers.urls.can_bus import CanBusUrl

# Its messages become LinkErrors.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_FULL = (
    "transmit queue full; check that another node acknowledges on the bus, its load, and "
    "txqueuelen of the interface"
)
_FULL_TRIES = 60  # with their pauses the usual timeout of a reply

_logger = logging.getLogger(__name__)


class _Network(canopen.Network):
    """A `canopen` network that sends through the bus."""

    def __init__(self, bus: "CanBus") -> None:
        super().__init__()
        self._bus = bus

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._bus.send_blocking(CanFrame(can_id, bytes(data)))


class CanBus(SharedLine[Adapter]):
    """A bus, numbered by nodes; see `can_bus`."""

    address_term = "node"

    def __init__(self, url: CanBusUrl) -> None:
        super().__init__(str(url))
        self.url = url
        self.network = _Network(self)
        self._waiting_stops = 0

    async def send(
        self, frames: Sequence[CanFrame], *, timeout: float, is_stop: bool = False
    ) -> None:
        """Send frames back to back, those of stops first while the transmit queue is full.

        Waits for it until a timeout [s]; cancelling leaves the rest unsent. Raises LinkError.
        """
        deadline = clock.now() + timeout
        self._waiting_stops += is_stop
        try:
            while True:
                if is_stop or not self._waiting_stops:
                    frames = frames[self._send_some(frames) :]
                    if not frames:
                        return
                if clock.now() >= deadline:
                    raise LinkTimeout(f"{self.name}: {_FULL}")
                await asyncio.sleep(FULL_PAUSE)
        finally:
            self._waiting_stops -= is_stop

    def send_blocking(self, frame: CanFrame) -> None:
        """Send one frame from a thread; raises LinkError."""
        for _ in range(_FULL_TRIES):
            if self._send_some([frame]):
                return
            time.sleep(FULL_PAUSE)
        raise LinkTimeout(f"{self.name}: {_FULL}")

    def _send_some(self, frames: Sequence[CanFrame]) -> int:
        """Send frames while the transmit queue has room; returns their number."""
        taken = self._ready().send(frames)
        for frame in frames[:taken]:
            self._trace(Direction.OUT, frame)
        return taken

    def _trace(self, direction: Direction, frame: CanFrame) -> None:
        if trace.is_active():
            where = f"{self.name} {frame.id:03x}"
            trace.frame(direction, frame.data, where, lambda: meaning(frame))

    async def _open(self) -> Adapter:
        return await open_adapter(self.url, on_frame=self._received, on_loss=self._lose)

    def _received(self, frame: CanFrame) -> None:
        """Pass a frame on, in the adapter's thread."""
        try:
            self._trace(Direction.IN, frame)
            self.network.notify(frame.id, bytearray(frame.data), clock.now())
        except Exception:  # a frame of another device must not end the reader
            _logger.debug("%s: frame %03x raised an exception", self.name, frame.id, exc_info=True)


def can_bus(url: CanBusUrl) -> CanBus:
    """Return the bus of a URL in the running event loop."""
    return shared_line(CanBus, url, lambda: CanBus(url))
