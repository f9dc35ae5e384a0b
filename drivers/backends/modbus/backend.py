"""An amplifier that speaks Modbus, over TCP or RTU.

A request is one transaction, FC23: a block is written and one read back. An amplifier that cannot
do that is found out by the first one and gets FC16 and FC4 in turn from then on. Why a write was
refused is read afterwards. Every write carries a tag that is read back, so that no late answer is
taken for another; identity and capabilities do not change and are read without one.

An amplifier cannot speak unasked here: events are what its answers show to have changed.
"""

import asyncio
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

from drivers.backends.hardware import number_below
from drivers.backends.line_turns import kind_on_line
from drivers.backends.modbus.line import ModbusLine, modbus_line
from drivers.backends.sole_host import SoleHost
from drivers.backends.urls.modbus import ModbusUrl
from drivers.backends.waiting import SETTLE
from drivers.backends.wire_backend import WireBackend
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import ModbusResponse
from drivers.codec.modbus.blocks import unpack_fault_count
from drivers.codec.modbus.exchanges import Exchange, Read, Write
from drivers.codec.modbus.timing import ModbusTimes
from drivers.errors import LinkError, LinkTimeout
from drivers.link.turns import RequestPriority
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Arm,
    Broadcast,
    Capabilities,
    Fault,
    FaultList,
    Hello,
    Nak,
    NakCode,
    Reply,
    Request,
)
from drivers.protocol.wire_times import NoTimes, WireTimes

_ILLEGAL_FUNCTION = 1
_GATEWAY = (10, 11)  # a gateway has no path to the amplifier, or heard nothing from it
_TAGS = (1 << 16) - 1


@dataclass(frozen=True)
class _Asked:
    """How a request stands to others on the line, and how long each transaction may take [s]."""

    kind: RequestPriority
    timeout: float


