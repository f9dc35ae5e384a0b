"""A serial port shared by all amplifiers on it."""

from collections.abc import Callable

from drivers import clock
from drivers.backends.hardware import Port
from drivers.backends.line_turns import LineTurns
from drivers.backends.ports.opening import open_port
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.codec.serial_line.frame import Frame, FrameReader
from drivers.errors import LinkError


class SerialLine(SharedLine[Port]):
    """A port, named as in pyserial, at a speed [baud]; see `serial_line`.

    turns: arbitrates between amplifiers, since only one may reply at a time.
    """

    address_term = "address"

    def __init__(self, port: str, *, baud: int) -> None:
        super().__init__(port)
        self.baud = baud
        self.turns = LineTurns()
        self.last_sent = 0.0
        self._reader = FrameReader()
        self._listeners: dict[int, Callable[[Frame], None]] = {}

    @property
    def invalid_frames(self) -> int:
        """Number of invalid frames received."""
        return self._reader.counters.invalid_frames

    def listen(self, address: int, on_frame: Callable[[Frame], None] | None) -> None:
        """Set the callback for frames from an address; None removes it."""
        if on_frame is None:
            self._listeners.pop(address, None)
        else:
            self._listeners[address] = on_frame

    def send(self, data: bytes) -> None:
        """Send a frame; raises LinkTimeout if the line is blocked, LinkError."""
        self._ready().write(data)
        self.last_sent = clock.now()

    async def _open(self) -> Port:
        self._reader = FrameReader()
        return await open_port(
            self.name, baud=self.baud, on_data=self._received, on_loss=self._lose
        )

    def _received(self, data: bytes) -> None:
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
