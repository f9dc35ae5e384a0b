"""One client's connection to the API server: bytes in, lines out, bounds on both.

Nothing here waits. The server takes lines one at a time from all connections in turn, so that a
flood on one costs the others nothing; output that a client does not read is bounded, then dropped.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import cast

from controller.api.jsonrpc import MAX_LINE_LENGTH, ErrorCode, RpcError, error_line
from controller.api.rate_limit import RateLimiter
from controller.api.superseded import is_superseded

MAX_UNREAD_BYTES = 1 << 18  # written but not read by the client
_MAX_UNREAD_NOTIFICATIONS = MAX_UNREAD_BYTES // 2  # bytes; the rest is reserved for responses
_MAX_READ_AHEAD = 1 << 16  # bytes of lines that wait to be served
UNREAD_TIMEOUT = 5.0  # s; for losing notifications before the connection is closed

MAX_REQUEST_RATE = 2000.0  # 1/s, and as many in a burst


class Connection(asyncio.Protocol):
    """A client's connection.

    on_connect: returns False to refuse it; on_lines: lines wait to be served; on_disconnect: called
    once at the end.
    """

    def __init__(
        self,
        *,
        on_connect: "Callable[[Connection], bool]",
        on_lines: "Callable[[Connection], None]",
        on_disconnect: "Callable[[Connection], None]",
        clock: Callable[[], float],
    ) -> None:
        self.name = "unnamed client"
        self.received_at = clock()  # s; when the last bytes arrived
        self.pending: set[asyncio.Task[None]] = set()
        self._on_connect = on_connect
        self._on_lines = on_lines
        self._on_disconnect = on_disconnect
        self._clock = clock
        self._transport: asyncio.Transport | None = None
        self._lines: deque[bytes] = deque()
        self._waiting_bytes = 0  # in _lines
        self._rest = b""
        self._is_at_end = False
        self._lost = 0
        self._losing_since: float | None = None
        self._rate = RateLimiter(MAX_REQUEST_RATE, clock=clock)

    @property
    def is_open(self) -> bool:
        """Whether it can still be written to."""
        return self._transport is not None and not self._transport.is_closing()

    @property
    def has_lines(self) -> bool:
        """Whether lines wait to be served."""
        return bool(self._lines) and self.is_open

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start, or refuse a client too many."""
        self._transport = cast(asyncio.Transport, transport)
        # Output is bounded here, by the size of the write buffer.
        self._transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        if not self._on_connect(self):
            self.refuse(RpcError(ErrorCode.BUSY, "too many connections", remedy="try again later"))

    def data_received(self, data: bytes) -> None:
        """Split into lines; pause reading while many wait to be served."""
        self.received_at = self._clock()
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._lines.extend(lines)
        self._waiting_bytes += sum(map(len, lines))
        line_length = max(map(len, (*lines, self._rest)))
        if line_length >= MAX_LINE_LENGTH:
            self.refuse(RpcError(ErrorCode.PARSE, f"line longer than {MAX_LINE_LENGTH} bytes"))
            return
        if self._waiting_bytes > _MAX_READ_AHEAD and self._transport is not None:
            self._transport.pause_reading()
        if lines:
            self._on_lines(self)

    def eof_received(self) -> bool:
        """Finish what the client requested before it closed its side, then close."""
        self._is_at_end = True
        self.close_if_finished()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Report the end; pending requests are carried out all the same."""
        self._transport = None
        self._lines.clear()
        self._on_disconnect(self)

    @property
    def is_next_superseded(self) -> bool:
        """Whether the line after the next one makes serving the next one unnecessary."""
        return len(self._lines) > 1 and is_superseded(self._lines[0], self._lines[1])

    def next_line(self) -> bytes:
        """Take the next line; only while `has_lines`."""
        line = self._lines.popleft()
        self._waiting_bytes -= len(line)
        if not self._lines and self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()
        return line

    def close_if_finished(self) -> None:
        """Close after the last response, if the client has closed its side."""
        if self._is_at_end and not self._lines and not self.pending:
            self.close()

    def take_request(self) -> bool:
        """Whether another request is within the rate; counts it."""
        return self._rate.take()

    def respond(self, line: bytes) -> None:
        """Send a response, or close the connection of a client that does not read."""
        if self._transport is None or self._transport.is_closing():
            return
        unread = self._transport.get_write_buffer_size()
        if unread and unread + len(line) > MAX_UNREAD_BYTES:
            self._transport.abort()
            return
        self._transport.write(line)

    def notify(self, make_line: Callable[[int], bytes]) -> None:
        """Send a notification, made with the number of those dropped before it, or drop it too."""
        if self._transport is None or self._transport.is_closing():
            return
        if self._transport.get_write_buffer_size() < _MAX_UNREAD_NOTIFICATIONS:
            self._transport.write(make_line(self._lost))
            self._lost, self._losing_since = 0, None
            return
        self._lost += 1
        now = self._clock()
        if self._losing_since is None:
            self._losing_since = now
        elif now - self._losing_since > UNREAD_TIMEOUT:
            self._transport.abort()

    def refuse(self, error: RpcError) -> None:
        """Send an error and close."""
        self._lines.clear()
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