class ModbusBackend(WireBackend):
    """Carries requests over a Modbus line given by its URL (see `ModbusUrl`)."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = ModbusUrl.parse(url)
        self._line: ModbusLine | None = None
        self._sole_host = SoleHost(f"{self._url.place}/{self._url.unit}")
        # Not from zero, so that an answer to an earlier run is no answer to this one.
        self._tag = number_below(_TAGS)
        self._can_read_back = True
        self._channels = exchanges.CHANNELS_MAX
        self._condition: tuple[AmplifierState, Fault] | None = None
        self._loss: str | None = None  # until it is opened anew, even if others have the line back
        self._is_asking = False

    @property
    def bus(self) -> str:
        """The line, whose units a broadcast reaches."""
        return f"modbus {self._url.place}"

    @property
    def wire_times(self) -> WireTimes:
        """Of a serial line, be it behind a gateway; none of a network."""
        if not self._url.baud:
            return NoTimes()
        return ModbusTimes(self._url.baud, self._url.bits_per_byte)

    @property
    def takes_turns(self) -> bool:
        """One answer at a time is on the line."""
        return True

    @property
    def is_unsent(self) -> bool:
        """Whether what is asked waits for others, or for the line to be silent."""
        return self._line is not None and self._line.is_unsent(self._url.unit)

    def silencing(self, request: Request) -> AbstractContextManager[None]:
        """See `Backend.silencing`."""
        if self._line is None:
            return nullcontext()
        return self._line.silencing(request, self._url.unit)

    async def open(self) -> None:
        """Open the line, or join those who have it open in this process; raises LinkError."""
        if self._line is not None:
            return
        self._condition = None
        self._loss = None
        line = modbus_line(self._url)
        await line.join(self._url.unit, self._lost)
        self._line = line
        self._counters = line.counters

    async def close(self) -> None:
        """Leave the line; the last one closes it."""
        line, self._line = self._line, None
        try:
            if line is not None:
                await line.leave(self._url.unit)
        finally:  # also where this is cancelled
            self._sole_host.release()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for its reply; LinkTimeout, LinkError or FrameError.

        timeout [s]: for each transaction; longer where a slow line needs it (see `ModbusLine`), so
        that a loss is told after three heartbeats on a line that is fast enough for them.
        """
        if isinstance(request, Arm) and not self._url.device:
            self._sole_host.claim()
        asked = _Asked(kind_on_line(request), timeout)
        self._is_asking = True
        try:
            reply, registers = await self._ask(request, asked)
            if isinstance(reply, Capabilities):
                self._channels = reply.channels
            elif isinstance(reply, FaultList):
                count = unpack_fault_count(registers)
                if count > len(reply.faults):
                    reply, _ = await self._ask(request, asked, records=count)
        finally:
            self._is_asking = False
        return reply

    async def broadcast(self, request: Broadcast) -> None:
        """Write a commit or a stop to all units of the line; a stop goes before all that wait."""
        line = self._opened()
        kind = kind_on_line(request)
        unit = None if kind.silences else self._url.unit
        await line.broadcast(exchanges.encode_broadcast(request), kind, unit=unit)
        self._last_sent = line.last_sent

    async def _check_alone(self) -> None:
        """Leave a second amplifier of this unit the time to answer; LinkError where one does."""
        line = self._opened()
        await asyncio.sleep(SETTLE)
        if line.is_contradicted:
            raise LinkError(
                f"more than one amplifier answers as unit {self._url.unit} on {self._url.place}; "
                "give each on the line a unit of its own"
            )

    def _next_tag(self) -> int:
        self._tag = self._tag % _TAGS + 1
        return self._tag

    async def _ask(
        self, request: Request, asked: "_Asked", *, records: int = exchanges.RECORDS_FIRST
    ) -> tuple[Reply, tuple[int, ...]]:
        """The reply to a request and the registers that it stands in; records: how many faults."""
        tag = self._next_tag()
        exchange = exchanges.encode_request(
            request, tag=tag, channels=self._channels, records=records
        )
        answer = await self._carry_out(exchange, tag, asked)
        if answer.exception:
            return await self._refusal(answer, tag, asked), ()
        self._look_at(request, answer)
        if isinstance(request, Hello) and self._url.is_rtu:
            await self._check_alone()
        return exchanges.decode_reply(request, answer.registers), answer.registers

    async def _carry_out(self, exchange: Exchange, tag: int, asked: "_Asked") -> ModbusResponse:
        read, write = exchange.read, exchange.write
        if write is None:
            return await self._transact(read, None, asked, tag=None)
        if self._can_read_back:
            answer = await self._transact(read, write, asked, tag=tag)
            if answer.exception != _ILLEGAL_FUNCTION:
                return answer
            self._can_read_back = False
        answer = await self._transact(None, write, asked, tag=None)
        return answer if answer.exception else await self._transact(read, None, asked, tag=tag)

    async def _transact(
        self, read: Read | None, write: Write | None, asked: "_Asked", *, tag: int | None
    ) -> ModbusResponse:
        def accept(answer: ModbusResponse) -> bool:
            if answer.exception or read is None:
                return True
            return exchanges.is_of(answer.registers, tag=tag)

        line = self._opened()
        try:
            answer = await line.transact(
                read,
                write,
                unit=self._url.unit,
                kind=asked.kind,
                timeout=asked.timeout,
                accept=accept,
            )
        finally:
            self._last_sent = line.last_sent
        if answer.exception in _GATEWAY:
            raise LinkTimeout(
                f"the gateway at {self._url.place} gets no answer from unit {self._url.unit}; "
                "check that the amplifier is switched on and has this unit"
            )
        return answer

    async def _refusal(self, answer: ModbusResponse, tag: int, asked: "_Asked") -> Nak:
        """Why a write was refused; exceptions that only one refusal leads to need no asking."""
        if answer.exception == _ILLEGAL_FUNCTION:
            return Nak(NakCode.UNKNOWN_TYPE)
        only = exchanges.nak_of_exception(answer.exception)
        if only is not None and only.code is NakCode.BUSY:
            return only
        told = await self._transact(exchanges.refusal_read(), None, asked, tag=None)
        nak = None if told.exception else exchanges.decode_refusal(told.registers, tag=tag)
        if nak is not None:
            return nak
        # Not of this write: a late exception to an earlier one, so this one's answer was missed.
        raise LinkTimeout(
            f"unit {self._url.unit} on {self._url.place} answered with Modbus exception "
            f"{answer.exception} and names no reason for it"
        )

    def _look_at(self, request: Request, answer: ModbusResponse) -> None:
        """Tell who listens what an answer shows to have changed."""
        condition = exchanges.condition(request, answer.registers)
        if condition is None or condition == self._condition:
            return
        before, self._condition = self._condition, condition
        if before is not None:
            self._on_event(AmplifierEvent(*condition))

    def _opened(self) -> ModbusLine:
        if self._line is None or self._loss is not None:
            raise LinkError(
                self._loss or f"{self._url.place} is not open; open the amplifier first"
            )
        return self._line

    def _lost(self, what: str) -> None:
        self._loss = what
        if not self._is_asking:
            self._on_loss(what)
