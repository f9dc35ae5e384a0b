"""One client's connection to the API server: bytes in, lines out, bounds on both.

Nothing here waits. The server takes lines one at a time from all connections in turn, so that a
flood on one costs the others nothing; output that a client does not read is bounded, then dropped.
"""

import asyncio
import math
import select
import time
from collections.abc import Callable
from typing import Any, cast

from controller.api.jsonrpc import MAX_LINE_LENGTH, ErrorCode, InvalidRequest, RpcError, error_line
from controller.api.schema import Topic
from controller.process.rate_limit import RateLimiter

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

    process: its id, 0 if unknown; on_connect: called at the beginning; on_lines: lines wait to be
    served; on_disconnect: called once at the end. ahead: a request that was read from the next
    line, but not served.
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
        self.ahead: Any = None
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
