"""Clients' connections to the gateway, with the bounds that aiohttp lacks.

By itself, aiohttp parses up to 32 requests of a connection ahead. A `ClientConnection` between the
transport and aiohttp passes on one request at a time, each in its turn
(`controller.gateway.turns`). `RequestInput` splits the received bytes into requests. A request that
silences does not wait for a turn.

`Connections` closes a connection that waits too long for its next request, and the oldest of too
many that wait. The time counts from the last response, so that sending byte by byte gains nothing.
It also holds the clients of the daemon that connections over HTTP keep.
"""

import asyncio
import re
from collections.abc import Callable
from contextvars import ContextVar
from enum import Enum
from pathlib import Path
from typing import Any, cast

from aiohttp import StreamReader, web

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import RESPONSE_TIMEOUT
from controller.api.methods import SILENCING
from controller.api.schema import ApiMessage
from controller.gateway.turns import Turns

CLIENT_TIMEOUT = 5.0  # s; from a response, which the client must read, to the next complete request
MAX_WAITING = 128  # connections that wait for a request, or for their turn
MAX_KEPT = 8  # connections to the daemon of clients over HTTP; the daemon has 32

_MAX_READ = 1 << 14  # bytes in an iteration of the event loop
_MAX_INPUT = 1 << 16  # bytes that wait to be handed on
_ITERATIONS = 8  # of the event loop, within which a received request begins
_HEAD_END = b"\r\n\r\n"
_SILENCING_HEAD = re.compile(rb"[A-Z]+ /api/v1/(%s)\b" % "|".join(SILENCING).encode())

CONNECTION: ContextVar["ClientConnection"] = ContextVar("CONNECTION")
"""The connection of the present request, also after its end."""


class RequestInput:
    """Received bytes that the web server has not got yet, cut into heads and bodies of requests."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._head_tail = b""  # last bytes of a head that was taken before its end was received
        self._body_left = 0  # bytes of the present request's body that were not taken

    def __len__(self) -> int:
        return len(self._bytes)

    @property
    def is_amid_head(self) -> bool:
        """Whether a part of the next request's head was taken."""
        return bool(self._head_tail)

    @property
    def may_silence(self) -> bool:
        """Whether the next request names a method that silences."""
        return _SILENCING_HEAD.match(self._bytes) is not None

    def add(self, received: memoryview) -> None:
        """Add received bytes."""
        self._bytes += received

    def clear(self) -> None:
        """Discard all bytes."""
        self._bytes.clear()

    def skip_empty_lines(self) -> None:
        """Discard empty lines before a request, which HTTP allows."""
        self._bytes = self._bytes.lstrip(b"\r\n")

    def take_head(self) -> bytes:
        """Take the received part of the next request's head."""
        searched = self._head_tail + self._bytes
        end = searched.find(_HEAD_END)
        if end < 0:
            self._head_tail = bytes(searched[1 - len(_HEAD_END) :])
            return self.take_all()
        size = end + len(_HEAD_END) - len(self._head_tail)
        self._head_tail = b""
        return self._take(size)

    def expect_body(self, length: int) -> None:
        """Take the next bytes, in this number, for the body of the present request."""
        self._body_left = length

    def take_body(self) -> bytes:
        """Take the part of the present request's body that was received."""
        part = self._take(min(self._body_left, len(self._bytes)))
        self._body_left -= len(part)
        return part

    def take_all(self) -> bytes:
        """Take all bytes."""
        return self._take(len(self._bytes))

    def _take(self, size: int) -> bytes:
        part = bytes(self._bytes[:size])
        del self._bytes[:size]
        return part


