"""A CAN bus over TCP in the protocol of socketcand: ASCII elements `< ... >`.

Not modelled: modes other than raw mode, extended identifiers, discovery by broadcast.
"""

import asyncio
import re
from dataclasses import dataclass

from drivers import clock
from drivers.codec.can_bus.canopen import CanFrame
from sim.far_ends.can_bus.bus import LENGTHS, CanBus
from sim.transport.loopback import listen, port_of

BUS_NAME = "can0"
_MAX_LENGTH = 512  # characters of an element; a CAN FD frame has 220
_MAX_UNREAD = 1 << 18  # bytes; then the client is disconnected
_SEND = re.compile(r"send ([0-9A-Fa-f]{1,8}) ([0-9A-Fa-f]{1,2})((?: [0-9A-Fa-f]{1,2})*)")
_FD_SEND = re.compile(
    r"fdsend ([0-9A-Fa-f]{1,8}) ([0-9A-Fa-f]{1,2}) (\d{1,2})((?: [0-9A-Fa-f]{1,2})*)"
)


class SocketcandEnd:
    """Serves a bus on a loopback port, 0 for any."""

    def __init__(self, bus: CanBus, *, port: int = 0) -> None:
        self._bus = bus
        self.port = port
        self._server: asyncio.Server | None = None
        self._clients: set[_Client] = set()
        self._is_empty = asyncio.Event()
        self._is_empty.set()

    async def open(self) -> None:
        """Listen; raises LinkError where the port is in use."""
        self._server = await listen(self._make_client, self.port)
        self.port = port_of(self._server)

    def unplug(self) -> None:
        """Stop listening and close all connections."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for client in tuple(self._clients):
            client.abort()

    async def close(self) -> None:
        """Stop listening, and wait until all connections are closed."""
        server = self._server
        self.unplug()
        if server is not None:
            await server.wait_closed()
        await self._is_empty.wait()

    def _make_client(self) -> asyncio.Protocol:
        return _Client(self._bus, self)

    def joined(self, client: "_Client") -> None:
        """Note a new client."""
        self._clients.add(client)
        self._is_empty.clear()

    def left(self, client: "_Client") -> None:
        """Note a closed client."""
        self._clients.discard(client)
        if not self._clients:
            self._is_empty.set()


@dataclass(eq=False)
class _Client(asyncio.Protocol):
    """One connection, through the states new, open and raw."""

    bus: CanBus
    end: SocketcandEnd
    transport: asyncio.Transport | None = None
    rest: str = ""
    is_open: bool = False
    is_raw: bool = False

    def __post_init__(self) -> None:
        self.listener = self.forward  # one object, by which the bus knows it

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet."""
        self.transport = transport  # type: ignore[assignment]  # TCP's is one
        self.end.joined(self)
        self.send("< hi >")

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the bus."""
        self.bus.leave(self.listener)
        self.transport = None
        self.end.left(self)

    def data_received(self, data: bytes) -> None:
        """Process complete elements; text between them is skipped."""
        text = self.rest + data.decode("ascii", errors="replace")
        while self.transport is not None:
            begin, end = text.find("<"), text.find(">")
            if end < 0:
                break
            if 0 <= begin < end:
                self.element(text[begin + 1 : end].strip())
            text = text[end + 1 :]
        if len(text) > _MAX_LENGTH:
            text = ""
        self.rest = text

    def element(self, element: str) -> None:
        """Process one element."""
        name = element.partition(" ")[0]
        if not self.is_open:
            if element == f"open {BUS_NAME}":
                self.is_open = True
                self.send("< ok >")
            else:
                self.send_error("could not open bus")
                if self.transport is not None:
                    self.transport.close()
        elif element == "rawmode":
            self.send("< ok >")
            if not self.is_raw:
                self.is_raw = True
                self.bus.join(self.listener)
        elif element == "echo":
            self.send("< echo >")
        elif name in ("send", "fdsend"):
            frame = _parse(element)
            if frame is not None:  # socketcand sends no error either
                self.bus.send(frame, sender=self.listener)
        else:
            self.send_error("unknown command")

    def forward(self, frame: CanFrame) -> None:
        """Forward a frame of the bus."""
        stamp = f"{clock.now():.6f}"  # only differences are meaningful
        data = frame.data.hex().upper()
        if frame.fd:
            self.send(f"< fdframe {frame.id:03X} 00 {stamp} {data} >")
        else:
            self.send(f"< frame {frame.id:03X} {stamp} {data} >")

    def send_error(self, why: str) -> None:
        """Send an error."""
        self.send(f"< error {why} >")

    def send(self, text: str) -> None:
        """Send text; a client that does not read is disconnected."""
        if self.transport is None:
            return
        self.transport.write(text.encode("ascii"))
        if self.transport.get_write_buffer_size() > _MAX_UNREAD:
            self.abort()

    def abort(self) -> None:
        """Close at once."""
        if self.transport is not None:
            self.transport.abort()


def _parse(element: str) -> CanFrame | None:
    """The frame of an element send or fdsend, else None."""
    if found := _SEND.fullmatch(element):
        identifier, length, data = found.groups()
        count, is_fd = int(length, 16), False
    elif found := _FD_SEND.fullmatch(element):
        identifier, _, length, data = found.groups()
        count, is_fd = int(length), True
    else:
        return None
    content = bytes(int(byte, 16) for byte in data.split())
    allowed = LENGTHS if is_fd else LENGTHS[:9]
    if len(identifier) > 3 or int(identifier, 16) > 0x7FF:
        return None
    if count != len(content) or count not in allowed:
        return None
    return CanFrame(int(identifier, 16), content, fd=is_fd)
