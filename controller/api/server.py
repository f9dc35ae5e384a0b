"""API server, running in the control loop's event loop.

A `Connection` never waits. Its input is processed line by line, and both its unserved input and its
unread output are bounded. `ApiServer` serves the connections in turns of 0.1 ms plus at most one
request; everything else runs between turns. A turn serves clients that touch or hold the lease
first, and waits while a touch is on its way to the wire. Connections whose input may contain a stop
have separate turns that never wait.

The number of clients is bounded. Additional clients get reserve connections, which serve only
methods that silence, so that another client can always connect and `stop`. Slow methods, such as
arming, run as tasks. `Hub` (`controller/api/hub.py`) sends notifications to the connections.

A request that silences is carried out before its other parts are checked, and counts toward no
limit (`controller/api/silencing.py`). Its errors are reported afterwards.
"""

import asyncio
import logging
import socket
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias, cast

from controller.api.jsonrpc import (
    MAX_LINE_LENGTH,
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
from controller.api.link import credentials_of
from controller.api.methods import METHODS, TouchParams
from controller.api.schema import ApiMessage
from controller.api.silencing import find_silencing_line, read_silencing
from controller.process.log import RateLimiter
from controller.sources.touch import CONTACT_TIMEOUT
from drivers.errors import CommandRefused, DriverError, LinkError
from model.errors import InputError
from registry import threads

MAX_UNREAD_BYTES = 1 << 18  # written but not yet read by the client; notifications use at most half
_MAX_READ = 1 << 14  # bytes per iteration of the event loop
_MAX_READ_AHEAD = 1 << 16  # bytes waiting to be served
UNREAD_TIMEOUT = 5.0  # s; of dropped notifications, before the connection is closed
MAX_REQUEST_RATE = 2000.0  # 1/s, and as many in a burst
MAX_PENDING = 8  # slow requests per client; requests that silence are always accepted
MAX_PENDING_STOPS = 64  # requests without responses; above it no further line is read
_STOP_MARKS = (b'"stop"', b"\\u006", b"\\u007")  # the last two: escaped letters
_MAX_MARK_LENGTH = max(map(len, _STOP_MARKS))

MAX_CONNECTIONS = 32  # for all methods
RESERVE = 8  # additional connections, for the reserve methods only
IDLE_TIMEOUT = 1.0  # s; a client without a request for this long can be evicted
_QUEUE = 512  # connections waiting to be accepted, one per iteration
MAX_TURN = 0.0001  # s, plus one request; the time that a touch can wait for clients
MAX_DEFERRAL = 0.003  # s; of a turn, by touches that follow each other without a gap
_RECHECK = 0.0005  # s; for a deferred turn
_RESERVE_METHODS = sorted(name for name, method in METHODS.items() if method.in_reserve)

# A new exception each time: an exception raised repeatedly accumulates tracebacks.
_busy = partial(RpcError, ErrorCode.BUSY, "too many requests", remedy="send fewer per second")

_logger = logging.getLogger(__name__)


class Connection(asyncio.BufferedProtocol):
    """A client's connection: its input line by line, its bounded output, and its server's state."""

    _transport: asyncio.Transport

    def __init__(self, server: "ApiServer") -> None:
        self.name = "unnamed client"  # until it introduces itself
        self.process = 0  # its id; 0 if unknown
        self.received_at = server.clock()  # s; when the last bytes arrived
        self.is_at_end = False  # whether no more bytes are read; received lines are still served
        # State of the server:
        self.is_reserve = False  # whether it is in reserve
        self.pending: set[asyncio.Task[None]] = set()  # requests without responses
        self.silencing_count = 0  # its stops and disarms so far
        self.touched_at: float | None = None  # s; when it last sent fingers; None if none are down
        self.rate = RateLimiter(MAX_REQUEST_RATE, clock=server.clock)
        self._server = server
        self._received = memoryview(bytearray(_MAX_READ))
        self._input = bytearray()
        self._line_end = -1  # end of the next line in _input; -1: not received yet
        self._stop_at = -1  # position of the last possible stop in _input; -1: none
        self._lost = 0
        self._losing_since: float | None = None  # s; None unless notifications are being dropped

    @property
    def is_open(self) -> bool:
        """Whether it can still be written to."""
        return not self._transport.is_closing()

    @property
    def has_left(self) -> bool:
        """Whether the client has closed its side, is about to be closed, or is lost."""
        return self.is_at_end or not self.is_open

    @property
    def has_lines(self) -> bool:
        """Whether anything can be served now."""
        has_line = self._line_end >= 0 or len(self._input) >= MAX_LINE_LENGTH
        return has_line and self.is_open and len(self.pending) < MAX_PENDING_STOPS

    @property
    def is_urgent(self) -> bool:
        """Whether its input may hold a stop."""
        return self._stop_at >= 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport and ask the server for admission."""
        self._transport = cast(asyncio.Transport, transport)
        # Output is bounded here, by the size of the write buffer.
        self._transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        credentials = credentials_of(transport.get_extra_info("socket"))
        self.process = 0 if credentials is None else credentials[0]
        self._server.admit(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Buffer for the next bytes."""
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Append the bytes received; pause reading while too much waits to be served."""
        self.received_at = self._server.clock()
        old_length = len(self._input)
        self._input += self._received[:nbytes]
        # The beginning of a mark may have been received before.
        start = max(0, old_length - _MAX_MARK_LENGTH + 1)
        last_stop = max(self._input.rfind(mark, start) for mark in _STOP_MARKS)
        self._stop_at = max(self._stop_at, last_stop)
        if self._line_end < 0:
            self._line_end = self._input.find(b"\n", old_length)
        if len(self._input) > _MAX_READ_AHEAD:
            self._transport.pause_reading()
        self._server.add(self)

    def eof_received(self) -> bool:
        """Finish the requests sent before the client closed its side, then close."""
        self.is_at_end = True
        if self._input and not self._input.endswith(b"\n"):  # the last line may lack its line feed
            self._input += b"\n"
            if self._line_end < 0:
                self._line_end = len(self._input) - 1
            self._server.add(self)
        self.close_if_finished()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Report the end; pending requests are still carried out."""
        self._server.client_lost(self)

    def note(self, method: str, params: ApiMessage | None) -> None:
        """Record that the client silences or touches."""
        self.silencing_count += METHODS[method].silences
        if isinstance(params, TouchParams):
            self.touched_at = self._server.clock() if params.touches else None

    def next_line(self) -> bytes:
        """Take the next line, or the start of an overlong line and stop reading."""
        end = self._line_end if self._line_end >= 0 else len(self._input)
        line = bytes(memoryview(self._input)[:end])
        del self._input[: end + 1]
        self._stop_at = max(self._stop_at - end - 1, -1)
        self._line_end = self._input.find(b"\n")
        if end >= MAX_LINE_LENGTH:
            self.is_at_end = True
            self._transport.pause_reading()
        elif len(self._input) <= _MAX_READ_AHEAD and not self.is_at_end:
            self._transport.resume_reading()
        return line

    def take_lines(self) -> bytes:
        """Take all waiting lines, and stop reading."""
        lines = bytes(self._input)
        self._input.clear()
        self._line_end = -1
        self._stop_at = -1
        self.is_at_end = True
        self._transport.pause_reading()
        return lines

    def close_if_finished(self) -> None:
        """Close after the last response, if no more bytes are read from the client."""
        if self.is_at_end and not self.has_lines and not self.pending:
            self.close()

    def respond(self, line: bytes) -> None:
        """Send a response, or close the connection of a client that does not read."""
        unread = self._transport.get_write_buffer_size()
        if unread and unread + len(line) > MAX_UNREAD_BYTES:
            self.abort()
        elif self.is_open:
            self._transport.write(line)

    def notify(self, make_line: Callable[[int], bytes]) -> bool:
        """Send a notification with the number of dropped predecessors, or drop it too.

        Returns whether it was dropped because the client reads too slowly.
        """
        if not self.is_open:
            return False
        if self._transport.get_write_buffer_size() < MAX_UNREAD_BYTES // 2:
            self._transport.write(make_line(self._lost))
            self._lost = 0
            self._losing_since = None
            return False
        now = self._server.clock()
        self._lost += 1
        if self._losing_since is None:
            self._losing_since = now
        if now - self._losing_since > UNREAD_TIMEOUT:
            self.abort()
        return True

    def close(self) -> None:
        """Close after all output is sent."""
        self._transport.close()

    def abort(self) -> None:
        """Close immediately."""
        self._transport.abort()


Handler: TypeAlias = Callable[[Connection, Any], ApiMessage | Awaitable[ApiMessage]]


class _Call:
    """A line of a client: a method with its parameters, and its error, if any.

    A line that silences is only identified at first, so that nothing delays it; `read` then finds
    its errors.
    """

    def __init__(self, line: bytes) -> None:
        self.id: Id = None
        self.expects_response = True
        self.method = ""
        self.params: ApiMessage | None = None
        self.error: Exception | None = None
        self._line = line
        silencing = read_silencing(line)
        self.silences = silencing is not None
        if silencing is None:
            self.read()
        else:
            self.method = silencing.method
            self.params = silencing.params

    def read(self) -> None:
        """Read the line strictly."""
        try:
            self._read()
        except InvalidRequest as error:
            self.id = error.id
            self.error = error
        except Exception as error:  # invalid parameters, or a bug
            self.error = error

    def _read(self) -> None:
        if len(self._line) >= MAX_LINE_LENGTH:
            problem = f"line longer than {MAX_LINE_LENGTH} bytes"
            raise InvalidRequest(ErrorCode.PARSE, problem, remedy="send less")
        request = read_request(self._line)
        self.id = request.id
        self.expects_response = request.expects_response
        if request.method not in METHODS:
            raise unknown_method(request.method, METHODS)
        self.params = read_params(METHODS[request.method].params, request)
        self.method = request.method

    @property
    def is_limited(self) -> bool:
        """Whether it counts toward the request rate."""
        if self.silences:
            return False
        return self.error is not None or METHODS[self.method].is_limited

    @property
    def lacks_reply(self) -> bool:
        """Whether its method needs a reply, such as a lease, that the client did not request."""
        return METHODS[self.method].needs_reply and not self.expects_response


class ApiServer:
    """Serves the methods of the API to clients on a Unix socket.

    handlers: one for each of METHODS, by name, called with the client and the parameters.
    on_disconnect: called with every client that disconnects.
    holds_lease: whether a client holds the arming lease and must not be evicted.
    is_busy: whether a touch is on its way to the wire; clients wait meanwhile.
    stop_all: stops all amplifiers if a client's stop fails before it reaches them.
    clock: clock of the process [s].
    """

    def __init__(
        self,
        handlers: Mapping[str, Handler],
        *,
        on_disconnect: Callable[[Connection], None],
        holds_lease: Callable[[Connection], bool],
        is_busy: Callable[[], bool] = lambda: False,
        stop_all: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = threads.now,
    ) -> None:
        self.clock = clock
        self.clients: dict[Connection, None] = {}
        self._handlers = handlers
        self._on_disconnect = on_disconnect
        self._holds_lease = holds_lease
        self._is_busy = is_busy
        self._stop_all = stop_all
        self._listening: asyncio.Server | None = None
        self._waiting: dict[Connection, None] = {}  # waiting to be served, in this order
        self._scheduled: set[bool] = set()  # scheduled turns; True: for possible stops
        self._deferred_since: float | None = None  # s

    async def open(self, bound: socket.socket) -> None:
        """Listen on a bound Unix socket; its permissions decide who may connect."""
        loop = asyncio.get_running_loop()
        # asyncio accepts as many connections per iteration as its backlog holds.
        self._listening = await loop.create_unix_server(
            partial(Connection, self), sock=bound, backlog=1
        )
        bound.listen(_QUEUE)

    async def close(self) -> None:
        """Stop listening and close all connections after their pending output."""
        if self._listening is None:
            return
        await threads.stop_accepting(self._listening)
        for end in (Connection.close, Connection.abort):
            for client in list(self.clients):
                end(client)
            await asyncio.sleep(0)

    def admit(self, new: Connection) -> None:
        """Admit a new client, if necessary in place of another, or close it."""
        new.is_reserve = not self._make_room()
        if new.is_reserve:
            reserve = [client for client in self.clients if client.is_reserve]
            if len(reserve) >= RESERVE:
                self._evict_from([new, *reserve])
        if new.is_open:
            self.clients[new] = None

    def _evict_from(self, reserve: Sequence[Connection]) -> None:
        """Close the longest idle connection of the process with the most reserve connections.

        Other processes keep theirs.
        """
        counts = Counter(client.process for client in reserve)

        def precedence(client: Connection) -> tuple[int, float]:
            return -counts[client.process], client.received_at

        evicted = min([client for client in reserve if not client.pending], key=precedence)
        self.clients.pop(evicted, None)
        evicted.abort()

    def _make_room(self) -> bool:
        """Free a full connection, if necessary by evicting the longest idle client.

        Returns whether one is free.
        """
        full = [client for client in self.clients if not client.is_reserve]
        if len(full) < MAX_CONNECTIONS:
            return True
        idle = [client for client in full if not client.pending and not self._holds_lease(client)]
        evicted = min(idle, key=lambda client: client.received_at, default=None)
        if evicted is None or self.clock() - evicted.received_at < IDLE_TIMEOUT:
            return False
        del self.clients[evicted]
        evicted.abort()
        return True

    def client_lost(self, client: Connection) -> None:
        """Carry out stops left in the input of a lost client, then remove it."""
        self._serve_last_stops(client)
        self.clients.pop(client, None)
        self._waiting.pop(client, None)
        self._on_disconnect(client)

    def add(self, client: Connection) -> None:
        """Serve a client that has lines; immediately if one may be a stop.

        Other clients have their turn two iterations later. Data that arrived meanwhile, and the
        tasks it wakes, such as the control loop for a touch, run first.
        """
        if not client.has_lines:
            return
        self._waiting.setdefault(client)
        if client.is_urgent not in self._scheduled:
            self._scheduled.add(client.is_urgent)
            loop = asyncio.get_running_loop()
            if client.is_urgent:
                loop.call_soon(self._take_turn, True)
            else:
                loop.call_soon(loop.call_soon, self._take_turn, False)

    def _take_turn(self, is_urgent: bool) -> None:
        """Serve one line of each client of a rank in rotation, until the turn's time is up.

        Serves at least one line of each rank, so that no rank blocks the next one forever.
        """
        if not is_urgent and self._is_deferred():
            asyncio.get_running_loop().call_later(_RECHECK, self._take_turn, False)
            return
        self._scheduled.discard(is_urgent)
        end = time.perf_counter() + MAX_TURN
        ranks = (0,) if is_urgent else (1, 2)
        try:
            for rank in ranks:
                self._serve_rank(rank, end)
        finally:  # after any failure: others are waiting, perhaps with a stop
            for client in list(self._waiting):
                self.add(client)

    def _serve_rank(self, rank: int, end: float) -> None:
        """Serve the clients of a rank in rotation until a time of the performance counter [s]."""
        clients = deque(client for client in self._waiting if self._rank(client) == rank)
        while clients:
            client = clients.popleft()
            self._waiting.pop(client, None)
            try:
                if client.has_lines:
                    self._serve(client, client.next_line())
            finally:  # after any failure: its next line may be a stop
                if client.has_lines:  # to the end of the queue
                    self._waiting[client] = None
                    clients.append(client)
            client.close_if_finished()
            if time.perf_counter() >= end:
                break

    def _is_deferred(self) -> bool:
        """Whether a turn waits for a touch on its way to the wire."""
        now = self.clock()
        if not self._is_busy():
            self._deferred_since = None
        elif self._deferred_since is None:
            self._deferred_since = now
        elif now - self._deferred_since >= MAX_DEFERRAL:
            self._deferred_since = None
        return self._deferred_since is not None

    def _rank(self, client: Connection) -> int:
        """Return a client's rank: 0 for a possible stop, 1 if it touches or holds the lease."""
        if client.is_urgent:
            return 0
        # Fingers that the client no longer reports count as lifted.
        at = client.touched_at
        touches = at is not None and self.clock() - at <= CONTACT_TIMEOUT
        return 1 if touches or self._holds_lease(client) else 2

    def _serve(self, client: Connection, line: bytes) -> None:
        """Carry out a line of a client, or start a task for it; respond if it is finished."""
        call = _Call(line)
        if call.is_limited and not client.rate.take():
            if call.error is not None:
                client.respond(error_line(None, _busy()))
                self._serve_last_stops(client)
                return
            call.error = _busy()
        try:
            if not call.silences:
                self._check(client, call)
            client.note(call.method, call.params)
            if call.lacks_reply:
                return
            result = self._start(client, call)
            if isinstance(result, ApiMessage):
                self._respond(client, call, result)
                return
        except Exception as error:
            try:
                if call.silences:
                    self._stop_all()
            finally:
                self._respond(client, call, error)
            return
        task = asyncio.ensure_future(self._finish(client, call, result))
        client.pending.add(task)
        task.add_done_callback(lambda task: self._finished(client, task))

    def _serve_last_stops(self, client: Connection) -> None:
        """Carry out the waiting request of a client that silences most, and end its input."""
        line = find_silencing_line(client.take_lines())
        if line is not None:
            self._serve(client, line)

    def _start(self, client: Connection, call: _Call) -> ApiMessage | Awaitable[ApiMessage]:
        """Call the handler of a method; an arm handler first waits for more input."""
        handle = partial(self._handlers[call.method], client, call.params)
        if METHODS[call.method].needs_reply:
            return _handle_unless_withdrawn(client, client.silencing_count, handle)
        return handle()

    def _check(self, client: Connection, call: _Call) -> None:
        """Raise an error if a call must not be carried out.

        Moves the client out of the reserve if there is room.
        """
        if call.error is not None:
            raise call.error
        if client.is_reserve and not METHODS[call.method].in_reserve:
            client.is_reserve = not self._make_room()
            if client.is_reserve:
                raise RpcError(
                    ErrorCode.BUSY,
                    f"too many clients; only {', '.join(_RESERVE_METHODS)} are served here",
                    remedy="try again later",
                )
        if len(client.pending) >= MAX_PENDING:
            raise RpcError(ErrorCode.BUSY, "too many pending requests", remedy="await responses")

    async def _finish(self, client: Connection, call: _Call, result: Awaitable[ApiMessage]) -> None:
        try:
            self._respond(client, call, await result)
        except Exception as error:
            self._respond(client, call, error)

    def _finished(self, client: Connection, task: "asyncio.Task[None]") -> None:
        client.pending.discard(task)
        self.add(client)
        client.close_if_finished()

    def _respond(self, client: Connection, call: _Call, outcome: ApiMessage | Exception) -> None:
        """Send the response to a call."""
        if call.silences:
            call.read()
        if isinstance(outcome, Exception):
            response = error_line(call.id, _rpc_error(outcome))
        elif call.error is not None:
            error = _carried_out_despite(_rpc_error(call.error), call.method)
            response = error_line(call.id, error)
        else:
            response = result_line(call.id, outcome.model_dump_json())
        if call.expects_response:
            client.respond(response)


async def _handle_unless_withdrawn(
    client: Connection,
    silencing_count: int,
    handle: Callable[[], ApiMessage | Awaitable[ApiMessage]],
) -> ApiMessage:
    """Handle a request, unless the client leaves or silences all amplifiers in the same bytes.

    silencing_count: number of its stops and disarms before the request.
    """
    for _ in range(2):  # iterations that receive the end of its input
        await asyncio.sleep(0)
    if client.silencing_count != silencing_count:
        raise RpcError(ErrorCode.LEASE, "stopped or disarmed meanwhile", remedy="arm again")
    if client.has_left:
        raise RpcError(ErrorCode.LEASE, "the client has left", remedy="stay to renew the lease")
    result = handle()
    return result if isinstance(result, ApiMessage) else await result


def _rpc_error(error: Exception) -> RpcError:
    """Translate an exception for the client; the details of a bug go only to the log."""
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


def _carried_out_despite(error: RpcError, method: str) -> RpcError:
    """Return the error of a request that silences and was carried out."""
    data = error.data
    problem = f"{data.what} ({method} was carried out nevertheless)"
    return RpcError(error.code, problem, where=data.where, remedy=data.remedy)
