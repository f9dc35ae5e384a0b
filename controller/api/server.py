"""The API's server: serves all clients in turn, within the control loop's event loop.

A turn takes at most a quarter of a millisecond, however much was sent; then everything else runs,
the control loop first. What takes longer, such as arming, runs as a task of its own.
"""

import asyncio
import logging
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

from controller.api.connection import Connection
from controller.api.jsonrpc import (
    ErrorCode,
    Request,
    RpcError,
    error_line,
    read_params,
    read_request,
    result_line,
    unknown_method,
)
from controller.api.methods import METHODS
from controller.api.schema import Message
from drivers import clock
from drivers.errors import CommandRefused, DriverError, LinkError
from model.errors import InputError

MAX_CONNECTIONS = 32
IDLE_TIMEOUT = 1.0  # s; a client silent for this long can be replaced when there are too many
MAX_ITERATION_TIME = 0.00025  # s; how long a touch waits for clients that flood
MAX_PENDING = 8  # requests of one client that take long; stop is not counted
_ACCEPT_PER_TURN = 4  # connections
_ACCEPT_QUEUE = 64  # connections

Handler: TypeAlias = Callable[[Connection, Any], Message | Awaitable[Message]]

_UNLIMITED = frozenset({"stop", "touch"})
"""Methods that the request rate does not limit: a stop is always served, touches never queue up."""

_logger = logging.getLogger(__name__)


class ApiServer:
    """Serves the methods of the API.

    handlers: of all METHODS, called with the client and the parameters; on_disconnect: called with
    every client that disconnects; is_protected: whether an idle client must not be replaced.
    """

    def __init__(
        self,
        handlers: Mapping[str, Handler],
        *,
        on_disconnect: Callable[[Connection], None],
        is_protected: Callable[[Connection], bool],
        clock: Callable[[], float] = clock.now,
    ) -> None:
        self._handlers = handlers
        self._on_disconnect = on_disconnect
        self._is_protected = is_protected
        self._clock = clock
        self._connections: set[Connection] = set()
        self._waiting: deque[Connection] = deque()
        self._is_turn_scheduled = False
        self._server: asyncio.Server | None = None

    async def open(self, bound: socket.socket) -> None:
        """Listen on a bound Unix socket; its permissions decide who may connect."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_unix_server(
            self._make_connection, sock=bound, backlog=_ACCEPT_PER_TURN
        )
        bound.listen(_ACCEPT_QUEUE)  # asyncio accepts up to its own backlog per turn

    async def close(self) -> None:
        """Stop listening and close all connections after their pending output."""
        if self._server is None:
            return
        self._server.close()
        for connection in list(self._connections):
            connection.close()
        await asyncio.sleep(0)
        for connection in list(self._connections):
            connection.abort()
        await self._server.wait_closed()

    def _make_connection(self) -> Connection:
        return Connection(
            on_connect=self._connected,
            on_lines=self._lines_received,
            on_disconnect=self._disconnected,
            clock=self._clock,
        )

    def _connected(self, connection: Connection) -> bool:
        """Accept a client, if necessary in place of the one that has been idle for longest."""
        if len(self._connections) >= MAX_CONNECTIONS:
            idle = [c for c in self._connections if not self._is_protected(c) and not c.pending]
            oldest = min(idle, key=lambda each: each.received_at, default=None)
            if oldest is None or self._clock() - oldest.received_at < IDLE_TIMEOUT:
                return False
            self._connections.discard(oldest)
            oldest.abort()
        self._connections.add(connection)
        return True

    def _disconnected(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._on_disconnect(connection)

    def _lines_received(self, connection: Connection) -> None:
        if connection not in self._waiting:
            self._waiting.append(connection)
        if not self._is_turn_scheduled:
            self._is_turn_scheduled = True
            asyncio.get_running_loop().call_soon(self._serve_turn)

    def _serve_turn(self) -> None:
        """Serve one line of each waiting client, round and round, until the turn's time is up."""
        self._is_turn_scheduled = False
        end = time.perf_counter() + MAX_ITERATION_TIME
        while self._waiting:
            connection = self._waiting.popleft()
            if connection.has_lines:
                is_superseded = connection.is_next_superseded
                line = connection.next_line()
                if not is_superseded:
                    self._serve(connection, line)
                if connection.has_lines:
                    self._waiting.append(connection)
            connection.close_if_finished()
            if time.perf_counter() >= end:
                break
        if self._waiting and not self._is_turn_scheduled:
            # Two iterations of the event loop from now: data that arrived meanwhile and what it
            # wakes, such as the control loop for a touch, run first.
            self._is_turn_scheduled = True
            loop = asyncio.get_running_loop()
            loop.call_soon(loop.call_soon, self._serve_turn)

    def _serve(self, connection: Connection, line: bytes) -> None:
        """Serve one line, or start to."""
        request: Request | None = None
        try:
            request = read_request(line)
            if request.method == "arm" and not request.expects_response:
                return  # without a response no client has the lease to renew or end
            result = self._call(connection, request)
        except Exception as error:
            self._respond_error(connection, request, error)
            return
        if isinstance(result, Message):
            self._respond(connection, request, result)
            return
        task = asyncio.ensure_future(self._finish(connection, request, result))
        connection.pending.add(task)
        task.add_done_callback(connection.pending.discard)
        task.add_done_callback(lambda _: connection.close_if_finished())

    def _call(self, connection: Connection, request: Request) -> Message | Awaitable[Message]:
        method = METHODS.get(request.method)
        if request.method not in _UNLIMITED and not connection.take_request():
            raise RpcError(ErrorCode.BUSY, "too many requests", remedy="send fewer per second")
        if method is None:
            raise unknown_method(request.method, METHODS)
        if len(connection.pending) >= MAX_PENDING and request.method != "stop":
            raise RpcError(ErrorCode.BUSY, "too many pending requests", remedy="await responses")
        return self._handlers[request.method](connection, read_params(method.params, request))

    async def _finish(
        self, connection: Connection, request: Request, result: Awaitable[Message]
    ) -> None:
        try:
            self._respond(connection, request, await result)
        except Exception as error:
            self._respond_error(connection, request, error)

    def _respond(self, connection: Connection, request: Request, result: Message) -> None:
        if request.expects_response:
            connection.respond(result_line(request.id, result.model_dump_json()))

    def _respond_error(
        self, connection: Connection, request: Request | None, error: Exception
    ) -> None:
        if request is None or request.expects_response:
            id = None if request is None else request.id
            connection.respond(error_line(id, _rpc_error(error)))


def _rpc_error(error: Exception) -> RpcError:
    """Translate an exception for the client; the details of a bug go to the log alone."""
    match error:
        case RpcError():
            return error
        case LinkError():
            return RpcError(ErrorCode.LINK, str(error))
        case CommandRefused():
            return RpcError(ErrorCode.REFUSED, str(error))
        case DriverError():
            return RpcError(ErrorCode.WRONG_STATE, str(error))
        case InputError():
            return RpcError(ErrorCode.INVALID_PARAMS, str(error))
    _logger.error("request failed", exc_info=error)
    return RpcError(
        ErrorCode.INTERNAL,
        f"a bug in the daemon ({type(error).__name__})",
        remedy="report it with the daemon's log",
    )
