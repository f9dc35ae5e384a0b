"""HTTP and WebSocket connections as uvicorn serves them, with the bounds that it does not have.

Whoever connects may be silent, slow, or not read what it is sent; none of it may keep others out or
fill the memory. All times count from what was whole the last time, so that a trickle wins nothing.
"""

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from controller.api.rate_limit import RateLimiter

MOST_WAITING = 128  # connections that have not sent a whole request yet
REQUEST_PATIENCE = 5.0  # s; a connection without a whole request by then is closed
UNREAD_PATIENCE = 5.0  # s; for whoever asks over HTTP and does not read the answer
MOST_UNREAD = 1 << 18  # bytes for one WebSocket; answers are bounded before, pongs are not
MOST_FRAGMENTS = 64  # of one message; a browser sends a message of 64 KiB in one or two
CONTROLS_PER_SECOND = 100.0  # pings and pongs of one WebSocket; it needs one in ten seconds
_SLICE = 1 << 12  # bytes that are looked at before it is asked again whether to go on
PARTING = 1.0  # s; for the last words to a WebSocket that is left


class HttpConnection(H11Protocol):
    """HTTP for connections that come to ask something.

    Whoever has not sent a whole request holds a place for five seconds at most, or until 128
    others have come after; so two thousand silent connections do not keep a browser out.
    """

    _waiting: dict["HttpConnection", asyncio.TimerHandle] = {}  # noqa: RUF012 (of all connections)
    _unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Let it in, if need be in place of the one that has waited longest."""
        super().connection_made(transport)
        self._wait()

    def handle_events(self) -> None:
        """Note that it has asked, once a request is whole."""
        try:
            super().handle_events()
        except h11.LocalProtocolError:  # garbage in a body that was answered already
            self.transport.abort()
            return
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is not None and not cycle.more_body and not cycle.response_complete:
            self._heard()

    def on_response_complete(self) -> None:
        """Wait for the next request as for the first."""
        self._wait()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """A WebSocket takes the connection over."""
        self._heard()
        super().handle_websocket_upgrade(event)

    def pause_writing(self) -> None:
        """It does not read: not for long."""
        super().pause_writing()
        self._unread = self.loop.call_later(UNREAD_PATIENCE, self.transport.abort)

    def resume_writing(self) -> None:
        """It reads again."""
        super().resume_writing()
        self._has_read()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free its place."""
        self._heard()
        self._has_read()
        super().connection_lost(exc)

    def _wait(self) -> None:
        """Begin to wait for a whole request."""
        if self.transport.is_closing():
            return
        self._heard()
        while len(self._waiting) >= MOST_WAITING:
            oldest = next(iter(self._waiting))
            oldest._heard()
            oldest.transport.abort()
        self._waiting[self] = self.loop.call_later(REQUEST_PATIENCE, self.transport.abort)

    def _heard(self) -> None:
        timer = self._waiting.pop(self, None)
        if timer is not None:
            timer.cancel()

    def _has_read(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None


class WebSocketConnection(WebSocketsSansIOProtocol):
    """A WebSocket whose every buffer has an end, and which ends when the gateway leaves it."""

    _controls: RateLimiter | None = None

    def data_received(self, data: bytes) -> None:
        """Take what was sent, unless what it was sent before lies unread."""
        for at in range(0, len(data), _SLICE):
            if self.transport.get_write_buffer_size() > MOST_UNREAD:
                self.transport.abort()
            if self.transport.is_closing():
                return
            super().data_received(data[at : at + _SLICE])

    def handle_ping(self) -> None:
        """Answer a ping, but not a flood of them."""
        if self._may_go_on():
            super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Take a pong; many come from nobody who was asked."""
        if self._may_go_on():
            super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """A further fragment of a message; empty ones have no size that could be bounded."""
        if len(self.frames) >= MOST_FRAGMENTS:
            self.transport.abort()
            return
        super().handle_cont(event)

    def send_receive_event_to_app(self) -> None:
        """Hand on a whole message; one that is no UTF-8 ends it, without a word in the log."""
        if self.curr_msg_data_type == "text" and not _is_utf8(b"".join(self.frames)):
            self.conn.send_close(CloseCode.INVALID_DATA)
            self.handle_parser_exception()
            return
        super().send_receive_event_to_app()

    def keepalive_timeout(self) -> None:
        """It does not answer: it need not be waited for."""
        super().keepalive_timeout()
        self.transport.abort()

    def _may_go_on(self) -> bool:
        """Whether it keeps within the rate of control frames; otherwise it is left."""
        if self._controls is None:
            self._controls = RateLimiter(CONTROLS_PER_SECOND, clock=self.loop.time)
        is_fine = self._controls.take()
        if not is_fine:
            self.transport.abort()
        return is_fine

    async def run_asgi(self) -> None:
        """Serve it; then it ends, whether it reads the last words or not."""
        await super().run_asgi()
        self.loop.call_later(PARTING, self.transport.abort)


def _is_utf8(said: bytes) -> bool:
    try:
        said.decode()
    except UnicodeDecodeError:
        return False
    return True
