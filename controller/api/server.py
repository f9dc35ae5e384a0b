"""The API's server and the hub of its notifications, within the control loop's event loop.

However much was sent, clients are served in short turns (`controller/api/connection.py`). What
takes longer, such as arming, runs as a task of its own. How often a topic is sent is a row of
`TOPICS` (`controller/api/methods.py`).
"""

import asyncio
import logging
import math
import socket
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

from controller.api.connection import STOP, Acceptor, Admission, Connection, Turns
from controller.api.jsonrpc import (
    ErrorCode,
    Id,
    InvalidRequest,
    RpcError,
    error_line,
    event_line,
    read_params,
    read_request,
    result_line,
    unknown_method,
)
from controller.api.methods import METHODS, TOPICS, TouchParams
from controller.api.schema import (
    MAX_RATE,
    ApiMessage,
    Empty,
    Topic,
)
from controller.sources.touch import CONTACT_TIMEOUT
from drivers.errors import CommandRefused, DriverError, LinkError
from model.errors import InputError
from registry import threads

MAX_PENDING = 8  # requests of one client that take long; stop is not counted
_RESERVE_METHODS = sorted(name for name, method in METHODS.items() if method.in_reserve)

Handler: TypeAlias = Callable[[Connection, Any], ApiMessage | Awaitable[ApiMessage]]

# Made anew each time: an exception that is raised again and again keeps all its tracebacks.
_busy = partial(RpcError, ErrorCode.BUSY, "too many requests", remedy="send fewer per second")

_logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Call:
    """A line as read: a method with its parameters, or an error."""

    id: Id
    expects_response: bool
    method: str = ""
    params: ApiMessage | None = None
    error: Exception | None = None
    record: dict[str, Any] = field(default_factory=dict)  # for dumps, with the outcome

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
    """Serves the methods of the API to clients on a Unix socket.

    handlers: by name of all METHODS, called with the client and the parameters.
    on_disconnect: called with every client that disconnects.
    holds_lease: whether a client holds the arming lease, so that it must not be evicted.
    is_busy: whether a touch is on its way to the wire, for which clients wait.
    stop_all: stops all amplifiers where a client's stop has failed on its way.
    requested: notes a request by its client, its method and when it came [s], and returns the
        record that gets its outcome.
    clock, processor_time: of the process, and of this thread [s].
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
            # Fingers that a client no longer reports count as lifted.
            is_first=lambda client: (
                clock() - client.touched_at <= CONTACT_TIMEOUT or holds_lease(client)
            ),
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
            if isinstance(result, ApiMessage):
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
        self, connection: Connection, call: _Call, result: Awaitable[ApiMessage]
    ) -> None:
        try:
            self._respond(connection, call, await result)
        except Exception as error:
            self._respond(connection, call, error)

    def _respond(
        self, connection: Connection, call: _Call, outcome: ApiMessage | Exception
    ) -> None:
        if isinstance(outcome, ApiMessage):
            call.record["outcome"] = "done"
            if call.expects_response:
                connection.respond(result_line(call.id, outcome.model_dump_json()))
            return
        error = _rpc_error(outcome)
        call.record["outcome"] = call.record["refused"] = str(error)
        if call.expects_response:
            connection.respond(error_line(call.id, error))


async def _for_one_who_stays(
    connection: Connection, silenced: int, handle: Callable[[], ApiMessage | Awaitable[ApiMessage]]
) -> ApiMessage:
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
    return result if isinstance(result, ApiMessage) else await result


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


DEFAULT_RATE = 10.0  # Hz


class Hub:
    """Sends notifications to subscribers.

    current: makes the present data of a topic, None if it has none.
    """

    def __init__(
        self,
        current: Mapping[Topic, Callable[[], ApiMessage | None]],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._current = current
        self._clock = clock
        self._subscribers: dict[Connection, None] = {}  # in the order of their first subscription
        self._newest: dict[Topic, Callable[[], ApiMessage | None]] = {}
        self._flush: asyncio.TimerHandle | None = None
        self._flushed_at = -1.0
        self._failing: set[Topic] = set()
        self.lost = Counter[str]()
        """Notifications that were dropped, as their clients read too slowly, by topic."""

    def subscribe(
        self, connection: Connection, topics: Iterable[Topic], *, rate: float | None = None
    ) -> None:
        """Add topics, and send their current data; rate [Hz]: of those that are periodic."""
        new = sorted(set(topics))
        self.unsubscribe(connection, new)
        self._subscribers[connection] = None
        connection.topics.update(dict.fromkeys(new))
        for topic in new:
            if topic in self._current:
                self._send([connection], topic, self._current[topic])
            if TOPICS[topic].sent == "periodically":
                self._start_timer(connection, topic, 1 / (rate or DEFAULT_RATE))

    def unsubscribe(self, connection: Connection, topics: Iterable[Topic]) -> None:
        """Remove topics."""
        for topic in topics:
            timer = connection.topics.pop(topic, None)
            if timer is not None:
                timer.cancel()

    def forget(self, connection: Connection) -> None:
        """Remove a client that has disconnected."""
        self.unsubscribe(connection, [*connection.topics])
        self._subscribers.pop(connection, None)

    def publish(self, topic: Topic, make_data: Callable[[], ApiMessage | None]) -> None:
        """Send to all subscribers; make_data is called only if there are any.

        Nothing is sent if it returns None, for outdated data.
        """
        if TOPICS[topic].sent != "newest":
            self._send(self._of(topic), topic, make_data)
            return
        if not self._subscribers:
            return
        self._newest.pop(topic, None)  # sent in the order of the newest
        self._newest[topic] = make_data
        if self._flush is None:
            delay = max(0.0, self._flushed_at + 1 / MAX_RATE - self._clock())
            self._flush = asyncio.get_running_loop().call_later(delay, self._flush_now)

    def close(self) -> None:
        """Remove all clients."""
        for connection in list(self._subscribers):
            self.forget(connection)
        if self._flush is not None:
            self._flush.cancel()

    def _flush_now(self) -> None:
        self._flush = None
        self._flushed_at = self._clock()
        newest, self._newest = self._newest, {}
        for topic, make_data in newest.items():
            self._send(self._of(topic), topic, make_data)

    def _of(self, topic: Topic) -> list[Connection]:
        return [each for each in self._subscribers if topic in each.topics]

    def _send(
        self,
        subscribers: Sequence[Connection],
        topic: Topic,
        make_data: Callable[[], ApiMessage | None],
    ) -> None:
        if not subscribers:
            return
        try:
            message = make_data()
            data = b"" if message is None else message.model_dump_json().encode()
        except Exception:  # the next change is sent all the same
            if topic not in self._failing:  # once; marked, as the log is a topic too
                _logger.exception("topic %s: data not made", topic, extra={"topic": topic})
            self._failing.add(topic)
            return
        self._failing.discard(topic)
        if message is None:
            return
        now = self._clock()
        for connection in subscribers:
            self.lost[topic] += connection.notify(
                lambda lost: event_line(topic, time=now, lost=lost, data=data)
            )

    def _start_timer(self, connection: Connection, topic: Topic, period: float) -> None:
        """Send a topic every period [s]."""

        def send() -> None:
            self._send([connection], topic, self._current[topic])
            self._start_timer(connection, topic, period)

        loop = asyncio.get_running_loop()
        connection.topics[topic] = loop.call_later(period, send)
