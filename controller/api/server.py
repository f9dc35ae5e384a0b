"""The API's server: all clients in turn, a little at a time, within the control loop's own loop.

A turn takes a quarter of a millisecond at most, however much was sent; then everything else gets
its turn, the control loop first of all. What takes longer than a turn, such as arming, goes on
beside.
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
)
from controller.api.methods import METHODS
from controller.api.schema import Message
from drivers import clock
from drivers.errors import CommandRefused, DriverError, LinkError
from model.errors import InputError

MAX_CONNECTIONS = 32
IDLE_TIMEOUT = 1.0  # s; who has said nothing for so long gives way when all places are taken
MAX_TURN_TIME = 0.00025  # s; so long a touch waits for clients that flood
_AT_ONCE = 4  # connections that are taken in a turn
_QUEUE = 64  # that wait for it
MAX_PENDING = 8  # requests of one client that take long; a stop is always taken

Handler: TypeAlias = Callable[[Connection, Any], Message | Awaitable[Message]]

_FREE = frozenset({"stop", "touch"})
"""Not counted by the rate: nobody is too busy to stop, and touches are never queued."""

_logger = logging.getLogger(__name__)


class ApiServer:
    """Serves the methods of the API; handlers by method, each takes the client and the parameters.

    left: told of every client that is gone; keeps: whether a client must not give way to another.
    """

    def __init__(
        self,
        handlers: Mapping[str, Handler],
        *,
        left: Callable[[Connection], None],
        keeps: Callable[[Connection], bool],
        clock: Callable[[], float] = clock.now,
    ) -> None:
        missing = METHODS.keys() ^ handlers.keys()
        if missing:
            raise ValueError(f"handlers and methods differ in {', '.join(sorted(missing))}")
        self._handlers = handlers
        self._left = left
        self._keeps = keeps
        self._clock = clock
        self._connections: set[Connection] = set()
        self._waiting: deque[Connection] = deque()
        self._turn_is_due = False
        self._server: asyncio.Server | None = None

    async def open(self, bound: socket.socket) -> None:
        """Listen on a Unix socket that is bound; who may open it is up to whoever bound it."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_unix_server(self._connection, sock=bound, backlog=_AT_ONCE)
        bound.listen(_QUEUE)  # asyncio takes as many in a turn as it was told may wait

    async def close(self) -> None:
        """Listen no more, and leave all clients after what was said to them."""
        if self._server is None:
            return
        self._server.close()
        for connection in list(self._connections):
            connection.close()
        await asyncio.sleep(0)
        for connection in list(self._connections):
            connection.abort()
        await self._server.wait_closed()

    def _connection(self) -> Connection:
        return Connection(
            on_begin=self._begun,
            on_lines=self._has_said,
            on_end=self._ended,
            clock=self._clock,
        )

    def _begun(self, connection: Connection) -> bool:
        """Take a client in, if need be in place of one that says nothing."""
        if len(self._connections) >= MAX_CONNECTIONS:
            idle = [one for one in self._connections if not self._keeps(one) and not one.pending]
            longest = min(idle, key=lambda one: one.heard_at, default=None)
            if longest is None or self._clock() - longest.heard_at < IDLE_TIMEOUT:
                return False
            self._connections.discard(longest)
            longest.abort()
        self._connections.add(connection)
        return True

    def _ended(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._left(connection)

    def _has_said(self, connection: Connection) -> None:
        if connection not in self._waiting:
            self._waiting.append(connection)
        self._see_to_a_turn()

    def _see_to_a_turn(self) -> None:
        if not self._turn_is_due:
            self._turn_is_due = True
            asyncio.get_running_loop().call_soon(self._turn)

    def _turn(self) -> None:
        """Serve waiting clients a line each, until the turn is over."""
        self._turn_is_due = False
        end = time.perf_counter() + MAX_TURN_TIME
        while self._waiting:
            connection = self._waiting.popleft()
            if connection.has_lines:
                if connection.next_is_superseded:
                    connection.next_line()
                else:
                    self._serve(connection, connection.next_line())
                if connection.has_lines:
                    self._waiting.append(connection)
            connection.settle()
            if time.perf_counter() >= end:
                break
        if self._waiting and not self._turn_is_due:
            # Not the next but one after it: what came in meanwhile and what follows from it, such
            # as the control loop that wakes for a touch, is before it then.
            self._turn_is_due = True
            loop = asyncio.get_running_loop()
            loop.call_soon(loop.call_soon, self._turn)

    def _serve(self, connection: Connection, line: bytes) -> None:
        """Answer one line, or begin to."""
        request: Request | None = None
        try:
            request = read_request(line)
            if request.method == "arm" and not request.wants_answer:
                return  # nobody would know the lease, and so hold or end what it arms
            result = self._call(connection, request)
        except Exception as error:
            self._fail(connection, request, error)
            return
        if isinstance(result, Message):
            self._succeed(connection, request, result)
            return
        task = asyncio.ensure_future(self._see_through(connection, request, result))
        connection.pending.add(task)
        task.add_done_callback(connection.pending.discard)
        task.add_done_callback(lambda _: connection.settle())

    def _call(self, connection: Connection, request: Request) -> Message | Awaitable[Message]:
        method = METHODS.get(request.method)
        if request.method not in _FREE and not connection.may_ask():
            raise RpcError(ErrorCode.BUSY, "too many requests", remedy="ask less often")
        if method is None:
            raise RpcError(
                ErrorCode.UNKNOWN_METHOD,
                f"there is no method {request.method!a}",
                remedy=f"known are {', '.join(METHODS)}",
            )
        if len(connection.pending) >= MAX_PENDING and request.method != "stop":
            raise RpcError(ErrorCode.BUSY, "too many requests under way", remedy="wait for answers")
        return self._handlers[request.method](connection, read_params(method.params, request))

    async def _see_through(
        self, connection: Connection, request: Request, result: Awaitable[Message]
    ) -> None:
        try:
            self._succeed(connection, request, await result)
        except Exception as error:
            self._fail(connection, request, error)

    def _succeed(self, connection: Connection, request: Request, result: Message) -> None:
        if request.wants_answer:
            connection.answer(result_line(request.id, result))

    def _fail(self, connection: Connection, request: Request | None, error: Exception) -> None:
        if request is None or request.wants_answer:
            id = None if request is None else request.id
            connection.answer(error_line(id, _told(error)))


def _told(error: Exception) -> RpcError:
    """An error as a client is told it."""
    if isinstance(error, RpcError):
        return error
    if isinstance(error, LinkError):
        return RpcError(ErrorCode.LINK, str(error))
    if isinstance(error, CommandRefused):
        return RpcError(ErrorCode.REFUSED, str(error))
    if isinstance(error, DriverError):
        return RpcError(ErrorCode.WRONG_STATE, str(error))
    if isinstance(error, InputError):
        return RpcError(ErrorCode.INVALID_PARAMS, str(error))
    _logger.error("a request failed", exc_info=error)
    return RpcError(
        ErrorCode.INTERNAL,
        f"a bug in the daemon ({type(error).__name__})",
        remedy="see the daemon's log and report it",
    )
