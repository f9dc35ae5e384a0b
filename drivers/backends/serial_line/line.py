"""A serial port shared by all amplifiers on it."""

from collections.abc import Callable

from drivers import trace
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.codec.serial_line.frame import Frame, FrameReader
from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.ports.opening import open_port
from drivers.trace import Direction


class SerialLine(SharedLine[Port]):
    """A port, named as in pyserial, at a speed [baud]; see `serial_line`."""

    address_term = "address"

    def __init__(self, port: str, *, baud: int) -> None:
        super().__init__(port)
        self.baud = baud
        self._reader = self._make_reader()
        self._listeners: dict[int, Callable[[Frame], None]] = {}

    @property
    def invalid_frames(self) -> int:
        """Number of invalid frames received."""
        return self._reader.counters.invalid_frames

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""
        return self._ready().is_blocked

    def listen(self, address: int, on_frame: Callable[[Frame], None] | None) -> None:
        """Set the callback for frames from an address; None removes it."""
        if on_frame is None:
            self._listeners.pop(address, None)
        else:
            self._listeners[address] = on_frame

    def send(self, data: bytes) -> None:
        """Send a frame, as soon as the port takes it; raises LinkError."""
        self._ready().write(data)

    async def _open(self) -> Port:
        self._reader = self._make_reader()
        return await open_port(
            self.name, baud=self.baud, on_data=self._received, on_loss=self._lose
        )

    def _make_reader(self) -> FrameReader:
        return FrameReader(
            on_invalid=lambda piece: trace.frame(Direction.IN, piece, self.name, lambda: "damaged")
        )

    def _received(self, data: bytes) -> None:
        if self.tap is not None:
            self.tap(data)
        for frame in self._reader.feed(data):
            # A frame without a listener goes to one that counts it as unexpected.
            listener = self._listeners.get(frame.address) or next(
                iter(self._listeners.values()), None
            )
            if listener is not None:
                listener(frame)


def serial_line(port: str, *, baud: int) -> SerialLine:
    """Return the line of a port in the running event loop; LinkError for another speed."""
    line = shared_line(SerialLine, port, lambda: SerialLine(port, baud=baud))
    if line.baud != baud:
        raise LinkError(
            f"serial port {port}: baud must be {line.baud} as for the other amplifiers on it, got "
            f"{baud}"
        )
    return line
