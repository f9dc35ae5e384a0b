"""Clients' connections to the gateway and theirs to the daemon, with the bounds that aiohttp lacks.

Silent, slow or non-reading clients cannot exhaust connections or memory. Timeouts count from the
last complete request, so sending byte by byte gains nothing. `bridge` passes lines of the API
between a browser's WebSocket and the daemon; `KeptLink` is the connection to the daemon that an
HTTP connection keeps. `FrameHeads` checks the heads of WebSocket frames for what aiohttp does not
bound.
"""

import asyncio
import contextlib
import itertools
import json
import socket
import ssl
from collections.abc import Awaitable, Callable, Hashable
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from controller.api.jsonrpc import ErrorCode, RpcError, read_request, request_line
from controller.api.link import RESPONSE_TIMEOUT, DaemonLink, Unreachable
from controller.api.methods import SILENCING
from controller.gateway.access import HEADERS
from controller.gateway.field import DrawnField
from controller.process.log import RateLimiter

SEND_TIMEOUT = 5.0  # s; for one frame
_LAST_FRAME, _LAST_FRAMES = 0.1, 1.0  # s; for the next frame of a browser which is given up, for
# all of them

_INVALID_CODES = (WSCloseCode.ABNORMAL_CLOSURE, *range(5000, 1 << 16))  # of those that aiohttp
# takes; RFC 6455 7.4: the first is never sent, and the others are not defined
NO_DAEMON = 4001  # one of those for private use; the page connects again

_numbers = itertools.count(1)


async def bridge(
    socket: web.WebSocketResponse, client: str, daemon: Path, field: DrawnField | None
) -> None:
    """Pass frames and lines on until the browser or the daemon at a socket closes.

    client: the address of the browser; field: None unless it wants the vibration.
    The first frame is the daemon's reply to a hello, whose id is the browser's name in the daemon's
    log. The daemon carries out what it was sent before the browser left, and lifts its fingers.
    """
    try:
        link = await DaemonLink.open(daemon, f"web:{next(_numbers)} {client}")
        with contextlib.closing(link):
            try:
                await socket.send_str(link.hello.decode())
                async with asyncio.TaskGroup() as ways:
                    ways.create_task(_to_daemon(socket, link))
                    ways.create_task(
                        _to_browser(
                            link.next_line, partial(socket.send_frame, opcode=WSMsgType.TEXT)
                        )
                    )
                    if field is not None:
                        ways.create_task(_to_browser(field.frames().__anext__, socket.send_bytes))
            finally:
                await _silence(socket, link)
    except* (RpcError, Unreachable):
        await socket.close(code=NO_DAEMON, message=b"the daemon does not respond")
    except* (TimeoutError, ConnectionError):
        pass  # closed, or does not read


async def _to_daemon(socket: web.WebSocketResponse, link: DaemonLink) -> None:
    """Pass the browser's frames on; raises ConnectionResetError at their end."""
    async for message in socket:
        if message.type is WSMsgType.TEXT and "\n" not in message.data:
            await link.send(message.data.encode() + b"\n")
        else:  # without effect on one that is closed for an invalid frame
            await socket.close(
                code=WSCloseCode.UNSUPPORTED_DATA, message=b"send text frames of one line"
            )
        await asyncio.sleep(0)  # between two of those that wait others are served
    is_invalid = socket.close_code in _INVALID_CODES
    await socket.close(
        code=WSCloseCode.PROTOCOL_ERROR if is_invalid else WSCloseCode.OK, drain=False
    )
    raise ConnectionResetError


async def _silence(socket: web.WebSocketResponse, link: DaemonLink) -> None:
    """Send the daemon what may silence of the frames that still wait, whoever else is at an end."""
    loop = asyncio.get_running_loop()
    end = loop.time() + _LAST_FRAMES
    with contextlib.suppress(TimeoutError):  # there is no further one
        async with asyncio.timeout(_LAST_FRAME) as limit:
            async for message in socket:
                line = message.data.encode() if message.type is WSMsgType.TEXT else b""
                with contextlib.suppress(RpcError):
                    is_whole = link.is_open and b"\n" not in line
                    if is_whole and read_request(line).method in SILENCING:
                        link.write(line + b"\n")
                await asyncio.sleep(0)
                limit.reschedule(min(end, loop.time() + _LAST_FRAME))


async def _to_browser(
    take: Callable[[], Awaitable[bytes]], send: Callable[[bytes], Awaitable[None]]
) -> None:
    """Pass the daemon's lines, or pictures, on; raises TimeoutError if one is not read."""
    while True:
        message = await take()
        async with asyncio.timeout(SEND_TIMEOUT):
            await send(message)
        await asyncio.sleep(0)  # of lines that came together none goes to a browser that has left


MAX_KEPT = 8  # connections; the daemon has 32


