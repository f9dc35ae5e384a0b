"""Clients' connections to the API server: bytes and lines, who is admitted, and whose turn it is.

`Connection` never waits. The server takes lines one at a time from all connections in turn, so
that a flood on one costs the others nothing; output that a client does not read is bounded, then
dropped.

`Acceptor` accepts one connection per turn and refuses those above a rate per process. A refusal
takes some microseconds, so that processes that connect again and again delay neither the control
loop nor the clients that wait behind them in the queue.

`Admission` keeps places in reserve for methods that silence, so that another client can always
connect and `stop`. It evicts a client that has sent nothing yet first, then an idle subscriber,
then any idle client; never one that holds the arming lease or waits for a response. The reserve is
shared among processes: a client of the process with the most there is evicted, silent ones first,
but none whose first bytes have arrived unread.

`Turns` serves clients in short turns, with what the control loop leaves. A share of the event
loop's processor time, saved up for bursts, is for clients that touch or hold the lease, another one
for all other clients. A turn waits while a touch is on its way to the wire. A client whose input
may hold a stop is served at once, within neither limit.
"""

import asyncio
import contextlib
import math
import os
import resource
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

from controller.api.jsonrpc import MAX_LINE_LENGTH, ErrorCode, InvalidRequest, RpcError, error_line
from controller.api.link import credentials_of
from controller.api.schema import Topic
from controller.process.log import RateLimiter, Rates

MAX_UNREAD_BYTES = 1 << 18  # written but not read by the client
_MAX_UNREAD_NOTIFICATIONS = MAX_UNREAD_BYTES // 2  # bytes; the rest is reserved for responses
_MAX_READ = 1 << 14  # bytes in an iteration of the event loop
_MAX_READ_AHEAD = 1 << 16  # bytes that wait to be served
UNREAD_TIMEOUT = 5.0  # s; for losing notifications before the connection is closed

MAX_REQUEST_RATE = 2000.0  # 1/s, and as many in a burst
STOP = b'"stop"'
_DISTRUST = 0.1  # s; after lines that look like a stop
MAX_PENDING_STOPS = 64  # requests without responses, above which no further line is taken


