"""Clients' connections to the gateway and theirs to the daemon, with the bounds that aiohttp lacks.

`ClientConnection` closes a connection that waits too long for its next request, and the oldest of
too many that wait; the time counts from the last response, so that sending byte by byte gains
nothing. It also holds the client of the daemon that an HTTP connection keeps. `bridge` passes lines
of the API between a browser's WebSocket and the daemon.
"""

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError, read_request
from controller.api.link import RESPONSE_TIMEOUT, DaemonLink, Unreachable
from controller.api.methods import SILENCING
from controller.api.schema import ApiMessage
from controller.gateway.field import DrawnField

SEND_TIMEOUT = 5.0  # s; for one frame
_LAST_FRAME, _LAST_FRAMES = 0.1, 1.0  # s; for the next frame of a browser which is given up, for
# all of them

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
    await socket.close(drain=False)
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


CLIENT_TIMEOUT = 5.0  # s; from a response, which is to be read, to the end of the next request
MAX_WAITING = 128  # connections that wait for a request
_TURNS = 8  # of the event loop, within which the first request of a new connection is read
MAX_KEPT = 8  # connections to the daemon of clients over HTTP; the daemon has 32


class ClientConnection:
    """A client's connection, between its transport and the web server's protocol.

    waiting, kept: those of all connections that wait for a request, and that have a client of the
    daemon at a socket.
    """

    _transport: asyncio.Transport

    def __init__(
        self,
        server: asyncio.Protocol,
        daemon: Path,
        waiting: "dict[ClientConnection, asyncio.TimerHandle]",
        kept: "dict[ClientConnection, AsyncClient]",
    ) -> None:
        self._server = server
        self._daemon = daemon
        self._waiting = waiting
        self._kept = kept
        self._requesting = asyncio.Lock()
        # Whether a request has come, and whether the rest of one is discarded, unparsed.
        self._has_requested = self._is_refused = False

    def __getattr__(self, name: str) -> Any:
        """What a transport needs of the web server's protocol, but for what is defined here."""
        return getattr(self._server, name)

    @property
    def address(self) -> str:
        """The client's address and port."""
        peer = self._transport.get_extra_info("peername") or ("unknown", 0)
        return f"{peer[0]}:{peer[1]}"

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Wait for the first request."""
        self._transport = transport
        self.wait()
        CONNECTION.set(self)
        self._server.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Hand data on, unless they are of a request that was refused before its end."""
        if not self._is_refused:
            self._server.data_received(data)

    def refuse_rest(self) -> None:
        """Discard what follows: parsing small chunks would take the time of others."""
        self._is_refused = True
        self._transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        """Close the client of the daemon, once it has carried out what it was sent."""
        self.stop_waiting()
        self._server.connection_lost(error)
        self._ending = asyncio.create_task(self._end())

    def wait(self) -> None:
        """Wait for the next request; of too many that wait, the oldest are closed."""
        if not self._transport.is_closing():
            self._waiting[self] = asyncio.get_running_loop().call_later(
                CLIENT_TIMEOUT, self._transport.abort
            )
        if len(self._waiting) == MAX_WAITING + 1:
            self._making_room = asyncio.create_task(self._make_room())

    async def _make_room(self) -> None:
        """Close the oldest of too many, once what has come of them is read: it may be a stop.

        Those that have had an answer come first: a new client may be the one that stops.
        """
        for _ in range(_TURNS):
            await asyncio.sleep(0)
        beyond = max(len(self._waiting) - MAX_WAITING, 0)
        for each in sorted(self._waiting, key=lambda each: not each._has_requested)[:beyond]:
            each.stop_waiting()
            each._transport.abort()

    def stop_waiting(self) -> None:
        """Take as much time as a request takes, which has come."""
        self._has_requested = True
        if self in self._waiting:
            self._waiting.pop(self).cancel()

    async def request(self, method: str, params: ApiMessage) -> Any:
        """The result of a request to the daemon by a client of its own, which it keeps.

        Raises RpcError and Unreachable.
        """
        if self not in self._kept:
            if self._transport.is_closing() or len(self._kept) >= MAX_KEPT:
                raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
            name = f"http {self.address}"
            self._kept[self] = AsyncClient(self._daemon, name=name, timeout=RESPONSE_TIMEOUT)
        async with self._requesting:
            return await self._kept[self].request(method, params)

    async def _end(self) -> None:
        async with self._requesting:  # its place is taken until then
            if self in self._kept:
                await self._kept.pop(self).close()


CONNECTION: ContextVar[ClientConnection] = ContextVar("CONNECTION")
"""The connection that a request came by, also after its end."""
