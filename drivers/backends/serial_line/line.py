"""One open serial port, shared by all amplifiers on it: frames out, and frames in to who waits."""

import asyncio
from collections.abc import Callable

from drivers import clock
from drivers.backends.line_turns import LineTurns
from drivers.backends.ports.opening import open_port
from drivers.backends.stand_in import Port
from drivers.codec.serial_line.frame import Frame, FrameReader
from drivers.errors import LinkError


class SerialLine:
    """A port as pyserial names it, at a speed [baud]; see `shared_line`.

    turns: for exchanges, for no two amplifiers may answer at once on one pair of wires.
    """

    def __init__(self, port: str, *, baud: int) -> None:
        self.port = port
        self.turns = LineTurns()
        self.last_sent = 0.0
        self.frames_out = 0
        self._baud = baud
        self._reader = FrameReader()
        self._users: dict[int, tuple[Callable[[Frame], None], Callable[[str], None]]] = {}
        self._loss: str | None = None
        self._port: Port | None = None
        self._changing = asyncio.Lock()  # held while the port is opened or closed

    @property
    def baud(self) -> int:
        """Its speed."""
        return self._baud

    @property
    def bad(self) -> int:
        """How many damaged frames came in."""
        return self._reader.counters.bad

    @property
    def is_shared(self) -> bool:
        """Whether more than one address is in use."""
        return len(self._users) > 1

    @property
    def is_idle(self) -> bool:
        """Whether nobody uses it, and its port is closed."""
        return not self._users and self._port is None and not self._changing.locked()

    def raise_if_lost(self) -> None:
        """Raise LinkError where the port is gone."""
        if self._loss is not None:
            raise LinkError(self._loss)

    async def join(
        self, address: int, on_frame: Callable[[Frame], None], on_loss: Callable[[str], None]
    ) -> None:
        """Use the line for the amplifier at an address; the first to come opens the port.

        So does the first to come back after a loss; the others are lost until they come, too.
        Raises LinkError: where the port cannot be opened, and for an address that is in use.
        """
        if address in self._users:
            raise LinkError(
                f"serial port {self.port}, address {address}: this program has it open already; "
                "give every amplifier an address of its own"
            )
        self._users[address] = (on_frame, on_loss)
        try:
            async with self._changing:  # who comes meanwhile waits for the port, too
                if self._loss is not None:
                    await self._close()
                if self._port is None:
                    await self._open()
        except BaseException:
            del self._users[address]
            raise

    async def leave(self, address: int) -> None:
        """No longer use it; the last to go closes the port."""
        self._users.pop(address, None)
        async with self._changing:
            if not self._users:  # nobody has come meanwhile
                await self._close()

    def send(self, data: bytes) -> None:
        """Put a frame on the line; raises LinkTimeout where it is stuck, LinkError."""
        self.raise_if_lost()
        if self._port is None:
            raise LinkError(f"{self.port} is not open")
        self._port.write(data)
        self.last_sent = clock.now()
        self.frames_out += 1

    async def _open(self) -> None:
        self._loss = None
        self._reader = FrameReader()
        self._port = await open_port(
            self.port, baud=self._baud, on_data=self._received, on_loss=self._lose
        )

    async def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()
            await port.wait_closed()

    def _received(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            # What is for nobody here is shown to one, who counts it as foreign.
            user = self._users.get(frame.address) or next(iter(self._users.values()), None)
            if user is not None:
                user[0](frame)

    def _lose(self, what: str) -> None:
        if self._loss is not None:
            return
        self._loss = what
        for _, on_loss in list(self._users.values()):
            on_loss(what)


_LINES: dict[tuple[str, asyncio.AbstractEventLoop], SerialLine] = {}


def shared_line(port: str, *, baud: int) -> SerialLine:
    """The line of a port in the running event loop: the one in use, or a new one.

    Raises LinkError where it is in use at another speed.
    """
    key = (port, asyncio.get_running_loop())
    for known in [known for known, line in _LINES.items() if line.is_idle]:
        del _LINES[known]
    line = _LINES.setdefault(key, SerialLine(port, baud=baud))
    if line.baud != baud:
        raise LinkError(
            f"serial port {port} is open at {line.baud} baud and cannot have {baud} as well; "
            "give all amplifiers on it one speed"
        )
    return line