class Connection(asyncio.BufferedProtocol):
    """A client's connection.

    process: id of the client's process, 0 if unknown.
    on_connect, on_disconnect: called once at the beginning and at the end.
    on_lines: called when lines wait to be served.
    """

    def __init__(
        self,
        process: int,
        *,
        on_connect: "Callable[[Connection], None]",
        on_lines: "Callable[[Connection], None]",
        on_disconnect: "Callable[[Connection], None]",
        clock: Callable[[], float],
    ) -> None:
        self.process = process
        self.name = "unnamed client"
        self.received_at = clock()  # s; when the last bytes arrived
        self.has_spoken = False  # whether it has sent a complete line
        self.is_reserve = False  # whether it is in reserve
        self.reading_time = 0.0  # s; processor time of reading, not yet subtracted from a budget
        self.is_at_end = False  # whether it has closed its side
        self.pending: set[asyncio.Task[None]] = set()
        self.silenced = 0  # its stops and disarms
        self.touched_at = -math.inf  # s; when it sent fingers, unless it has lifted them since
        self.ahead: Any = None  # a request that was read from the next line, but not served
        self.topics: dict[Topic, asyncio.TimerHandle | None] = {}  # subscriptions; None: unperiodic
        self.lease = ""  # token of the last lease that it armed or renewed
        self.number: int | None = None  # of those that have touched
        self._on_connect = on_connect
        self._on_lines = on_lines
        self._on_disconnect = on_disconnect
        self._clock = clock
        self._transport: asyncio.Transport | None = None
        self._read_at = 0.0  # s; processor time
        self._received = memoryview(bytearray(_MAX_READ))
        self._input = bytearray()
        self._line_end = -1  # of the next line in _input; -1: not received yet
        self._stop_at = -1  # of the last text in _input that may be a stop; -1: none
        self._distrusted_until = -math.inf  # s
        self._lost = 0
        self._losing_since: float | None = None
        self.rate = RateLimiter(MAX_REQUEST_RATE, clock=clock)

    @property
    def is_open(self) -> bool:
        """Whether it can still be written to."""
        return self._transport is not None and not self._transport.is_closing()

    @property
    def has_left(self) -> bool:
        """Whether the client has closed its side, or the connection is lost."""
        return self.is_at_end or not self.is_open

    @property
    def is_unread(self) -> bool:
        """Whether its first bytes have arrived and were not read."""
        connected = self._transport.get_extra_info("socket") if self._transport else None
        if self.has_spoken or self._input or connected is None:
            return False
        poll = select.poll()
        poll.register(connected, select.POLLIN)
        return bool(poll.poll(0))

    @property
    def has_lines(self) -> bool:
        """Whether anything can be served now."""
        return (
            self.is_open
            and (self.ahead is not None or self._has_line)
            and len(self.pending) < MAX_PENDING_STOPS
        )

    @property
    def is_urgent(self) -> bool:
        """Whether a stop is ahead, or its input may hold one."""
        return getattr(self.ahead, "method", None) == "stop" or (
            self._stop_at >= 0 and self._clock() >= self._distrusted_until
        )

    @property
    def _has_line(self) -> bool:
        return self._line_end >= 0 or len(self._input) >= MAX_LINE_LENGTH

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport and ask the server for admission."""
        self._transport = cast(asyncio.Transport, transport)
        # Output is bounded here, by the size of the write buffer.
        self._transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        self._on_connect(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Buffer for the next bytes."""
        self._read_at = time.thread_time()
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Keep the bytes received, undivided; pause reading while much waits to be served."""
        self.received_at = self._clock()
        before = len(self._input)
        self._input += self._received[:nbytes]
        self._stop_at = max(self._stop_at, self._input.rfind(STOP, max(0, before - len(STOP) + 1)))
        if self._line_end < 0:
            self._line_end = self._input.find(b"\n", before)
        if self._has_line:
            self.has_spoken = True
            if len(self._input) > _MAX_READ_AHEAD and self._transport is not None:
                self._transport.pause_reading()
        if self.has_lines:
            self._on_lines(self)
        self.reading_time += time.thread_time() - self._read_at

    def eof_received(self) -> bool:
        """Finish what the client requested before it closed its side, then close."""
        self.is_at_end = True
        self.close_if_finished()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Report the end; pending requests are carried out all the same."""
        self._transport = None
        self._on_disconnect(self)

    def next_line(self) -> bytes | None:
        """Take the next line, or None; raises InvalidRequest if it is too long."""
        if not self.is_open or not self._has_line:
            return None
        end = self._line_end
        if not 0 <= end < MAX_LINE_LENGTH:
            raise InvalidRequest(
                ErrorCode.PARSE, f"line longer than {MAX_LINE_LENGTH} bytes", remedy="send less"
            )
        line = bytes(memoryview(self._input)[:end])
        del self._input[: end + 1]
        self._stop_at = max(self._stop_at - end - 1, -1)
        self._line_end = self._input.find(b"\n")
        if len(self._input) <= _MAX_READ_AHEAD and self._transport is not None:
            self._transport.resume_reading()
        return line

    def close_if_finished(self) -> None:
        """Close after the last response, if the client has closed its side."""
        if self.is_at_end and not self.has_lines and not self.pending:
            self.close()

    def note_false_alarm(self) -> None:
        """Note that it is urgent without a stop, which for a while it cannot be again."""
        self._distrusted_until = self._clock() + _DISTRUST

    def respond(self, line: bytes) -> None:
        """Send a response, or close the connection of a client that does not read."""
        if self._transport is None or self._transport.is_closing():
            return
        unread = self._transport.get_write_buffer_size()
        if unread and unread + len(line) > MAX_UNREAD_BYTES:
            self._transport.abort()
            return
        self._transport.write(line)

    def notify(self, make_line: Callable[[int], bytes]) -> bool:
        """Send a notification, made with the number of those dropped before it, or drop it too.

        Returns whether it was dropped because the client reads too slowly.
        """
        if self._transport is None or self._transport.is_closing():
            return False
        if self._transport.get_write_buffer_size() < _MAX_UNREAD_NOTIFICATIONS:
            self._transport.write(make_line(self._lost))
            self._lost, self._losing_since = 0, None
            return False
        self._lost += 1
        now = self._clock()
        if self._losing_since is None:
            self._losing_since = now
        elif now - self._losing_since > UNREAD_TIMEOUT:
            self._transport.abort()
        return True

    def refuse(self, error: RpcError) -> None:
        """Send an error and close."""
        self.respond(error_line(None, error))
        self.close()

    def close(self) -> None:
        """Close after all output is sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()


MAX_CONNECTIONS = 32  # for all methods
RESERVE = 8  # further ones, for the methods in reserve alone
IDLE_TIMEOUT = 1.0  # s; without a request, after which a client may be evicted
SILENT_TIMEOUT = 0.1  # s; the same for one that has sent nothing yet
MAX_CONNECTION_RATE = 20.0  # 1/s; connections of one process
CONNECTION_BURST = 64  # connections
_QUEUE = 512  # connections
_REFUSALS_PER_TURN = 8
_PAUSE = 0.1  # s; while there is no descriptor at all


class Admission:
    """The connected clients; holds_lease: whether a client holds the arming lease."""

    def __init__(
        self, *, holds_lease: Callable[[Connection], bool], clock: Callable[[], float]
    ) -> None:
        self.admitted: set[Connection] = set()
        self._holds_lease = holds_lease
        self._clock = clock

    def admit(self, new: Connection) -> None:
        """Admit a new client, if necessary in place of another, or close it."""
        new.is_reserve = not self._has_room()
        if new.is_reserve:
            reserve = [each for each in self.admitted if each.is_reserve]
            if len(reserve) >= RESERVE:
                evicted = _evictable(reserve, new)
                if evicted is None:
                    new.abort()
                    return
                self._drop(evicted)
        self.admitted.add(new)

    def promote(self, one: Connection) -> bool:
        """Move a client out of the reserve if there is room; return whether it is out of it."""
        if one.is_reserve and self._has_room():
            one.is_reserve = False
        return not one.is_reserve

    def _has_room(self) -> bool:
        full = [each for each in self.admitted if not each.is_reserve]
        if len(full) < MAX_CONNECTIONS:
            return True
        candidates = [each for each in full if not each.pending and not self._holds_lease(each)]
        now, timeout = self._clock(), SILENT_TIMEOUT
        idle = [each for each in candidates if not each.has_spoken]
        if not idle:
            timeout = IDLE_TIMEOUT
            expired = [each for each in candidates if now - each.received_at >= timeout]
            idle = [each for each in expired if each.topics] or expired
        evictable = min(idle, key=lambda each: each.received_at, default=None)
        if evictable is None or now - evictable.received_at < timeout:
            return False
        self._drop(evictable)
        return True

    def _drop(self, one: Connection) -> None:
        self.admitted.discard(one)
        one.abort()


def _evictable(reserve: list[Connection], new: Connection) -> Connection | None:
    """The client in reserve that a new one replaces, or None.

    Of its own process, or of one with more clients there.
    """
    counts = Counter(each.process for each in reserve)
    candidates = [
        each
        for each in reserve
        if not each.pending
        and (each.process == new.process or counts[each.process] > counts[new.process])
        and not each.is_unread
    ]
    return min(
        candidates,
        key=lambda each: (-counts[each.process], each.has_spoken, each.received_at),
        default=None,
    )


class Acceptor:
    """Accepts connections of a bound Unix socket.

    make_connection: called with the id of the connecting process. clock [s].
    """

    def __init__(
        self,
        bound: socket.socket,
        make_connection: Callable[[int], Connection],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._bound = bound
        self._make_connection = make_connection
        self._loop = asyncio.get_running_loop()
        self._beginning: set[asyncio.Task[object]] = set()
        self._rates = Rates(MAX_CONNECTION_RATE, burst=CONNECTION_BURST, clock=clock)
        self._spare = _spare_descriptor()
        bound.setblocking(False)
        bound.listen(_QUEUE)
        self._start_serving()

    async def close(self) -> None:
        """Stop listening; return once what was accepted is open."""
        self._loop.remove_reader(self._bound)
        self._bound.close()
        if self._spare is not None:
            os.close(self._spare)
        await asyncio.gather(*self._beginning, return_exceptions=True)

    def _start_serving(self) -> None:
        if self._bound.fileno() >= 0:
            self._loop.add_reader(self._bound, self._accept)

    def _accept(self) -> None:
        """Accept one connection, after at most some that are refused."""
        for _ in range(_REFUSALS_PER_TURN):
            try:
                accepted, _ = self._bound.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError:
                self._refuse_without_descriptors()
                return
            process, _ = credentials_of(accepted) or (0, 0)
            if self._rates.of(process).take():
                make = partial(self._make_connection, process)
                task = self._loop.create_task(self._loop.connect_accepted_socket(make, accepted))
                self._beginning.add(task)
                task.add_done_callback(self._beginning.discard)
                return
            accepted.close()

    def _refuse_without_descriptors(self) -> None:
        """Refuse a connection by means of the spare descriptor; pause if it was taken meanwhile."""
        if self._spare is not None:
            os.close(self._spare)
            with contextlib.suppress(OSError):
                self._bound.accept()[0].close()
        self._spare = _spare_descriptor()
        if self._spare is None:
            self._loop.remove_reader(self._bound)
            self._loop.call_later(_PAUSE, self._start_serving)


def _spare_descriptor() -> int | None:
    """A descriptor to be given up for another, or None if there is no more."""
    try:
        return os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None


MIN_DESCRIPTORS = 64
_MAX_DESCRIPTORS = 65_536


def allow_many_descriptors() -> int:
    """Raise the limit, so that idle connections do not use it up; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = _MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else hard
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        return limit
    return soft


