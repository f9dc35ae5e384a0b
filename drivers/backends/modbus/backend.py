"""Backend for an amplifier on Modbus TCP or RTU.

A request is one transaction, FC23: a block is written and one read back. An amplifier that refuses
FC23 gets FC16 and FC4 from then on. The reason of a refused write is read afterwards. Every write
carries a tag that is read back, so that a late response is never credited to another request;
identity and capabilities are constant and read without a tag.

Modbus has no unsolicited messages: events are changes of state or fault between responses.
"""

import asyncio
from collections.abc import Awaitable, Callable

from drivers.backends.modbus.line import ModbusLine, modbus_line
from drivers.backends.waiting import DUPLICATE_WAIT
from drivers.backends.wire_backend import WireBackend
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import ModbusResponse
from drivers.codec.modbus.blocks import unpack_fault_count
from drivers.codec.modbus.exchanges import Exchange, Read, Write
from drivers.codec.modbus.timing import ModbusTimes
from drivers.errors import LinkError, LinkTimeout
from drivers.hardware import number_below
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Broadcast,
    Capabilities,
    Fault,
    FaultList,
    Hello,
    Nak,
    NakCode,
    Reply,
    Request,
    Stop,
)
from drivers.protocol.wire_times import WireTimes
from drivers.urls.modbus import ModbusUrl

_ILLEGAL_FUNCTION = 1
_GATEWAY = (10, 11)  # gateway: no path to the amplifier, or no response from it
_TAGS = (1 << 16) - 1


_Transact = Callable[[Read | None, Write | None, int | None], Awaitable[ModbusResponse]]
"""Write, read, or both, with the tag that the registers read must carry."""


