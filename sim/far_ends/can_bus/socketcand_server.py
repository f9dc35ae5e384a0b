"""A CAN bus over TCP, as the socketcand daemon serves one: ASCII elements `< ... >`.

A client is greeted, opens the one bus that there is, and goes into raw mode; then every frame of
the bus comes to it, and it sends its own. Not modelled: the other modes, extended identifiers, and
discovery by broadcast.
"""

import asyncio
import re
from dataclasses import dataclass

from drivers import clock
from drivers.codec.can_bus.frame import CanFrame
from drivers.errors import LinkError
from sim.far_ends.can_bus.bus import LENGTHS, CanBus

BUS_NAME = "can0"
_LONGEST = 512  # characters of an element; a CAN FD frame has 220
_UNREAD_MAX = 1 << 18  # bytes; a client that does not take them is hung up on
_SEND = re.compile(r"send ([0-9A-Fa-f]{1,8}) ([0-9A-Fa-f]{1,2})((?: [0-9A-Fa-f]{1,2})*)")
_FD_SEND = re.compile(
    r"fdsend ([0-9A-Fa-f]{1,8}) ([0-9A-Fa-f]{1,2}) (\d{1,2})((?: [0-9A-Fa-f]{1,2})*)"
)


class SocketcandEnd:
    """Serves a bus on a loopback port, 0 for any that is free."""

    def __init__(self, bus: CanBus, *, port: int = 0) -> None:
        self._bus = bus
        self.port = port
        self._server: asyncio.Server | None = None
        self._clients: set[_Client] = set()
        self._is_empty = asyncio.Event()
        self._is_empty.set()
        self.refused = 0

    async def open(self) -> None:
        """Listen; raises LinkError where the port is taken."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._make_client, "127.0.0.1", self.port)
        except OSError as error:
            raise LinkError(
                f"port {self.port} cannot be listened on ({error.strerror or error}); choose "
                "another, or 0 for any that is free"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]

    def unplug(self) -> None:
        """Hang up on every client and listen no more."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for client in tuple(self._clients):
            client.abort()

    async def close(self) -> None:
        """As `unplug`, and see it through."""
        server = self._server
        self.unplug()
        if server is not None:
            await server.wait_closed()
        await self._is_empty.wait()

    def _make_client(self) -> asyncio.Protocol:
        return _Client(self._bus, self)

    def joined(self, client: "_Client") -> None:
        """A client has come."""
        self._clients.add(client)
        self._is_empty.clear()

    def left(self, client: "_Client") -> None:
        """A client has gone."""
        self._clients.discard(client)
        if not self._clients:
            self._is_empty.set()


@dataclass(eq=False)
class _Client(asyncio.Protocol):
    """One connection: greeted, then with the bus open, then raw."""

    bus: CanBus
    end: SocketcandEnd
    transport: asyncio.Transport | None = None
    rest: str = ""
    is_open: bool = False
    is_raw: bool = False

    def __post_init__(self) -> None:
        self.listener = self.hear  # one object, by which the bus knows it

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet."""
        self.transport = transport  # type: ignore[assignment]  # TCP's is one
        self.end.joined(self)
        self.say("< hi >")

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the bus."""
        self.bus.leave(self.listener)
        self.transport = None
        self.end.left(self)

    def data_received(self, data: bytes) -> None:
        """Take the elements that are whole; what lies between them is skipped."""
        text = self.rest + data.decode("ascii", errors="replace")
        while self.transport is not None:
            begin, end = text.find("<"), text.find(">")
            if end < 0:
                break
            if 0 <= begin < end:
                self.element(text[begin + 1 : end].strip())
            text = text[end + 1 :]
        if len(text) > _LONGEST:
            self.end.refused += 1
            text = ""
        self.rest = text

    def element(self, element: str) -> None:
        """Do what one element asks."""
        name = element.partition(" ")[0]
        if not self.is_open:
            if element == f"open {BUS_NAME}":
                self.is_open = True
                self.say("< ok >")
            else:
                self.refuse("could not open bus")
                if self.transport is not None:
                    self.transport.close()
        elif element == "rawmode":
            self.say("< ok >")
            if not self.is_raw:
                self.is_raw = True
                self.bus.join(self.listener)
        elif element == "echo":
            self.say("< echo >")
        elif name in ("send", "fdsend"):
            frame = _parse(element)
            if frame is None:
                self.end.refused += 1  # the daemon tells nobody either
            else:
                self.bus.send(frame, sender=self.listener)
        else:
            self.refuse("unknown command")

    def hear(self, frame: CanFrame) -> None:
        """Pass a frame of the bus on."""
        stamp = f"{clock.now():.6f}"  # only differences of it mean anything
        data = frame.data.hex().upper()
        if frame.fd:
            self.say(f"< fdframe {frame.id:03X} 00 {stamp} {data} >")
        else:
            self.say(f"< frame {frame.id:03X} {stamp} {data} >")

    def refuse(self, why: str) -> None:
        """Say what was wrong."""
        self.end.refused += 1
        self.say(f"< error {why} >")

    def say(self, text: str) -> None:
        """Send; a client that takes nothing is hung up on."""
        if self.transport is None:
            return
        self.transport.write(text.encode("ascii"))
        if self.transport.get_write_buffer_size() > _UNREAD_MAX:
            self.abort()

    def abort(self) -> None:
        """Hang up at once."""
        if self.transport is not None:
            self.transport.abort()


def _parse(element: str) -> CanFrame | None:
    """The frame of an element send or fdsend; None for what is none, or has a long identifier."""
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