MAX_TURN = 0.0001  # s, and one request; how long a touch waits for clients of either share
SHARE = 0.25  # of the event loop's time, for those that touch, and for the others together
BURST = 0.02  # s of processor time, saved up
MAX_DEFERRAL = 0.003  # s; of a turn by touches, which may follow each other without a gap
_RECHECK = 0.0005  # s; of a turn that is deferred


@dataclass(eq=False, slots=True)
class _Lane:
    """Clients that wait, and their next turn."""

    budget: RateLimiter  # of processor time
    is_urgent: bool = False  # served at once, whatever is left of the budget
    waiting: deque[Connection] = field(default_factory=deque)
    is_scheduled: bool = False
    deferred_since: float | None = None


class Turns:
    """Serves waiting clients in turn, a line of each.

    serve: serves one line of a client.
    is_first: whether a client touches or holds the lease.
    is_busy: whether a touch is on its way to the wire.
    clock, processor_time: of the process, and of this thread [s].
    """

    def __init__(
        self,
        serve: Callable[[Connection], None],
        *,
        is_first: Callable[[Connection], bool],
        is_busy: Callable[[], bool],
        clock: Callable[[], float],
        processor_time: Callable[[], float],
    ) -> None:
        self._serve = serve
        self._is_busy = is_busy
        self._clock = clock
        self._processor_time = processor_time
        self._is_first = is_first
        first, others = (RateLimiter(SHARE, burst=BURST, clock=clock) for _ in range(2))
        self._first, self._others = _Lane(first), _Lane(others)
        self._urgent = _Lane(others, is_urgent=True)

    def add(self, connection: Connection) -> None:
        """Serve a client that has lines."""
        lanes = (self._urgent, self._first, self._others)
        waits_in = next((each for each in lanes if connection in each.waiting), None)
        if connection.is_urgent:
            lane = self._urgent
        elif waits_in is not None:
            return
        else:
            lane = self._first if self._is_first(connection) else self._others
        if lane is not waits_in:
            if waits_in is not None:
                waits_in.waiting.remove(connection)
            lane.waiting.append(connection)
            if lane.is_urgent:  # before what has arrived meanwhile
                asyncio.get_running_loop().call_soon(self._take_turn, lane)
            else:
                self._schedule(lane)

    def _schedule(self, lane: _Lane, delay: float = 0.0) -> None:
        """Schedule a turn unless one is: after a delay [s], or in the next iteration but one.

        Data that arrived meanwhile and what it wakes, such as the control loop for a touch, run
        first.
        """
        if not lane.waiting or lane.is_scheduled:
            return
        lane.is_scheduled = True
        loop = asyncio.get_running_loop()
        if delay > 0:
            loop.call_later(delay, self._take_turn, lane)
        else:
            loop.call_soon(loop.call_soon, self._take_turn, lane)

    def _take_turn(self, lane: _Lane) -> None:
        """Serve a line of each client, round and round, until the turn's time is up."""
        lane.is_scheduled = False
        if not lane.is_urgent and (delay := self._delay(lane)) > 0:
            self._schedule(lane, delay)
            return
        began_at, end = self._processor_time(), time.perf_counter() + MAX_TURN
        reading_time = 0.0
        lane.deferred_since = None
        try:
            while lane.waiting:
                connection = lane.waiting.popleft()
                self._serve(connection)
                reading_time += connection.reading_time
                connection.reading_time = 0.0
                if connection.has_lines:
                    self.add(connection)
                connection.close_if_finished()
                if time.perf_counter() >= end:
                    break
        finally:  # whatever fails: others wait, perhaps with a stop
            lane.budget.spend(self._processor_time() - began_at + reading_time)
            self._schedule(lane)

    def _delay(self, lane: _Lane) -> float:
        """Return the time [s] by which the turn that is due has to wait, 0 for none."""
        if self._is_busy():
            now = self._clock()
            if lane.deferred_since is None:
                lane.deferred_since = now
            if now - lane.deferred_since < MAX_DEFERRAL:
                return _RECHECK
        return lane.budget.pause()
