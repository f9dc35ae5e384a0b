"""HTTP and WebSocket connections of uvicorn, with the bounds that uvicorn lacks.

Silent, slow or non-reading clients cannot exhaust connections or memory.
Timeouts count from the last complete request, so sending byte by byte gains nothing.
"""

import asyncio
import re
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from controller.gateway.bridge import KeptLink
from controller.process.rate_limit import RateLimiter

MAX_IDLE = 128  # connections that have not sent a complete request
REQUEST_TIMEOUT = 5.0  # s; for a complete request
UNREAD_TIMEOUT = 5.0  # s; for reading a response over HTTP
MAX_UNREAD = 1 << 18  # bytes per WebSocket; bounds pongs; other frames wait until it reads
MAX_HEAD = 1 << 16  # bytes; of a request over HTTP
MAX_FRAGMENTS = 64  # per message; a browser sends 64 KiB in one or two
MAX_CONTROL_RATE = 100.0  # 1/s; pings and pongs of one WebSocket; one in ten seconds is needed
CLOSE_TIMEOUT = 1.0  # s; for a WebSocket to close after its last frame
_SLICE = 1 << 12  # bytes that are processed between checks of the bounds
_BLANK_LINE = re.compile(rb"\n\r?\n")
_BARE_OR_FOLDED = re.compile(rb"(?<!\r)\n|\n[ \t]")


class _UnambiguousHttp(h11.Connection):
    """HTTP whose heads of requests no proxy may take for others."""

    _searched = 0  # bytes without the end of a head

    def next_event(self) -> Any:
        """The next event; raises RemoteProtocolError, which is answered by 400."""
        if self.their_state is h11.IDLE:
            received = self.trailing_data[0]
            end = _BLANK_LINE.search(received, max(0, self._searched - 3))
            self._searched = len(received) if end is None else 0
            if end is not None and _is_ambiguous(received[: end.start() + 1].lower()):
                raise h11.RemoteProtocolError("ambiguous head")
        return super().next_event()


class HttpConnection(H11Protocol):
    """HTTP with timeouts, and a bound on connections without a complete request.

    The oldest idle connection is closed for a new one, so thousands of silent connections do not
    keep a browser out.
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.conn = _UnambiguousHttp(h11.SERVER, MAX_HEAD)
        self._unread: asyncio.TimerHandle | None = None
        # Of all connections of the server, whose state is one dictionary.
        self._idle: dict[HttpConnection, asyncio.TimerHandle] = self.app_state.setdefault(
            "idle", {}
        )
        self._daemon = KeptLink(self.app_state.setdefault("links", set()))
        self.app_state = {**self.app_state, "daemon": self._daemon}  # for requests

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept it as idle."""
        super().connection_made(transport)
        self._start_idle()

    def handle_events(self) -> None:
        """Stop the idle timer at a complete request."""
        try:
            super().handle_events()
        except h11.LocalProtocolError:  # invalid data in the body of a request already answered
            self.transport.abort()
            return
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is not None and not cycle.more_body and not cycle.response_complete:
            self._end_idle()

    def on_response_complete(self) -> None:
        """Restart the idle timer."""
        self._start_idle()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand over to a WebSocket."""
        self._end_idle()
        self._daemon.close()
        super().handle_websocket_upgrade(event)

    def pause_writing(self) -> None:
        """Start the timeout of a client that does not read."""
        super().pause_writing()
        self._unread = self.loop.call_later(UNREAD_TIMEOUT, self.transport.abort)

    def resume_writing(self) -> None:
        """Cancel the timeout of a client that does not read."""
        super().resume_writing()
        self._cancel_unread()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel all timeouts, and close the connection to the daemon."""
        self._end_idle()
        self._daemon.close()
        self._cancel_unread()
        super().connection_lost(exc)

    def _start_idle(self) -> None:
        if self.transport.is_closing():
            return
        self._end_idle()
        while len(self._idle) >= MAX_IDLE:
            oldest = next(iter(self._idle))
            oldest._end_idle()
            oldest.transport.abort()
        self._idle[self] = self.loop.call_later(REQUEST_TIMEOUT, self.transport.abort)

    def _end_idle(self) -> None:
        timer = self._idle.pop(self, None)
        if timer is not None:
            timer.cancel()

    def _cancel_unread(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None


class WebSocketConnection(WebSocketsSansIOProtocol):
    """A WebSocket with bounded buffers, fragments and control frames."""

    _controls: RateLimiter | None = None

    def data_received(self, data: bytes) -> None:
        """Process data unless too much output is unread."""
        for start in range(0, len(data), _SLICE):
            if self.transport.get_write_buffer_size() > MAX_UNREAD:
                self.transport.abort()
            if self.transport.is_closing():
                return
            super().data_received(data[start : start + _SLICE])

    def handle_ping(self) -> None:
        """Answer a ping within the rate of control frames."""
        if self._take_control():
            super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Accept a pong within the rate of control frames."""
        if self._take_control():
            super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """Accept a fragment, of a bounded number: the size of empty ones is no bound."""
        if len(self.frames) >= MAX_FRAGMENTS:
            self.transport.abort()
            return
        super().handle_cont(event)

    def keepalive_timeout(self) -> None:
        """Close without waiting for a client that does not answer pings."""
        super().keepalive_timeout()
        self.transport.abort()

    async def run_asgi(self) -> None:
        """Run the application, then close, whether or not the client reads its last frames."""
        await super().run_asgi()
        self.loop.call_later(CLOSE_TIMEOUT, self.transport.abort)

    def _take_control(self) -> bool:
        """Count a control frame; close if there are too many."""
        if self._controls is None:
            self._controls = RateLimiter(MAX_CONTROL_RATE, clock=self.loop.time)
        is_within = self._controls.take()
        if not is_within:
            self.transport.abort()
        return is_within


def _is_ambiguous(head: bytes) -> bool:
    """Whether a proxy may read the head of a request, in lower case, otherwise.

    Lines that end with a line feed alone, folded lines, two ways to give the length of the body.
    """
    lengths = [name for name in (b"\ncontent-length:", b"\ntransfer-encoding:") if name in head]
    return len(lengths) > 1 or _BARE_OR_FOLDED.search(head) is not None
