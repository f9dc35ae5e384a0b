"""A Modbus line shared by all amplifiers on it, one request at a time.

Over RTU the line is silent for 3.5 characters before a request. The next request also waits for the
response to a cancelled one, which would collide with it.
"""

import asyncio
import contextlib
from collections.abc import Callable

from drivers import clock, trace
from drivers.backends.modbus.stream import open_stream
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.backends.waiting import ReplyTimer
from drivers.codec.modbus.adu import (
    ModbusResponse,
    Read,
    RequestAdu,
    ResponseReader,
    Write,
    build_adu,
)
from drivers.codec.modbus.timing import ModbusTimes
from drivers.errors import LinkError, LinkTimeout
from drivers.hardware import Port
from drivers.protocol.definition import PROTOCOL
from drivers.statistics import WireCounters
from drivers.trace import Direction
from drivers.urls.modbus import ModbusUrl

_REACTION = PROTOCOL.reaction
_BROADCAST: int = PROTOCOL.modbus["broadcast"]
_TRANSACTIONS = 1 << 16
_RTU_OVERHEAD = 3  # bytes of a response around its PDU


class ModbusLine(SharedLine[Port]):
    """A line, numbered by units; see `modbus_line`."""

    address_term = "unit"

    def __init__(self, url: ModbusUrl) -> None:
        super().__init__(url.endpoint)
        self.url = url
        self.counters = WireCounters()
        self._last_sent_at = 0.0
        self._is_in_use = False
        self._reader = ResponseReader(is_rtu=url.is_rtu, counters=self.counters)
        self.has_duplicate_responder = False  # the last response was followed by a different one
        self._last_response: ModbusResponse | None = None
        self._transaction = 0
        self._request: RequestAdu | None = None
        self._accept: Callable[[ModbusResponse], bool] = _any
        self._response: asyncio.Future[ModbusResponse] | None = None
        self._timer = ReplyTimer()
        # Time at which a serial line is free, at the latest if a response is pending.
        self._free_from = 0.0
        self._is_response_pending = False
        self._response_received = asyncio.Event()
        self._times = ModbusTimes(url.baud, url.bits_per_byte) if url.baud else None
        self._gap = self._times.silence if self._times and url.device else 0.0

    async def _open(self) -> Port:
        self.counters = WireCounters()
        self._reader = ResponseReader(is_rtu=self.url.is_rtu, counters=self.counters)
        self._request = self._last_response = None
        self._is_response_pending, self._free_from = False, 0.0
        return await open_stream(self.url, self._received, self._lose)

    async def transact(
        self,
        read: Read | None,
        write: Write | None,
        *,
        unit: int,
        timeout: float,
        accept: Callable[[ModbusResponse], bool],
        on_sent: Callable[[float], None] = lambda time: None,
        is_stop: bool = False,
    ) -> ModbusResponse:
        """Write, read, or both in one transaction, and wait for the response.

        timeout [s]: of the whole transaction, extended on slow lines; accept: whether a well-formed
        response matches; on_sent: called with the time when the request was sent; is_stop: send it
        for an amplifier not reopened since a loss, too. Raises LinkTimeout, LinkError.
        """
        self._is_in_use = True
        try:
            await self._await_silence()
            if not is_stop:
                self.raise_if_lost(unit)
            request = self._make(read, write, unit=unit)
            self._request, self._accept = request, accept
            on_line = self._time_of(len(request.frame) + _RTU_OVERHEAD + request.response_size)
            on_line += 2 * self._gap  # before the response, and at the end of the request
            self._send(request)
            on_sent(self._last_sent_at)
            self._response = asyncio.get_running_loop().create_future()
            self._is_response_pending = True
            self._free_from = self._last_sent_at + on_line + _REACTION
            return await self._timer.wait(self._response, max(timeout, on_line + _REACTION))
        except LinkError:
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no response from unit {unit} on {self.name} within {timeout * 1e3:g} ms; "
                "check that the amplifier is switched on and has this unit"
                + (f" and {self.url.baud} baud" if self.url.device else "")
            ) from None
        finally:
            self._response = None
            self._is_in_use = False

    async def broadcast(self, write: Write, on_sent: Callable[[float], None]) -> None:
        """Write to all units; there are no responses. Over RTU it ends when the line is free again.

        Raises LinkError during another request over RTU, with which it would collide.
        """
        if not self.url.is_rtu:
            self._send(self._make(None, write, unit=_BROADCAST))
            on_sent(self._last_sent_at)
            return
        if self._is_in_use:
            raise LinkError(f"{self.name} is in use; broadcast after the transaction")
        self._is_in_use = True
        try:
            await self._await_silence()
            request = self._make(None, write, unit=_BROADCAST)
            self._request = None
            self._send(request)
            on_sent(self._last_sent_at)
            self._free_from = self._last_sent_at + self._time_of(len(request.frame)) + self._gap
            await self._await_silence()
        finally:
            self._is_in_use = False

    async def send_raw(self, data: bytes) -> None:
        """Send bytes as they are, after the silence of a serial line."""
        await self._await_silence()
        self._ready().write(data)
        self._last_sent_at = clock.now()
        self._free_from = self._last_sent_at + self._time_of(len(data)) + self._gap

    def _make(self, read: Read | None, write: Write | None, *, unit: int) -> RequestAdu:
        self._transaction = (self._transaction + 1) % _TRANSACTIONS
        number = 0 if self.url.is_rtu else self._transaction
        return build_adu(read, write, unit=unit, transaction=number, is_rtu=self.url.is_rtu)

    def _send(self, request: RequestAdu) -> None:
        stream = self._ready()
        if self.url.is_rtu:
            self._reader.clear()
        self._is_response_pending = False
        self._last_response, self.has_duplicate_responder = None, False
        self._response_received.clear()
        stream.write(request.frame)
        self._last_sent_at = clock.now()
        self.counters.frames_out += 1
        trace.frame(Direction.OUT, request.frame, self.name, lambda: _meaning(request))

    async def _await_silence(self) -> None:
        """Wait until a serial line is free."""
        if not self.url.is_rtu:
            return
        if self._is_response_pending and (wait := self._free_from - clock.now()) > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._response_received.wait()
        if (wait := self._free_from - clock.now()) > 0:
            await asyncio.sleep(wait)

    def _time_of(self, size: int) -> float:
        """Time [s] of a number of bytes on a serial line, also behind a gateway."""
        return self._times.of(size) if self._times else 0.0

    def _received(self, data: bytes) -> None:
        if self.tap is not None:
            self.tap(data)
        replies = self._reader.feed(data, self._request)
        trace.frame(Direction.IN, data, self.name, lambda: ", ".join(map(repr, replies)))
        for response in replies:
            if not self._accept(response):
                self.counters.unexpected_frames += 1
                continue
            self._is_response_pending = False
            self._response_received.set()
            if self._response is None or self._response.done():
                self.counters.unexpected_frames += 1
                self.has_duplicate_responder = (
                    self.has_duplicate_responder or response != self._last_response
                )
            else:
                self._last_response = response
                self._response.set_result(response)
        if not self._is_response_pending:
            self._free_from = clock.now() + self._gap

    def _fail_pending(self, cause: str) -> None:
        if self._response is not None and not self._response.done():
            self._response.set_exception(LinkError(cause))


def modbus_line(url: ModbusUrl) -> ModbusLine:
    """Return the line of a URL in the running event loop."""
    return shared_line(ModbusLine, url.line, lambda: ModbusLine(url.line))


def _meaning(request: RequestAdu) -> str:
    return f"unit {request.unit}, function {request.function}: {request.read}, {request.write}"


def _any(response: ModbusResponse) -> bool:
    return True
