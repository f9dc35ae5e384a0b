"""Connections of clients, and the bounds that the web server lacks.

Silent, slow or non-reading clients cannot exhaust connections or memory. Timeouts count from the
last complete request, so sending byte by byte gains nothing.
"""

import asyncio
import json
import socket
import ssl
from collections.abc import Callable, Hashable
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from controller.gateway.access import HEADERS
from controller.gateway.bridge import KeptLink
from controller.gateway.frames import FrameHeads

CLIENT_TIMEOUT = 5.0  # s; for a handshake, a complete request, or reading a response
MAX_WAITING = 128  # connections without a complete request, and as many unread
MAX_HANDSHAKES = 96  # of TLS; each takes some 400 kB
_MAX_UPGRADE = 1 << 14  # bytes; of the head of a request for a WebSocket
_ACCEPT_PAUSE = 0.01  # s; while there is no descriptor

_MALFORMED_BODY = json.dumps({"error": "the request is not valid HTTP/1.1"})
_MALFORMED = "\r\n".join(
    [
        "HTTP/1.1 400 Bad Request",
        *(f"{name}: {value}" for name, value in HEADERS.items()),
        "Content-Type: application/json",
        f"Content-Length: {len(_MALFORMED_BODY)}",
        "Connection: close",
        "",
        _MALFORMED_BODY,
    ]
).encode()
CONTINUE = b"HTTP/1.1 100 Continue\r\n\r\n"  # asks for an announced body
_END_OF_HEAD = b"\r\n\r\n"
_PROTOCOL_ERROR = b"\x88\x02\x03\xea"  # close frame with code 1002 of RFC 6455


@dataclass
class Deadlines:
    """What has to happen within a time, in a bounded number: the oldest expires for a new one."""

    limit: int
    _all: dict[Hashable, tuple[Callable[[], object], asyncio.TimerHandle]] = field(
        default_factory=dict
    )

    def start(self, key: Hashable, expire: Callable[[], object]) -> None:
        """Start the time of something, anew if it runs already; expire: called at its end."""
        self.cancel(key)
        if len(self._all) >= self.limit:
            oldest, (expire_oldest, _) = next(iter(self._all.items()))
            self.cancel(oldest)
            expire_oldest()
        timer = asyncio.get_running_loop().call_later(CLIENT_TIMEOUT, expire)
        self._all[key] = expire, timer

    def cancel(self, key: Hashable) -> None:
        """Cancel it: it has happened."""
        if key in self._all:
            self._all.pop(key)[1].cancel()


