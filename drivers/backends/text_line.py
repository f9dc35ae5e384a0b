"""A line of text to an instrument, over a serial port or TCP: lines out, lines in."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import final

from drivers import trace
from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.trace import Direction

MAX_LINE = 65_536
"""Longest line [bytes]; more without an end is discarded."""


@final
class TextLine:
    """A port as named by pyserial (`/dev/ttyUSB0`, `socket://HOST:PORT`), at a speed [baud].

    on_loss: called once per opening, with the cause.
    """

    def __init__(self, port: str, *, baud: int, on_loss: Callable[[str], None]) -> None:
        self._name = port
        self._baud = baud
        self._on_loss = on_loss
        self._port: Port | None = None
        self._loss: str | None = None
        self._rest = b""
        self._lines: deque[str] = deque()
        self._arrived = asyncio.Event()

    async def open(self) -> None:
        """Open the port; raises LinkError."""
        # Here, since plug-ins import the names of this module without pyserial.
        from drivers.ports.opening import open_port

        if self._port is None:
            self._rest, self._loss = b"", None
            self._lines.clear()
            self._port = await open_port(
                self._name, baud=self._baud, on_data=self._received, on_loss=self._lose
            )

    async def close(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            port.close()
            await port.wait_closed()

    def send(self, line: str) -> None:
        """Send a line; what came before is discarded. Raises LinkError."""
        if self._port is None or self._loss is not None:
            raise LinkError(self._loss or f"{self._name} is not open; open the amplifier first")
        self._lines.clear()
        data = f"{line}\n".encode("ascii")
        trace.frame(Direction.OUT, data, self._name, lambda: line)
        self._port.write(data)

    async def read(self) -> str:
        """Return the next line; raises LinkError once the port is lost."""
        while not self._lines:
            if self._loss is not None:
                raise LinkError(self._loss)
            self._arrived.clear()
            await self._arrived.wait()
        return self._lines.popleft()

    def _received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-MAX_LINE:]
        for line in lines:
            text = line.decode("ascii", errors="replace").strip("\r")
            trace.frame(Direction.IN, line, self._name, text.__str__)
            self._lines.append(text)
        self._arrived.set()

    def _lose(self, cause: str) -> None:
        self._loss = cause
        self._arrived.set()
        self._on_loss(cause)
