"""Wire for amplifiers behind a Unix socket, with the frames of a serial line.

URL: example-unix:///run/amplifier.sock#ADDRESS. The program that serves the socket owns the real
line.
"""

import asyncio
import random
from collections.abc import Callable
from typing import cast
from urllib.parse import unquote, urlsplit

from era_haptics.plugins.wires import CommandError, LinkError, SerialWire, WireAddress

MAX_UNSENT = 4096  # bytes; beyond that, the program has stopped reading
ADDRESSES = range(1, 248)


class UnixAddress(WireAddress):
    """Address of an amplifier; amplifiers on one socket share a line."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        number = parts.fragment or "1"
        is_number = number.isascii() and number.isdigit() and int(number) in ADDRESSES
        if not parts.path.strip("/") or parts.netloc or parts.query or not is_number:
            raise CommandError(f"URL must be example-unix:///PATH#ADDRESS, got {url!r}")
        self.line = unquote(parts.path)
        self.number = int(number)
        self.settings = {"protocol": "serial"}

    def make_wire(self) -> SerialWire:
        """Make a wire with a random first sequence number.

        Late replies to an earlier host do not match it.
        """
        return SerialWire(0, sequence=random.getrandbits(16))

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> "UnixPort":
        """Connect to the socket; raises LinkError."""
        loop = asyncio.get_running_loop()
        try:
            _, port = await loop.create_unix_connection(
                lambda: UnixPort(self.line, on_data, on_loss), self.line
            )
        except OSError as error:
            raise LinkError(
                f"{self.line}: no connection ({error.strerror or error}); check that the program "
                "behind it runs"
            ) from error
        return port


class UnixPort(asyncio.Protocol):
    """Port on a connected Unix socket; name: for messages."""

    def __init__(
        self, name: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> None:
        self._name = name
        self._on_data = on_data
        self._on_loss = on_loss
        self._is_closed = False
        self._transport: asyncio.Transport  # set when connected

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        """Pass on received bytes."""
        if not self._is_closed:
            self._on_data(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the loss, unless this side has closed the port."""
        if not self._is_closed:
            self._is_closed = True
            self._on_loss(f"{self._name} was lost: check the program behind it, then open it again")

    @property
    def is_blocked(self) -> bool:
        """Whether bytes are still waiting to be sent."""
        return self._transport.get_write_buffer_size() > 0

    def write(self, data: bytes) -> None:
        """Send bytes without waiting; raises LinkError."""
        if self._transport.get_write_buffer_size() > MAX_UNSENT:
            raise LinkError(f"{self._name}: the program behind it does not read")
        self._transport.write(data)

    def poll(self) -> None:
        """Do nothing: the event loop has already read the received bytes."""

    def close(self) -> None:
        """Close the port; no callback is called afterwards."""
        self._is_closed = True
        self._transport.abort()

    async def wait_closed(self) -> None:
        """Return immediately."""