@dataclass(eq=False)
class KeptLink:
    """The connection to the daemon that an HTTP connection keeps, from its first request on."""

    kept: "set[KeptLink]"
    """The open ones of all HTTP connections, bounded so that the daemon has room for others."""
    _link: DaemonLink | None = None
    _is_over: bool = False

    @property
    def is_open(self) -> bool:
        """Whether there is one now."""
        return self._link is not None and self._link.is_open

    async def request(
        self, path: Path, name: str, method: str, params: bytes, *, may_open: Callable[[], bool]
    ) -> bytes:
        """Send a request of a client by its name, and return the response.

        may_open: whether a connection may be opened now, which counts it; called only where it has
        a place. Raises RpcError and Unreachable.
        """
        try:
            if self._link is None or not self._link.is_open:
                if len(self.kept - {self}) >= MAX_KEPT or not may_open():
                    raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
                self.kept.add(self)
                self._link = await DaemonLink.open(path, name)
            if self._is_over:  # sent all the same
                asyncio.get_running_loop().call_soon(self.close)
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                await self._link.send(request_line(name, method, params))
                return await self._link.next_line()
        except TimeoutError as error:
            if self.is_open:
                self.close()
            raise Unreachable.at(path, error) from error
        finally:
            if not self.is_open:
                self.kept.discard(self)

    def close(self) -> None:
        """Close it: the HTTP connection is over."""
        self._is_over = True
        if self._link is not None:  # else it may be on its way, and has its place until then
            self.kept.discard(self)
            if self._link.is_open:
                self._link.close()


MAX_FRAGMENTS = 64  # per message; a browser sends 64 KiB in one or two
MAX_CONTROL_RATE = 100.0  # 1/s; pings and pongs of one WebSocket; one in ten seconds is needed
_LENGTH_BYTES = {126: 2, 127: 8}  # that follow the first two bytes, by the length in the second
_MASKING_KEY = 4  # bytes


class FrameHeads:
    """Follows the heads of frames (RFC 6455 5.2) through the bytes of one client."""

    def __init__(self) -> None:
        self._incomplete = b""  # head at the end of the last bytes
        self._payload_left = 0  # bytes of the last frame
        self._fragments = 0  # of the last message
        self._controls = RateLimiter(MAX_CONTROL_RATE, clock=asyncio.get_running_loop().time)

    def accept(self, data: bytes) -> bool:
        """Whether all frames that begin in the next bytes are allowed.

        They are masked, as RFC 6455 5.1 demands, control frames come at a bounded rate, and
        fragments of a message in a bounded number: the size of empty ones is no bound.
        """
        data, at = self._incomplete + data, self._payload_left
        while at + 1 < len(data):
            is_final, is_control = data[at] & 0x80, data[at] & 0x08
            is_masked, length = data[at + 1] & 0x80, data[at + 1] & 0x7F
            start = at + 2
            end = start + _LENGTH_BYTES.get(length, 0)
            if end > len(data):
                break
            if not is_control:
                self._fragments = 0 if is_final else self._fragments + 1
            has_rate = not is_control or self._controls.take()
            if not is_masked or self._fragments > MAX_FRAGMENTS or not has_rate:
                return False
            at = end + _MASKING_KEY + int.from_bytes(data[start:end] or bytes([length]), "big")
        self._incomplete = data[at:]
        self._payload_left = max(0, at - len(data))
        return True


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
    """Deadlines of things that must happen within `CLIENT_TIMEOUT`.

    Above the limit the oldest expires for a new one.
    """

    limit: int
    _all: dict[Hashable, tuple[Callable[[], object], asyncio.TimerHandle]] = field(
        default_factory=dict
    )

    def start(self, key: Hashable, expire: Callable[[], object]) -> None:
        """Start a deadline, or start it anew; expire: called when it has passed."""
        self.cancel(key)
        if len(self._all) >= self.limit:
            oldest, (expire_oldest, _) = next(iter(self._all.items()))
            self.cancel(oldest)
            expire_oldest()
        timer = asyncio.get_running_loop().call_later(CLIENT_TIMEOUT, expire)
        self._all[key] = expire, timer

    def cancel(self, key: Hashable) -> None:
        """Cancel a deadline: what it waited for has happened."""
        if key in self._all:
            self._all.pop(key)[1].cancel()


class ClientConnection(asyncio.Protocol):
    """Stands between a transport and the web server's protocol, and is each to the other."""

    _transport: Any = None

    def __init__(self, acceptor: "ConnectionAcceptor") -> None:
        self.link = KeptLink(acceptor.links)  # ends with this connection
        self._acceptor = acceptor
        self._frames: FrameHeads | None = None
        self.is_refused = False  # whether the rest of a request is discarded, after its answer
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
        """Expect WebSocket frames from now on; return False if some came before it was accepted."""
        if self._received.split(_END_OF_HEAD)[1:] == [b""] and len(self._received) < _MAX_UPGRADE:
            self._frames = FrameHeads()
        return self._frames is not None


CONNECTION: ContextVar[ClientConnection] = ContextVar("CONNECTION")
"""The connection that a request came by, also after its end."""


@dataclass
class ConnectionAcceptor:
    """Accepts connections of a listening socket for a web server."""

    make_server: Callable[[], asyncio.Protocol]
    """Makes the web server's protocol of a connection."""
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
