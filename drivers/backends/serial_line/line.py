"""One open serial port, shared by all amplifiers on it: frames out, and frames in to who waits."""

from collections.abc import Callable

from drivers import clock
from drivers.backends.hardware import Port
from drivers.backends.line_turns import LineTurns
from drivers.backends.ports.opening import open_port
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.codec.serial_line.frame import Frame, FrameReader
from drivers.errors import LinkError


class SerialLine(SharedLine[Port]):
    """A port as pyserial names it, at a speed [baud]; see `serial_line`.

    turns: for exchanges, for no two amplifiers may answer at once on one pair of wires.
    """

    number = "address"

    def __init__(self, port: str, *, baud: int) -> None:
        super().__init__(port)
        self.baud = baud
        self.turns = LineTurns()
        self.last_sent = 0.0
        self._reader = FrameReader()
        self._listeners: dict[int, Callable[[Frame], None]] = {}

    @property
    def crc_errors(self) -> int:
        """How many damaged frames came in."""
        return self._reader.counters.crc_errors

    def listen(self, address: int, on_frame: Callable[[Frame], None] | None) -> None:
        """Whom to tell of frames from an address; None for nobody any more."""
        if on_frame is None:
            self._listeners.pop(address, None)
        else:
            self._listeners[address] = on_frame

    def send(self, data: bytes) -> None:
        """Put a frame on the line; raises LinkTimeout where it is stuck, LinkError."""
        self._ready().write(data)
        self.last_sent = clock.now()

    async def _open(self) -> Port:
        self._reader = FrameReader()
        return await open_port(
            self.place, baud=self.baud, on_data=self._received, on_loss=self._lose
        )

    def _received(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            # What is for nobody here is shown to one, who counts it as foreign.
            listener = self._listeners.get(frame.address) or next(
                iter(self._listeners.values()), None
            )
            if listener is not None:
                listener(frame)


def serial_line(port: str, *, baud: int) -> SerialLine:
    """The line of a port in the running event loop; LinkError where it has another speed."""
    line = shared_line(SerialLine, port, lambda: SerialLine(port, baud=baud))
    if line.baud != baud:
        raise LinkError(
            f"serial port {port} is open at {line.baud} baud and cannot have {baud} as well; "
            "give all amplifiers on it one speed"
        )
    return line
