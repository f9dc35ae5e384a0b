"""Backend for an amplifier on a serial line: a tty, a USB adapter or a serial server.

Replies are matched by sequence number. Several amplifiers may share a line, each at its own
address.
"""

import asyncio
from dataclasses import dataclass, replace

from drivers import clock, trace
from drivers.backends.serial_line.line import SerialLine, serial_line
from drivers.backends.waiting import DUPLICATE_WAIT, ReplyTimer
from drivers.backends.wire_backend import WireBackend
from drivers.codec.serial_line.exchanges import decode_event, decode_reply, encode_request, is_event
from drivers.codec.serial_line.frame import Frame, encode_frame
from drivers.codec.serial_line.timing import SerialTimes
from drivers.errors import DriverError, LinkError, LinkTimeout
from drivers.hardware import number_below
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Broadcast, Hello, Reply, Request, Stop
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters
from drivers.trace import Direction
from drivers.urls.serial_line import SerialUrl


@dataclass
class _Pending:
    """A request on the wire and its future reply."""

    request: Frame
    reply: asyncio.Future[Reply]


class SerialBackend(WireBackend):
    """Carries requests over a serial line given by its URL (see `SerialUrl`)."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = SerialUrl.parse(url)
        self._times = SerialTimes(self._url.baud)
        self._line: SerialLine | None = None
        self._pending: _Pending | None = None
        self._timer = ReplyTimer()
        # A random start, so that a reply to an earlier run does not match.
        self._sequence = number_below(1 << 16)
        self._last_reply: Frame | None = None  # the reply to the last request, if received
        self._has_duplicate_responder = False  # a second, different reply

    @property
    def counters(self) -> WireCounters:
        """Frame counters of this amplifier; invalid frames are those of the whole line."""
        invalid_frames = (
            self._counters.invalid_frames if self._line is None else self._line.invalid_frames
        )
        return replace(self._counters, invalid_frames=invalid_frames)

    @property
    def bus(self) -> str:
        """The port: a broadcast reaches all amplifiers on it."""
        return self._url.port

    @property
    def wire_times(self) -> WireTimes:
        """Durations on the line; unknown behind a server."""
        return self._times if self._url.is_local else WireTimes()

    async def open(self) -> None:
        """Open the port, exclusively if the system can; raises LinkError."""
        if self._line is not None:
            return
        line = serial_line(self._url.port, baud=self._url.baud)
        self._counters = WireCounters()
        self._loss = None
        await line.join(self._url.address, self._lost)
        line.listen(self._url.address, self._received)
        self._line = line

    async def close(self) -> None:
        """Close the port if unused by others; pending requests raise LinkError."""
        line, self._line = self._line, None
        if line is None:
            return
        self._counters.invalid_frames = line.invalid_frames
        self._fail(LinkError(f"{self._url.port} was closed"))
        line.listen(self._url.address, None)
        await line.leave(self._url.address)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for its reply; LinkTimeout, LinkError or FrameError.

        timeout [s]: of the whole exchange, extended on slow lines.
        """
        line = self._require(self._line, self._url.port, request)
        if not isinstance(request, Stop):
            line.raise_if_lost(self._url.address)
        frame = self._frame(request, self._url.address)
        data = encode_frame(frame)
        self._last_reply, self._has_duplicate_responder = None, False
        self._send(line, data, request)
        unexpected = self._counters.unexpected_frames
        pending = self._pending = _Pending(frame, asyncio.get_running_loop().create_future())
        on_line = self._times.exchange(len(data))
        try:
            extended = max(timeout, on_line + PROTOCOL.reaction)
            reply = await self._timer.wait(pending.reply, extended)
        except LinkError:
            raise
        except TimeoutError:
            remedy = f"check that the amplifier is switched on and set to {self._url.baud} baud"
            if line.is_blocked:
                remedy = "check flow control and the adapter: the port takes no bytes"
            elif self._counters.unexpected_frames > unexpected:
                remedy = (
                    f"other frames came, none with its sequence number {frame.sequence}: the "
                    "replies are late, or do not repeat it"
                )
            raise LinkTimeout(
                f"no reply from address {self._url.address} on {self._url.port} within "
                f"{timeout * 1e3:g} ms; {remedy}"
            ) from None
        finally:
            if self._pending is pending:
                self._pending = None
        if isinstance(request, Hello):
            await self._check_alone()
        return reply

    async def broadcast(self, request: Broadcast) -> None:
        """Send a commit or a stop to every amplifier of the line."""
        line = self._require(self._line, self._url.port, request)
        data = encode_frame(self._frame(request, PROTOCOL.serial.broadcast))
        self._send(line, data, request)

    async def _check_alone(self) -> None:
        """Wait for a second amplifier of this address; LinkError if one replies."""
        await asyncio.sleep(DUPLICATE_WAIT)
        if self._has_duplicate_responder:
            raise LinkError(
                f"several amplifiers reply at address {self._url.address} on {self._url.port}; "
                "give each its own: era amp address --serial-number"
            )

    def _send(self, line: SerialLine, data: bytes, request: Request) -> None:
        line.send(data)
        self._last_sent_at = clock.now()
        self._counters.frames_out += 1
        if trace.is_active():
            trace.frame(Direction.OUT, data, self._url.port, lambda: repr(request))

    def _frame(self, request: Request, address: int) -> Frame:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return encode_request(request, address=address, sequence=self._sequence)

    def _received(self, frame: Frame) -> None:
        if trace.is_active():
            request = self._pending.request if self._pending is not None else None
            data = encode_frame(frame)
            trace.frame(Direction.IN, data, self._url.port, lambda: _meaning(frame, request))
        self._counters.frames_in += 1
        if frame.address == self._url.address and is_event(frame):
            self._notify(frame)
            return
        first = self._last_reply
        if first is not None and (frame.sequence, frame.address) == (first.sequence, first.address):
            self._has_duplicate_responder = self._has_duplicate_responder or frame != first
        pending = self._pending
        if (
            pending is None
            or pending.request.sequence != frame.sequence
            or pending.reply.done()
            or not frame.is_reply
            or frame.address != self._url.address
        ):
            self._counters.unexpected_frames += 1
            return
        self._last_reply = frame
        try:
            pending.reply.set_result(decode_reply(frame, pending.request))
        except DriverError as error:
            pending.reply.set_exception(error)

    def _notify(self, frame: Frame) -> None:
        try:
            event = decode_event(frame)
        except DriverError:
            self._counters.invalid_frames += 1
            return
        self._counters.events += 1
        self._on_event(event)

    def _lost(self, cause: str) -> None:
        self._loss = cause
        was_waiting = self._pending is not None
        self._fail(LinkError(cause))
        if not was_waiting:
            self._on_loss(cause)

    def _fail(self, error: LinkError) -> None:
        if self._pending is not None and not self._pending.reply.done():
            self._pending.reply.set_exception(error)


def _meaning(frame: Frame, request: Frame | None) -> str:
    """Describe a received frame; request: the pending one, if any."""
    if is_event(frame):
        return repr(decode_event(frame))
    if request is None or request.sequence != frame.sequence:
        return f"unexpected: {frame}"
    return repr(decode_reply(frame, request))
