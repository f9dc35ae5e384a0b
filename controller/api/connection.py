"""One client of the API: bytes in, lines out, and bounds on both.

Nothing here waits. Lines are taken one at a time by whoever serves all connections in turn, so that
a flood on one costs the others nothing; what a client does not read is bounded, and then lost.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import cast

from controller.api.jsonrpc import MAX_LINE_LENGTH, ErrorCode, RpcError, error_line
from controller.api.rate_limit import RateLimiter
from controller.api.superseded import is_superseded

MAX_UNREAD_BYTES = 1 << 18  # bytes that a client has not read
_NOTIFICATION_LIMIT = MAX_UNREAD_BYTES // 2  # the rest is for answers
_INCOMING_LIMIT = 1 << 16  # bytes that are read ahead of what was served
UNREAD_TIMEOUT = 5.0  # s; how long a client may lose notifications before it loses the connection

MAX_REQUEST_RATE = 2000.0  # 1/s, and as many at once


class Connection(asyncio.Protocol):
    """A client; on_lines is called when there is something to serve, on_end once in the end."""

    def __init__(
        self,
        *,
        on_begin: "Callable[[Connection], bool]",
        on_lines: "Callable[[Connection], None]",
        on_end: "Callable[[Connection], None]",
        clock: Callable[[], float],
    ) -> None:
        self.name = "somebody"
        self.heard_at = clock()  # s; when the last bytes came
        self.pending: set[asyncio.Task[None]] = set()
        self._on_begin = on_begin
        self._on_lines = on_lines
        self._on_end = on_end
        self._clock = clock
        self._transport: asyncio.Transport | None = None
        self._lines: deque[bytes] = deque()
        self._ahead = 0
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
        """Whether there is something to serve."""
        return bool(self._lines) and self.is_open

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, unless there are too many already."""
        self._transport = cast(asyncio.Transport, transport)
        # Write buffers are bounded here, by what is in them.
        self._transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        if not self._on_begin(self):
            self.refuse(RpcError(ErrorCode.BUSY, "too many connections", remedy="try again later"))

    def data_received(self, data: bytes) -> None:
        """Take lines apart; more is only read once these were served."""
        self.heard_at = self._clock()
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._lines.extend(lines)
        self._ahead += sum(map(len, lines))
        too_long = max(map(len, lines), default=0) >= MAX_LINE_LENGTH
        if too_long or len(self._rest) >= MAX_LINE_LENGTH:
            self.refuse(RpcError(ErrorCode.PARSE, f"a line is longer than {MAX_LINE_LENGTH} bytes"))
            return
        if self._ahead > _INCOMING_LIMIT and self._transport is not None:
            self._transport.pause_reading()
        if lines:
            self._on_lines(self)

    def eof_received(self) -> bool:
        """Answer what was asked before the client said its last, then close."""
        self._is_at_end = True
        self.settle()
        return True

    def connection_lost(self, error: Exception | None) -> None:
        """Tell that it is over; what is still being done for it goes on."""
        self._transport = None
        self._lines.clear()
        self._on_end(self)

    @property
    def next_is_superseded(self) -> bool:
        """Whether the next line, of those there are, needs no serving, for the one after it."""
        return len(self._lines) > 1 and is_superseded(self._lines[0], self._lines[1])

    def next_line(self) -> bytes:
        """The next line to serve, of those there are."""
        line = self._lines.popleft()
        self._ahead -= len(line)
        if not self._lines and self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()
        return line

    def settle(self) -> None:
        """Close after the last answer, where the client has said its last."""
        if self._is_at_end and not self._lines and not self.pending and self._transport:
            self._transport.close()

    def may_ask(self) -> bool:
        """Whether another request is within the rate; counts it."""
        return self._rate.take()

    def answer(self, line: bytes) -> None:
        """Send an answer; a client that has not read for long is left instead."""
        if self._transport is None or self._transport.is_closing():
            return
        waiting = self._waiting(self._transport)
        if waiting and waiting + len(line) > MAX_UNREAD_BYTES:
            self._transport.abort()
            return
        self._transport.write(line)

    def notify(self, make: Callable[[int], bytes]) -> None:
        """Send a notification, made from how many were lost before it, or lose it, too."""
        if self._transport is None or self._transport.is_closing():
            return
        if self._waiting(self._transport) < _NOTIFICATION_LIMIT:
            self._transport.write(make(self._lost))
            self._lost, self._losing_since = 0, None
            return
        self._lost += 1
        now = self._clock()
        if self._losing_since is None:
            self._losing_since = now
        elif now - self._losing_since > UNREAD_TIMEOUT:
            self._transport.abort()

    def refuse(self, error: RpcError) -> None:
        """Say why, and close."""
        self._lines.clear()
        self.answer(error_line(None, error))
        self.close()

    def close(self) -> None:
        """Close once all answers are out."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    @staticmethod
    def _waiting(transport: asyncio.Transport) -> int:
        return transport.get_write_buffer_size()