class Connections:
    """State that the connections of a gateway share, with their bounds in time and number."""

    def __init__(self, daemon: Path) -> None:
        self.daemon = daemon  # its socket
        self.kept: dict[ClientConnection, AsyncClient] = {}  # clients of the daemon
        self.turns = Turns()
        # Connections that wait for a request, or for its turn, the oldest first.
        self._waiting: dict[ClientConnection, asyncio.TimerHandle] = {}
        self._tasks: set[asyncio.Task[None]] = set()  # that close connections

    def start_waiting(self, connection: "ClientConnection") -> None:
        """Wait for the next request of a connection; close the oldest of too many that wait."""
        if not connection.is_closing:
            loop = asyncio.get_running_loop()
            self._waiting[connection] = loop.call_later(CLIENT_TIMEOUT, connection.abort)
        if len(self._waiting) == MAX_WAITING + 1:
            closing = asyncio.create_task(self._close_oldest())
            self._tasks.add(closing)
            closing.add_done_callback(self._tasks.discard)

    def stop_waiting(self, connection: "ClientConnection") -> None:
        """End the wait for a request, which was received, or whose connection is closed."""
        timer = self._waiting.pop(connection, None)
        if timer is not None:
            timer.cancel()

    async def _close_oldest(self) -> None:
        """Close the oldest of too many connections that wait.

        First reads their input, which may contain a stop. Closes connections with earlier responses
        before new ones: a new client may be about to stop.
        """
        for _ in range(_ITERATIONS):
            await asyncio.sleep(0)
        surplus = max(len(self._waiting) - MAX_WAITING, 0)
        by_precedence = sorted(self._waiting, key=lambda waiting: not waiting.was_admitted)
        for connection in by_precedence[:surplus]:
            self.stop_waiting(connection)
            connection.abort()


class _Stage(Enum):
    """Stage of the present request of a connection."""

    RECEIVED = "none, or a part of its head was received"
    QUEUED = "waits for its turn"
    SERVED = "from the end of its head to its response"
    WEBSOCKET = "has become a WebSocket, which the connection stays until its end"


