"""The API's server: serves all clients in turn, within the control loop's event loop.

However much was sent, they are served in short turns (`controller/api/turns.py`). What takes
longer, such as arming, runs as a task of its own.
"""

import asyncio
import logging
import math
import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

from controller.api.admission import Acceptor, Admission
from controller.api.connection import STOP, Connection
from controller.api.jsonrpc import (
    ErrorCode,
    Id,
    InvalidRequest,
    RpcError,
    error_line,
    read_params,
    read_request,
    result_line,
    unknown_method,
)
from controller.api.methods import TouchParams
from controller.api.registered import METHODS
from controller.api.schema import Empty, Message
from controller.api.turns import Turns
from controller.sources.contacts import CONTACT_TIMEOUT
from drivers.errors import CommandRefused, DriverError, LinkError
from model.errors import InputError
from registry import threads

MAX_PENDING = 8  # requests of one client that take long; stop is not counted
_RESERVE_METHODS = sorted(name for name, method in METHODS.items() if method.in_reserve)

Handler: TypeAlias = Callable[[Connection, Any], Message | Awaitable[Message]]

# Made anew each time: an exception that is raised again and again keeps all its tracebacks.
_busy = partial(RpcError, ErrorCode.BUSY, "too many requests", remedy="send fewer per second")

_logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Call:
    """A line as read: a method with its parameters, or an error; record: what is noted of it."""

    id: Id
    expects_response: bool
    method: str = ""
    params: Message | None = None
    error: Exception | None = None
    record: dict[str, Any] = field(default_factory=dict)

    def is_superseded_by(self, other: "_Call | None") -> bool:
        """Whether both are touch frames of one source without an id, and the newer one is enough.

        A frame holds all fingers of its source, hence no lift is lost; nor is a finger that came,
        for the newer one must have all of the older one.
        """
        return (
            other is not None
            and not (self.expects_response or other.expects_response)
            and isinstance(self.params, TouchParams)
            and isinstance(other.params, TouchParams)
            and self.params.source == other.params.source
            and {each.id for each in self.params.touches}
            <= {each.id for each in other.params.touches}
        )


def _read_call(line: bytes) -> _Call:
    try:
        request = read_request(line)
        if request.method not in METHODS:
            raise unknown_method(request.method, METHODS)
        params = read_params(METHODS[request.method].params, request)
    except InvalidRequest as error:
        return _Call(error.id, True, error=error)
    except RpcError as error:
        return _Call(request.id, request.expects_response, error=error)
    return _Call(request.id, request.expects_response, request.method, params)