class ClientConnection(asyncio.Protocol):
    """Stands between a transport and the web server's protocol, and is each of them to the other.

    link: the connection to the daemon that ends with this one; is_refused: whether the rest of a
    request is discarded, which was answered before its end.
    """

    _transport: Any = None

    def __init__(self, acceptor: "ConnectionAcceptor") -> None:
        self.link = KeptLink(acceptor.links)
        self._acceptor = acceptor
        self._frames: FrameHeads | None = None
        self.is_refused = False
        self._is_answering = False
        self._received = b""  # the first bytes since the last response

    def __getattr__(self, name: str) -> Any:
        """What the web server needs of a transport, but for what is defined here."""
        return getattr(self._transport, name)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept it as idle."""
        self._transport = transport
        self._server = self._acceptor.make_server()  # only now, for a handshake may never end
        self._acceptor.idle.start(self, transport.abort)
        CONNECTION.set(self)
        self._server.connection_made(self)  # type: ignore[arg-type]

    def data_received(self, data: bytes) -> None:
        """Hand data on, unless they are frames that are not allowed."""
        self._received = (self._received + data)[:_MAX_UPGRADE]
        if self._frames is not None and not self._frames.accept(data):
            self._transport.write(_PROTOCOL_ERROR)
            self._transport.abort()  # after a flood it might not be read
        elif not self.is_refused:
            self._server.data_received(data)

    def pause_writing(self) -> None:
        """Start the time for reading."""
        self._acceptor.unread.start(self, self._transport.abort)
        self._server.pause_writing()

    def resume_writing(self) -> None:
        """End the time for reading, unless it is that of the last bytes."""
        if not self._transport.is_closing():
            self._acceptor.unread.cancel(self)
        self._server.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel all timeouts, and close the connection to the daemon."""
        self._acceptor.idle.cancel(self)
        self._acceptor.unread.cancel(self)
        self.link.close()
        self._server.connection_lost(exc)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Write a response; what the server writes of its own accord is about a malformed head.

        Or it asks for a body before the head is checked.
        """
        if self._is_answering:
            self._transport.write(data)
        elif data != CONTINUE and not self._transport.is_closing():
            self._transport.write(_MALFORMED)
            self.is_refused = False
            self.close()

    def writelines(self, parts: list[bytes]) -> None:
        """Write a response in parts."""
        self.write(b"".join(parts))

    def close(self) -> None:
        """Close it once the client has read all, at the latest after a time.

        One that still sends would not read an answer after the end of its connection.
        """
        if not self.is_refused:
            self._transport.close()
            self._acceptor.unread.start(self, self._transport.abort)

    def start_response(self) -> None:
        """Let through what the server writes: it is to a request that it has handed on."""
        self._acceptor.idle.cancel(self)
        self._is_answering = True

    def end_response(self) -> None:
        """Wait for the next request."""
        self._is_answering, self._received = False, b""
        if not self._transport.is_closing():
            self._acceptor.idle.start(self, self._transport.abort)

    @property
    def address(self) -> str:
        """The client's address and port."""
        peer = self._transport.get_extra_info("peername") or ("unknown", 0)
        return f"{peer[0]}:{peer[1]}"

    def upgrade(self) -> bool:
        """Expect frames, unless some came too early, before this was accepted; whether it does."""
        if self._received.split(_END_OF_HEAD)[1:] == [b""] and len(self._received) < _MAX_UPGRADE:
            self._frames = FrameHeads()
        return self._frames is not None


CONNECTION: ContextVar[ClientConnection] = ContextVar("CONNECTION")
"""The connection that a request came by, also after its end."""


@dataclass
class ConnectionAcceptor:
    """Accepts connections of a listening socket for a web server.

    make_server: makes the web server's protocol of a connection; tls: None without.
    """

    make_server: Callable[[], asyncio.Protocol]
    tls: ssl.SSLContext | None
    links: set[KeptLink] = field(default_factory=set)
    idle: Deadlines = field(default_factory=lambda: Deadlines(MAX_WAITING))
    unread: Deadlines = field(default_factory=lambda: Deadlines(MAX_WAITING))
    _handshakes: Deadlines = field(default_factory=lambda: Deadlines(MAX_HANDSHAKES))

    async def run(self, listening: socket.socket) -> None:
        """Accept connections until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, _ = await loop.sock_accept(listening)
                task = loop.create_task(self._admit(accepted))
                self._handshakes.start(task, task.cancel)
                await asyncio.sleep(0)  # while others wait, accepting never does
            except OSError:
                await asyncio.sleep(_ACCEPT_PAUSE)

    async def _admit(self, accepted: socket.socket) -> None:
        try:
            if self.tls is not None:
                await _first_byte(accepted)  # a silent connection takes no time or memory for TLS
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: ClientConnection(self), accepted, ssl=self.tls
            )
        except (OSError, asyncio.CancelledError):
            accepted.close()
        finally:
            self._handshakes.cancel(asyncio.current_task())


async def _first_byte(accepted: socket.socket) -> None:
    """Wait until a client sends something, which is left to be read; raises OSError at its end."""
    loop, has_come = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(accepted, has_come.set)
    try:
        await has_come.wait()
    finally:
        loop.remove_reader(accepted)
    if not accepted.recv(1, socket.MSG_PEEK):
        raise ConnectionResetError
