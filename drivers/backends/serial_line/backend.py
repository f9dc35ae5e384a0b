"""Backend for an amplifier on a serial line: a tty, a USB adapter or a serial server.

Replies are matched by sequence number. Several amplifiers may share a line, each at its own
address.
"""

import asyncio
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

from drivers.backends.hardware import number_below
from drivers.backends.line_turns import priority_on_line
from drivers.backends.serial_line.line import SerialLine, serial_line
from drivers.backends.urls.serial_line import SerialUrl
from drivers.backends.waiting import SETTLE, reply_within
from drivers.backends.wire_backend import WireBackend
from drivers.codec.serial_line.exchanges import decode_event, decode_reply, encode_request, is_event
from drivers.codec.serial_line.frame import Frame, encode_frame
from drivers.codec.serial_line.timing import SerialTimes
from drivers.errors import DriverError, LinkError, LinkTimeout
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Broadcast, Hello, Reply, Request, Stop
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters


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
        self._pending: dict[int, _Pending] = {}
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

    @property
    def takes_turns(self) -> bool:
        """The line is half duplex."""
        return True

    @property
    def is_unsent(self) -> bool:
        """Whether the request waits for others on the line."""
        return self._line is not None and self._line.turns.is_unsent(self._url.address)

    def silencing(self, request: Request) -> AbstractContextManager[None]:
        """See `Backend.silencing`."""
        if self._line is None:
            return nullcontext()
        return self._line.turns.silencing(request, self._url.address)

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
        line = self._opened()
        # Also on a line of its own: an amplifier that joins must wait for a pending reply.
        return await line.turns.carry_out(
            priority_on_line(request),
            lambda: self._exchange(line, request, timeout),
            address=self._url.address,
        )

    async def broadcast(self, request: Broadcast) -> None:
        """Send a commit to every amplifier of the line by its priority, or a stop at once.

        A stop is repeated by its priority if it may have collided with a reply on the line.
        """
        line = self._opened()
        is_stop, was_in_use = isinstance(request, Stop), line.turns.is_in_use
        data = encode_frame(self._frame(request, PROTOCOL.serial.broadcast))

        async def send() -> None:
            self._send(line, data)

        if is_stop:
            await send()
        if was_in_use or not is_stop:
            address = None if is_stop else self._url.address
            await line.turns.carry_out(priority_on_line(request), send, address=address)

    async def _check_alone(self) -> None:
        """Wait for a second amplifier of this address; LinkError if one replies."""
        await asyncio.sleep(SETTLE)
        if self._has_duplicate_responder:
            raise LinkError(
                f"several amplifiers reply at address {self._url.address} on {self._url.port}; "
                "give each its own address"
            )

    async def _exchange(self, line: SerialLine, request: Request, timeout: float) -> Reply:
        frame = self._frame(request, self._url.address)
        data = encode_frame(frame)
        pending = _Pending(frame, asyncio.get_running_loop().create_future())
        self._pending[frame.sequence] = pending
        self._last_reply, self._has_duplicate_responder = None, False
        try:
            line.raise_if_lost(self._url.address)
            self._send(line, data)
            line.turns.mark_sent()
            on_line = self._times.exchange(len(data))
            reply = await reply_within(pending.reply, max(timeout, on_line + PROTOCOL.reaction))
        except LinkError:
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no reply from address {self._url.address} on {self._url.port} within "
                f"{timeout * 1e3:g} ms; check that the amplifier is switched on and set to "
                f"{self._url.baud} baud"
            ) from None
        finally:
            del self._pending[frame.sequence]
            pending.reply.cancel()  # also if it has an exception
        if isinstance(request, Hello):
            await self._check_alone()
        return reply

    def _send(self, line: SerialLine, data: bytes) -> None:
        line.send(data)
        self._last_sent = line.last_sent
        self._counters.frames_out += 1

    def _frame(self, request: Request, address: int) -> Frame:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return encode_request(request, address=address, sequence=self._sequence)

    def _opened(self) -> SerialLine:
        return self._require(self._line, self._url.port)

    def _received(self, frame: Frame) -> None:
        self._counters.frames_in += 1
        if frame.address == self._url.address and is_event(frame):
            self._notify(frame)
            return
        first = self._last_reply
        if first is not None and (frame.sequence, frame.address) == (first.sequence, first.address):
            self._has_duplicate_responder = self._has_duplicate_responder or frame != first
        pending = self._pending.get(frame.sequence)
        if (
            pending is None
            or pending.reply.done()
            or not frame.is_reply
            or frame.address != self._url.address
        ):
            self._counters.unexpected_frames += 1
            return
        self._last_reply = frame
        try:
            pending.reply.set_result(decode_reply(frame, pending.request))
        except DriverError as problem:
            pending.reply.set_exception(problem)

    def _notify(self, frame: Frame) -> None:
        try:
            event = decode_event(frame)
        except DriverError:
            self._counters.invalid_frames += 1
            return
        self._counters.events += 1
        self._on_event(event)

    def _lost(self, what: str) -> None:
        self._loss = what
        was_waiting = bool(self._pending)
        self._fail(LinkError(what))
        if not was_waiting:
            self._on_loss(what)

    def _fail(self, problem: LinkError) -> None:
        for pending in self._pending.values():
            if not pending.reply.done():
                pending.reply.set_exception(problem)
