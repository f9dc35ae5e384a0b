"""Clients' connections to the gateway and theirs to the daemon, with the bounds that aiohttp lacks.

`ClientConnection` closes a connection that waits too long for its next request, and the oldest of
too many that wait; the time counts from the last response, so that sending byte by byte gains
nothing. It also holds the client of the daemon that an HTTP connection keeps. `bridge` passes lines
of the API between a browser's WebSocket and the daemon.

Left to itself, aiohttp parses up to 32 requests of a connection ahead, and answers one of every
connection in each iteration of the event loop. Here a connection hands on one request at a time,
and `Turns` admits one request of all connections in each iteration, so that iterations stay short.
A request that silences takes no turn.
"""

import asyncio
import contextlib
import itertools
import re
from collections import deque
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

from aiohttp import StreamReader, WSCloseCode, WSMsgType, web

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError, request_line
from controller.api.link import RESPONSE_TIMEOUT, DaemonLink, Unreachable
from controller.api.methods import SILENCING
from controller.api.schema import ApiMessage
from controller.api.silencing import read_silencing
from controller.gateway.field import DrawnField


class Turns:
    """Admits requests and frames in their order, one in each iteration of the event loop."""

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()

    def take(self) -> "asyncio.Future[None]":
        """A turn; to be cancelled if its connection is lost."""
        loop = asyncio.get_running_loop()
        permit = loop.create_future()
        self._waiting.append(permit)
        if len(self._waiting) == 1:
            loop.call_soon(self._admit_next)
        return permit

    def _admit_next(self) -> None:
        while self._waiting:
            permit = self._waiting.popleft()
            if not permit.done():
                permit.set_result(None)
                break
        if self._waiting:
            asyncio.get_running_loop().call_soon(self._admit_next)


BrowserSocket: TypeAlias = "web.WebSocketResponse[Literal[False]]"
"""A WebSocket whose frames of text are bytes."""

MAX_FRAME = 1 << 16  # bytes
MAX_READ_FRAME = 1 << 20  # bytes; a frame in between is refused, unless it silences
_WITH_CONTENT = (WSMsgType.TEXT, WSMsgType.BINARY)
SEND_TIMEOUT = 5.0  # s; for one frame
_LAST_FRAME, _LAST_FRAMES = 0.1, 1.0  # s; for the next frame of a browser which is given up, for
# all of them

NO_DAEMON = 4001  # one of those for private use; the page connects again

_numbers = itertools.count(1)


async def bridge(
    socket: BrowserSocket,
    client: str,
    daemon: Path,
    field: DrawnField | None,
    turns: Turns,
) -> None:
    """Pass frames and lines on until the browser or the daemon at a socket closes.

    client: the address of the browser; field: None unless it wants the vibration; turns: of frames
    that do not silence.
    The first frame is the daemon's reply to a hello, whose id is the browser's name in the daemon's
    log. The daemon carries out what it was sent before the browser left, and lifts its fingers.
    """
    try:
        link = await DaemonLink.open(daemon, f"web:{next(_numbers)} {client}")
        with contextlib.closing(link):
            try:
                await socket.send_str(link.hello.decode())
                async with asyncio.TaskGroup() as ways:
                    ways.create_task(_to_daemon(socket, link, turns))
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


async def _to_daemon(socket: BrowserSocket, link: DaemonLink, turns: Turns) -> None:
    """Pass the browser's frames on; raises ConnectionResetError at their end."""
    async for message in socket:
        frame = message.data if message.type in _WITH_CONTENT else b""
        if read_silencing(frame) is None:
            await turns.take()
        code = _refusal(message.type, frame)
        if code is None:
            await link.send(frame + b"\n")
        else:  # without effect on one that is closed for an invalid frame
            _pass_on_if_silencing(frame, link)
            reason = b"send text frames of one line, in UTF-8 and of 64 KiB at most"
            await socket.close(code=code, message=reason)
    await socket.close(drain=False)
    raise ConnectionResetError


def _refusal(kind: WSMsgType, frame: bytes) -> WSCloseCode | None:
    """The code with which a frame is refused; None if it is one line of text."""
    if len(frame) > MAX_FRAME:
        return WSCloseCode.MESSAGE_TOO_BIG
    if kind is not WSMsgType.TEXT or b"\n" in frame:
        return WSCloseCode.UNSUPPORTED_DATA
    try:
        frame.decode()
    except UnicodeDecodeError:
        return WSCloseCode.INVALID_TEXT
    return None


def _pass_on_if_silencing(frame: bytes, link: DaemonLink) -> None:
    """Send the daemon the request that silences of a frame, which itself is not passed on."""
    request = read_silencing(frame)
    if request is not None and link.is_open:
        params = request.params.model_dump_json(exclude_none=True).encode()
        link.write(request_line(None, request.method, params))