class ApiServer:
    """Serves the methods of the API.

    handlers: of all METHODS, called with the client and the parameters; on_disconnect: called with
    every client that disconnects; holds_lease: whether a client does, and must not be evicted;
    is_busy: whether a touch is on its way to the wire,
    for which clients wait; stop_all: requests a stop of all amplifiers, whatever has failed on the
    way of a client's; requested: notes a request by its client, its method and when it came [s],
    and returns the record that gets its outcome; clock [s]; processor_time: of this thread [s].
    """

    def __init__(
        self,
        handlers: Mapping[str, Handler],
        *,
        on_disconnect: Callable[[Connection], None],
        holds_lease: Callable[[Connection], bool],
        is_busy: Callable[[], bool] = lambda: False,
        stop_all: Callable[[], object] = lambda: None,
        requested: Callable[[str, str, float], dict[str, Any]] = lambda *_: {},
        clock: Callable[[], float] = threads.now,
        processor_time: Callable[[], float] = time.thread_time,
    ) -> None:
        self._handlers = handlers
        self._on_disconnect = on_disconnect
        self._stop_all = stop_all
        self._requested = requested
        self._clock = clock
        self._admission = Admission(holds_lease=holds_lease, clock=clock)
        self._turns = Turns(
            self._serve_line,
            is_first=lambda client: self._is_touching(client) or holds_lease(client),
            is_busy=is_busy,
            clock=clock,
            processor_time=processor_time,
        )
        self._acceptor: Acceptor | None = None

    async def open(self, bound: socket.socket) -> None:
        """Listen on a bound Unix socket; its permissions decide who may connect."""
        self._acceptor = Acceptor(bound, self._make_connection, clock=self._clock)

    async def close(self) -> None:
        """Stop listening and close all connections after their pending output."""
        if self._acceptor is None:
            return
        await self._acceptor.close()
        for connection in list(self._admission.admitted):
            connection.close()
        await asyncio.sleep(0)
        for connection in list(self._admission.admitted):
            connection.abort()

    def _make_connection(self, process: int) -> Connection:
        return Connection(
            process,
            on_connect=self._admission.admit,
            on_lines=self._turns.add,
            on_disconnect=self._disconnected,
            clock=self._clock,
        )

    def _disconnected(self, connection: Connection) -> None:
        self._admission.admitted.discard(connection)
        self._on_disconnect(connection)

    def _is_touching(self, connection: Connection) -> bool:
        """Whether fingers of a client are down; those that it no longer reports count as lifted."""
        return self._clock() - connection.touched_at <= CONTACT_TIMEOUT

    def _serve_line(self, connection: Connection) -> None:
        """Serve the next line of a client, or start to."""
        call = self._next_call(connection)
        if call is None:
            return
        try:
            call.record = self._requested(connection.name, call.method, connection.received_at)
            self._check(connection, call)
            method, handle = METHODS[call.method], self._handlers[call.method]
            connection.silenced += method.silences
            if not method.needs_reply:
                result = handle(connection, call.params)
            elif call.expects_response:
                work = partial(handle, connection, call.params)
                result = _for_one_who_stays(connection, connection.silenced, work)
            else:
                result = Empty()
            if isinstance(result, Message):
                self._respond(connection, call, result)
                return
        except Exception as error:
            if call.method == "stop":
                self._stop_all()
            self._respond(connection, call, error)
            return
        task = asyncio.ensure_future(self._finish(connection, call, result))
        connection.pending.add(task)
        task.add_done_callback(lambda task: self._finished(connection, task))

    def _next_call(self, connection: Connection) -> _Call | None:
        """Read the next line, unless it is a touch frame that the one after replaces.

        That one is then read, and ahead.
        """
        call: _Call | None = connection.ahead or self._read(connection)
        connection.ahead = None
        if call is not None and not connection.is_open and call.method != "stop":
            return None  # the client has left: its fingers are lifted, and its lease has ended
        if call is not None and isinstance(call.params, TouchParams):
            connection.touched_at = self._clock() if call.params.touches else -math.inf
            connection.ahead = self._read(connection)
            if call.is_superseded_by(connection.ahead):
                return None
        return call

    def _read(self, connection: Connection) -> _Call | None:
        """Read the next line, within the client's rate; refused requests count."""
        is_urgent = connection.is_urgent
        try:
            line = connection.next_line()
        except InvalidRequest as error:
            connection.refuse(error)
            return None
        if line is None:
            return None
        try:
            call = _read_call(line)
        except Exception as error:  # a bug: what may be a stop is one
            if STOP in line:
                self._stop_all()
            call = _Call(None, True, error=error)
        if is_urgent and STOP in line and call.method != "stop":
            connection.note_false_alarm()
        is_limited = call.error is not None or METHODS[call.method].is_limited
        if not is_limited or connection.rate.take():
            return call
        if call.error is not None:
            connection.refuse(_busy())
            return None
        return replace(call, params=None, error=_busy())

    def _finished(self, connection: Connection, task: "asyncio.Task[None]") -> None:
        connection.pending.discard(task)
        if connection.has_lines:
            self._turns.add(connection)
        connection.close_if_finished()

    def _check(self, connection: Connection, call: _Call) -> None:
        """Raise why a call is not carried out."""
        if call.error is not None:
            raise call.error
        if not METHODS[call.method].in_reserve and not self._admission.promote(connection):
            raise RpcError(
                ErrorCode.BUSY,
                f"too many clients; only {', '.join(_RESERVE_METHODS)} are served here",
                remedy="try again later",
            )
        if call.method != "stop" and len(connection.pending) >= MAX_PENDING:
            raise RpcError(ErrorCode.BUSY, "too many pending requests", remedy="await responses")

    async def _finish(
        self, connection: Connection, call: _Call, result: Awaitable[Message]
    ) -> None:
        try:
            self._respond(connection, call, await result)
        except Exception as error:
            self._respond(connection, call, error)

    def _respond(self, connection: Connection, call: _Call, outcome: Message | Exception) -> None:
        if isinstance(outcome, Message):
            call.record["outcome"] = "done"
            if call.expects_response:
                connection.respond(result_line(call.id, outcome.model_dump_json()))
            return
        error = _rpc_error(outcome)
        call.record["outcome"] = call.record["refused"] = str(error)
        if call.expects_response:
            connection.respond(error_line(call.id, error))


async def _for_one_who_stays(
    connection: Connection, silenced: int, handle: Callable[[], Message | Awaitable[Message]]
) -> Message:
    """Handle a request of a client that has not left, or silenced all, with the same bytes.

    silenced: its stops and disarms before the request.
    """
    for _ in range(2):  # iterations in which its end is received
        await asyncio.sleep(0)
    if connection.silenced != silenced:
        raise RpcError(ErrorCode.LEASE, "stopped or disarmed meanwhile", remedy="arm again")
    if connection.has_left:
        raise RpcError(ErrorCode.LEASE, "the client has left", remedy="stay to renew the lease")
    result = handle()
    return result if isinstance(result, Message) else await result


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