class ClientConnection(asyncio.BufferedProtocol):
    """A client's connection, which hands one request at a time on to the web server's protocol.

    A request is received, waits for its turn (`_permit`), and is served from `start_request` to
    `finish`. Only then does the next one take a turn.

    make_server: makes the web server's protocol, for the first request.
    """

    _transport: asyncio.Transport

    def __init__(self, make_server: Callable[[], web.RequestHandler], shared: Connections) -> None:
        self.was_admitted = False  # whether a request had its turn
        self._make_server = make_server
        self._server: web.RequestHandler | None = None  # None before the first request
        self._shared = shared
        self._received = memoryview(bytearray(_MAX_READ))
        self._input = RequestInput()
        self._stage = _Stage.RECEIVED
        self._permit: asyncio.Future[None] | None = None  # the turn of the present request
        self._is_urgent = False  # whether the present request may silence
        self._body: StreamReader | None = None  # body of the present request
        self._is_half_closed = False  # whether the client has closed its side
        self._discards_input = False  # whether the rest of a request is not parsed
        self._requesting = asyncio.Lock()  # held during a request to the daemon
        self._closing_client: asyncio.Task[None] | None = None  # closes the client of the daemon

    @property
    def address(self) -> str:
        """The client's address and port."""
        peer = self._transport.get_extra_info("peername") or ("unknown", 0)
        return f"{peer[0]}:{peer[1]}"

    @property
    def is_closing(self) -> bool:
        """Whether it is closed, or about to be."""
        return self._transport.is_closing()

    def abort(self) -> None:
        """Close it without sending what waits to be sent."""
        self._transport.abort()

    def end_websocket(self) -> None:
        """Abort the connection after a timeout, in case the client does not read the last data."""
        asyncio.get_running_loop().call_later(CLIENT_TIMEOUT, self.abort)

    # Called by the transport:

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the first request."""
        self._transport = cast(asyncio.Transport, transport)
        self._shared.start_waiting(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Buffer for the next bytes."""
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Hand on a body, or a request in its turn; stop reading while much input waits."""
        if self._discards_input:
            return
        self._input.add(self._received[:nbytes])
        self._hand_on_body()
        self._start_next_request()
        if len(self._input) > _MAX_INPUT:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Answer requests that the client sent before it closed its side; close a WebSocket."""
        if not self._has_request:
            return False
        self._is_half_closed = True
        self._fail_incomplete_body()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Close the client of the daemon, once its requests are carried out."""
        self._shared.stop_waiting(self)
        if self._permit is not None:
            self._permit.cancel()
        if self._server is not None:
            # Later, because aiohttp fails if it was handed a request that it has not begun.
            asyncio.get_running_loop().call_soon(self._server.connection_lost, error)
        if self in self._shared.kept:
            self._closing_client = asyncio.create_task(self._close_client())

    def pause_writing(self) -> None:
        """Let the web server wait: the client reads too slowly."""
        if self._server is not None:
            self._server.pause_writing()

    def resume_writing(self) -> None:
        """Let the web server go on."""
        if self._server is not None:
            self._server.resume_writing()

    # Called while a request is served, in this order:

    def start_request(self, request: web.Request) -> None:
        """Begin to serve a request; the rest of its body is handed on as it is received."""
        self._body = request.content
        self._input.expect_body(request.content_length or 0)
        self._hand_on_body()
        if self._is_half_closed:
            self._fail_incomplete_body()

    async def wait_for_turn(self) -> None:
        """Wait for a turn of the present request, if it was handed on without one."""
        self._permit = self._shared.turns.take()
        await self._permit
        self._permit = None

    def admit(self) -> None:
        """Let the present request take as much time as it needs."""
        self.was_admitted = True
        self._shared.stop_waiting(self)

    def upgrade(self) -> None:
        """Become a WebSocket."""
        self._stage = _Stage.WEBSOCKET
        self._hand_on_body()

    async def request(self, method: str, params: ApiMessage) -> Any:
        """The result of a request to the daemon by a client of its own, which it keeps.

        Raises RpcError and Unreachable.
        """
        clients = self._shared.kept
        if self not in clients:
            if self.is_closing or len(clients) >= MAX_KEPT:
                raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
            name = f"http {self.address}"
            clients[self] = AsyncClient(self._shared.daemon, name=name, timeout=RESPONSE_TIMEOUT)
        async with self._requesting:
            return await clients[self].request(method, params)

    def finish(self) -> None:
        """Wait for the next request; the client has the same time to read the response."""
        if self._body is not None and not self._body.is_eof():
            self._discard_input()
        if self._stage is _Stage.SERVED:
            self._stage = _Stage.RECEIVED
        self._shared.start_waiting(self)
        self._transport.resume_reading()
        self._start_next_request()
        if self._is_half_closed and not self._has_request and self._server is not None:
            self._server.close()  # after the response

    # From the input to the web server:

    @property
    def _has_request(self) -> bool:
        """Whether a request is served, or waits for its turn."""
        return self._stage in (_Stage.QUEUED, _Stage.SERVED)

    def _start_next_request(self) -> None:
        """Hand the next request on in its turn, or immediately if it may silence."""
        if self._stage is not _Stage.RECEIVED:
            return
        if not self._input.is_amid_head:
            self._input.skip_empty_lines()
            self._is_urgent = self._input.may_silence
        if not self._input:
            return
        if self._is_urgent:
            self._hand_on_head()
        else:
            self._stage = _Stage.QUEUED
            self._permit = self._shared.turns.take()
            self._permit.add_done_callback(self._take_turn)

    def _take_turn(self, permit: "asyncio.Future[None]") -> None:
        self._permit = None
        self._stage = _Stage.RECEIVED
        # A connection that is lost just as its turn comes cannot cancel the turn any more.
        if not permit.cancelled() and not self.is_closing:
            self._hand_on_head()

    def _hand_on_head(self) -> None:
        """Hand on the received part of the next request's head."""
        head = self._input.take_head()
        if not self._input.is_amid_head:
            self._stage = _Stage.SERVED
        if self._server is None:
            self._server = self._make_server()
            CONNECTION.set(self)
            self._server.connection_made(self._transport)
        self._server.data_received(head)
        if self._is_half_closed and self._stage is _Stage.RECEIVED:
            self._transport.close()

    def _hand_on_body(self) -> None:
        """Pass on the received part of the current request's body, or of WebSocket frames."""
        is_websocket = self._stage is _Stage.WEBSOCKET
        part = self._input.take_all() if is_websocket else self._input.take_body()
        if part and self._server is not None:
            self._server.data_received(part)

    def _discard_input(self) -> None:
        """Discard all further input: parsing small chunks would take the time of others."""
        self._discards_input = True
        self._input.clear()

    def _fail_incomplete_body(self) -> None:
        """Fail the reading of a body whose rest the client will not send."""
        if self._body is not None and not self._body.is_eof():
            self._body.set_exception(ConnectionResetError("the client has closed its side"))

    async def _close_client(self) -> None:
        async with self._requesting:  # the client counts as kept until its request has ended
            await self._shared.kept.pop(self).close()