async def _silence(socket: BrowserSocket, link: DaemonLink) -> None:
    """Send the daemon what may silence of the frames that still wait, whoever else is at an end."""
    loop = asyncio.get_running_loop()
    end = loop.time() + _LAST_FRAMES
    with contextlib.suppress(TimeoutError):  # there is no further one
        async with asyncio.timeout(_LAST_FRAME) as limit:
            async for message in socket:
                if message.type in _WITH_CONTENT:
                    _pass_on_if_silencing(message.data, link)
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
MAX_WAITING = 128  # connections that wait for a request, or for their turn
MAX_KEPT = 8  # connections to the daemon of clients over HTTP; the daemon has 32
_MAX_READ = 1 << 14  # bytes in an iteration
_MAX_INPUT = 1 << 16  # bytes that wait to be handed on
_ITERATIONS = 8  # of the event loop, within which a request that has come is begun
_HEAD_END = b"\r\n\r\n"
_URGENT = re.compile(rb"[A-Z]+ /api/v1/(%s)\b" % "|".join(SILENCING).encode())


class Connections:
    """What the connections of a gateway share.

    daemon: its socket; waiting: connections that wait for a request, or for its turn; kept: those
    that have a client of the daemon.
    """

    def __init__(self, daemon: Path) -> None:
        self.daemon = daemon
        self.waiting: dict[ClientConnection, asyncio.TimerHandle] = {}
        self.kept: dict[ClientConnection, AsyncClient] = {}
        self.turns = Turns()