class ModbusBackend(WireBackend):
    """Carries requests over a Modbus line given by its URL (see `ModbusUrl`)."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = ModbusUrl.parse(url)
        self._line: ModbusLine | None = None
        # A random start, so that a response to an earlier run does not match.
        self._tag = number_below(_TAGS)
        self._can_read_back = True
        self._channels = exchanges.CHANNELS_MAX
        self._last_state: tuple[AmplifierState, Fault] | None = None
        self._is_exchanging = False

    @property
    def bus(self) -> str:
        """The line: a broadcast reaches all its units."""
        return f"modbus {self._url.endpoint}"

    @property
    def wire_times(self) -> WireTimes:
        """Durations on a serial line, also behind a gateway; unknown on a network."""
        if not self._url.baud:
            return WireTimes()
        return ModbusTimes(self._url.baud, self._url.bits_per_byte)

    async def open(self) -> None:
        """Open the line, or join it if open in this process; raises LinkError."""
        if self._line is not None:
            return
        self._last_state = None
        self._loss = None
        line = modbus_line(self._url)
        await line.join(self._url.unit, self._lost)
        self._line = line
        self._counters = line.counters

    async def close(self) -> None:
        """Leave the line, which the last one closes."""
        line, self._line = self._line, None
        if line is not None:
            await line.leave(self._url.unit)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for its reply; LinkTimeout, LinkError or FrameError.

        timeout [s]: of each transaction, extended on slow lines (see `ModbusLine`).
        """
        self._is_exchanging = True
        try:
            reply, registers = await self._request(request, timeout)
            if isinstance(reply, Capabilities):
                self._channels = reply.channels
            elif isinstance(reply, FaultList):
                count = unpack_fault_count(registers)
                if count > len(reply.faults):
                    reply, _ = await self._request(request, timeout, records=count)
        finally:
            self._is_exchanging = False
        return reply

    async def broadcast(self, request: Broadcast) -> None:
        """Write a commit or a stop to all units of the line."""
        line = self._require(self._line, self._url.endpoint, request)
        await line.broadcast(exchanges.encode_broadcast(request), self._sent)

    async def _check_alone(self, line: ModbusLine) -> None:
        """Wait for a second amplifier of this unit; LinkError if one responds."""
        await asyncio.sleep(DUPLICATE_WAIT)
        if line.has_duplicate_responder:
            raise LinkError(
                f"several amplifiers respond as unit {self._url.unit} on {self._url.endpoint}; "
                "give each its own: era amp address --serial-number"
            )

    def _next_tag(self) -> int:
        self._tag = self._tag % _TAGS + 1
        return self._tag

    async def _request(
        self, request: Request, timeout: float, *, records: int = exchanges.RECORDS_FIRST
    ) -> tuple[Reply, tuple[int, ...]]:
        """Return the reply to a request, and its registers; records: number of faults to read."""
        tag = self._next_tag()
        exchange = exchanges.encode_request(
            request, tag=tag, channels=self._channels, records=records
        )

        async def transact(
            read: Read | None, write: Write | None, tag: int | None
        ) -> ModbusResponse:
            return await self._transact(read, write, tag, request=request, timeout=timeout)

        response = await self._carry_out(exchange, tag, transact)
        if response.exception:
            return await self._refusal(response, tag, transact), ()
        self._report_change(request, response)
        if isinstance(request, Hello) and self._url.is_rtu:
            await self._check_alone(self._require(self._line, self._url.endpoint, request))
        return exchanges.decode_reply(request, response.registers), response.registers

    async def _carry_out(self, exchange: Exchange, tag: int, transact: _Transact) -> ModbusResponse:
        read, write = exchange.read, exchange.write
        if write is None:
            return await transact(read, None, None)
        if self._can_read_back:
            response = await transact(read, write, tag)
            if response.exception != _ILLEGAL_FUNCTION:
                return response
            self._can_read_back = False
        response = await transact(None, write, None)
        return response if response.exception else await transact(read, None, tag)

    async def _transact(
        self,
        read: Read | None,
        write: Write | None,
        tag: int | None,
        *,
        request: Request,
        timeout: float,
    ) -> ModbusResponse:
        def accept(response: ModbusResponse) -> bool:
            if response.exception or read is None:
                return True
            return exchanges.is_of(response.registers, tag=tag)

        response = await self._require(self._line, self._url.endpoint, request).transact(
            read,
            write,
            unit=self._url.unit,
            timeout=timeout,
            accept=accept,
            on_sent=self._sent,
            is_stop=isinstance(request, Stop),
        )
        if response.exception in _GATEWAY:
            raise LinkTimeout(
                f"gateway {self._url.endpoint}: no response from unit {self._url.unit}; "
                "check that the amplifier is switched on and has this unit"
            )
        return response

    async def _refusal(self, response: ModbusResponse, tag: int, transact: _Transact) -> Nak:
        """Read the reason of a refused write, unless the exception is unambiguous."""
        if response.exception == _ILLEGAL_FUNCTION:
            return Nak(NakCode.UNKNOWN_TYPE)
        only = exchanges.nak_of_exception(response.exception)
        if only is not None and only.code is NakCode.BUSY:
            return only
        refusal = await transact(exchanges.refusal_read(), None, None)
        nak = None if refusal.exception else exchanges.decode_refusal(refusal.registers, tag=tag)
        if nak is not None:
            return nak
        # A late exception to an earlier write, so the response to this one is missing.
        raise LinkTimeout(
            f"unit {self._url.unit} on {self._url.endpoint}: Modbus exception {response.exception} "
            "without a reason for this request"
        )

    def _report_change(self, request: Request, response: ModbusResponse) -> None:
        """Report a change of state or fault as an event."""
        state = exchanges.reported_state(request, response.registers)
        if state is None or state == self._last_state:
            return
        before, self._last_state = self._last_state, state
        if before is not None:
            self._on_event(AmplifierEvent(*state))

    def _sent(self, time: float) -> None:
        self._last_sent_at = time

    def _lost(self, cause: str) -> None:
        self._loss = cause
        if not self._is_exchanging:
            self._on_loss(cause)