class ClientConnection(asyncio.BufferedProtocol):
    """A client's connection, which hands one request at a time on to the web server's protocol.

    make_server: makes that protocol, for the first request.
    """

    _transport: asyncio.Transport

    def __init__(self, make_server: Callable[[], web.RequestHandler], shared: Connections) -> None:
        self._make_server = make_server
        self._server: web.RequestHandler | None = None
        self._shared = shared
        self._received = memoryview(bytearray(_MAX_READ))
        self._input = bytearray()  # that waits to be handed on
        self._head = b""  # end of an incomplete head that was handed on
        self._body_left = 0  # bytes of the present request's body that have not come
        self._body: StreamReader | None = None  # of the present request
        self._permit: asyncio.Future[None] | None = None  # that a request waits for
        self._is_urgent = False  # whether the next request may silence
        self._is_serving = False  # from the end of a request's head to its response
        self._has_requested = False  # whether a request was admitted
        self._is_refused = False  # whether the rest of a request is discarded, unparsed
        self._is_upgraded = False  # whether it is a WebSocket
        self._is_at_end = False  # whether the client has closed its side
        self._requesting = asyncio.Lock()  # held during a request to the daemon

    @property
    def address(self) -> str:
        """The client's address and port."""
        peer = self._transport.get_extra_info("peername") or ("unknown", 0)
        return f"{peer[0]}:{peer[1]}"

    # Called by the transport:

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the first request."""
        self._transport = cast(asyncio.Transport, transport)
        self._wait()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Buffer for the next bytes."""
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Hand on a body, or a request in its turn; read no more while much waits for that."""
        if self._is_refused:
            return
        self._input += self._received[:nbytes]
        self._hand_on_body()
        self._request_turn()
        if len(self._input) > _MAX_INPUT:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Answer what a client requested before it closed its side; a WebSocket is closed."""
        if self._is_upgraded or not self._has_request:
            return False
        self._is_at_end = True
        self._end_body()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Close the client of the daemon, once it has carried out what it was sent."""
        self._stop_waiting()
        if self._permit is not None:
            self._permit.cancel()
        if self._server is not None:
            # Later, as aiohttp fails where a request was handed on that it has not begun.
            asyncio.get_running_loop().call_soon(self._server.connection_lost, error)
        if self in self._shared.kept:
            self._ending = asyncio.create_task(self._end())

    def pause_writing(self) -> None:
        """Let the web server wait: the client reads too slowly."""
        if self._server is not None:
            self._server.pause_writing()

    def resume_writing(self) -> None:
        """Let the web server go on."""
        if self._server is not None:
            self._server.resume_writing()

    # Called as a request is served:

    def start_request(self, request: web.Request) -> None:
        """Begin to serve a request, of whose body the rest is handed on as it comes."""
        self._body = request.content
        self._body_left = request.content_length or 0
        self._hand_on_body()
        if self._is_at_end:
            self._end_body()

    async def wait_for_turn(self) -> None:
        """Wait for a turn of the present request, which was handed on without one."""
        self._permit = self._shared.turns.take()
        await self._permit
        self._permit = None

    def admit(self) -> None:
        """Let the present request take as much time as it needs."""
        self._has_requested = True
        self._stop_waiting()

    def upgrade(self) -> None:
        """Become a WebSocket."""
        self._is_upgraded = True
        self._hand_on_body()

    def finish(self) -> None:
        """Wait for the next request; its client has the time of that to read the response."""
        if self._body is not None and not self._body.is_eof():
            self._refuse_rest()
        self._is_serving = False
        self._wait()
        self._transport.resume_reading()
        self._request_turn()
        if self._is_at_end and not self._has_request and self._server is not None:
            self._server.close()  # after the response

    @property
    def _has_request(self) -> bool:
        """Whether a request is being served, or waits for its turn."""
        return self._is_serving or self._permit is not None

    def _request_turn(self) -> None:
        """Hand the next request on in its turn; one that may silence at once."""
        if self._has_request:
            return
        if not self._head:
            self._input = self._input.lstrip(b"\r\n")  # as HTTP allows before a request
            self._is_urgent = _URGENT.match(self._input) is not None
        if self._input and self._is_urgent:
            self._hand_on_head()
        elif self._input:
            self._permit = self._shared.turns.take()
            self._permit.add_done_callback(self._take_turn)

    def _take_turn(self, permit: "asyncio.Future[None]") -> None:
        self._permit = None
        if not permit.cancelled():
            self._hand_on_head()

    def _hand_on_head(self) -> None:
        """Hand on the head of the next request, or what has come of it."""
        searched = self._head + self._input
        end = searched.find(_HEAD_END)
        if end < 0:
            size = len(self._input)
            self._head = bytes(searched[1 - len(_HEAD_END) :])
        else:
            size = end + len(_HEAD_END) - len(self._head)
            self._head = b""
            self._is_serving = True
        if self._server is None:
            self._server = self._make_server()
            CONNECTION.set(self)
            self._server.connection_made(self._transport)
        self._server.data_received(self._take(size))
        if self._is_at_end and not self._is_serving:
            self._transport.close()

    def _hand_on_body(self) -> None:
        """Hand on what has come of the present request's body, or of frames."""
        size = len(self._input) if self._is_upgraded else min(self._body_left, len(self._input))
        if size and self._server is not None:
            self._body_left -= size
            self._server.data_received(self._take(size))

    def _take(self, size: int) -> bytes:
        """Take so many bytes of the input."""
        taken = bytes(self._input[:size])
        del self._input[:size]
        return taken

    def _refuse_rest(self) -> None:
        """Discard what follows: parsing small chunks would take the time of others."""
        self._is_refused = True
        self._input.clear()

    def _end_body(self) -> None:
        """Fail the reading of a body of which no more will come."""
        if self._body is not None and not self._body.is_eof():
            self._body.set_exception(ConnectionResetError("the client has closed its side"))

    def _wait(self) -> None:
        """Wait for the next request; of too many that wait, the oldest are closed."""
        waiting = self._shared.waiting
        if not self._transport.is_closing():
            loop = asyncio.get_running_loop()
            waiting[self] = loop.call_later(CLIENT_TIMEOUT, self._transport.abort)
        if len(waiting) == MAX_WAITING + 1:
            self._making_room = asyncio.create_task(self._make_room())

    async def _make_room(self) -> None:
        """Close the oldest of too many, once what has come of them is read: it may be a stop.

        Those that have had an answer come first: a new client may be the one that stops.
        """
        for _ in range(_ITERATIONS):
            await asyncio.sleep(0)
        waiting = self._shared.waiting
        beyond = max(len(waiting) - MAX_WAITING, 0)
        by_precedence = sorted(waiting, key=lambda connection: not connection._has_requested)
        for connection in by_precedence[:beyond]:
            connection._stop_waiting()
            connection._transport.abort()

    def _stop_waiting(self) -> None:
        timer = self._shared.waiting.pop(self, None)
        if timer is not None:
            timer.cancel()

    async def request(self, method: str, params: ApiMessage) -> Any:
        """The result of a request to the daemon by a client of its own, which it keeps.

        Raises RpcError and Unreachable.
        """
        kept = self._shared.kept
        if self not in kept:
            if self._transport.is_closing() or len(kept) >= MAX_KEPT:
                raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
            name = f"http {self.address}"
            kept[self] = AsyncClient(self._shared.daemon, name=name, timeout=RESPONSE_TIMEOUT)
        async with self._requesting:
            return await kept[self].request(method, params)

    async def _end(self) -> None:
        async with self._requesting:  # its place is taken until then
            await self._shared.kept.pop(self).close()


CONNECTION: ContextVar[ClientConnection] = ContextVar("CONNECTION")
"""The connection that a request came by, also after its end."""
