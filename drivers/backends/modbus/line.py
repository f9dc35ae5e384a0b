"""One Modbus line, for all amplifiers of this process that are on it: a telegram at a time.

Over RTU the line is silent for 3.5 characters before a telegram. Where nobody waits any more for an
answer it is given the time to come all the same, or it would run into the next telegram.
"""

import asyncio
import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager

from drivers import clock
from drivers.backends.hardware import Port
from drivers.backends.line_turns import LineTurns
from drivers.backends.modbus.stream import open_stream
from drivers.backends.shared_line import SharedLine, shared_line
from drivers.backends.urls.modbus import ModbusUrl
from drivers.backends.waiting import reply_within
from drivers.codec.modbus.adu import ModbusResponse, RequestAdu, ResponseReader, build_adu
from drivers.codec.modbus.exchanges import Read, Write
from drivers.codec.modbus.timing import ModbusTimes
from drivers.errors import LinkError, LinkTimeout
from drivers.link.turns import RequestPriority
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Request
from drivers.statistics import WireCounters

_REACTION = PROTOCOL.reaction
_BROADCAST: int = PROTOCOL.modbus["broadcast"]
_TRANSACTIONS = 1 << 16
_RTU_OVERHEAD = 3  # bytes of an answer around its PDU


class ModbusLine(SharedLine[Port]):
    """A line, whose units are its numbers; see `modbus_line`."""

    number = "unit"

    def __init__(self, url: ModbusUrl) -> None:
        super().__init__(url.place)
        self.url = url
        self.counters = WireCounters()
        self.last_sent = 0.0
        self._turns = LineTurns()
        self._reader = ResponseReader(is_rtu=url.is_rtu, counters=self.counters)
        self.is_contradicted = False  # whether the last answer was followed by another
        self._given: ModbusResponse | None = None
        self._transaction = 0
        self._telegram: RequestAdu | None = None
        self._accept: Callable[[ModbusResponse], bool] = _any
        self._answer: asyncio.Future[ModbusResponse] | None = None
        # Of a serial line: when it is free again, at the latest where an answer is owed.
        self._free_from = 0.0
        self._is_owed = False
        self._came = asyncio.Event()
        self._times = ModbusTimes(url.baud, url.bits_per_byte) if url.baud else None
        self._gap = self._times.silence if self._times and url.device else 0.0

    async def _open(self) -> Port:
        self.counters = WireCounters()
        self._reader = ResponseReader(is_rtu=self.url.is_rtu, counters=self.counters)
        self._telegram = self._given = None
        self._is_owed, self._free_from = False, 0.0
        return await open_stream(self.url, self._received, self._lose)

    async def transact(
        self,
        read: Read | None,
        write: Write | None,
        *,
        unit: int,
        kind: RequestPriority = RequestPriority.ORDINARY,
        timeout: float,
        accept: Callable[[ModbusResponse], bool],
    ) -> ModbusResponse:
        """Write, read, or both in one transaction, and wait for the answer.

        kind: how this stands to what others ask on the line (see `kind_on_line`); accept: whether
        an answer in the right form is the right one. timeout [s]: for all of it; longer where a
        slow line and an amplifier that reacts in time need longer. Raises LinkTimeout, LinkError.
        """

        async def exchange() -> ModbusResponse:
            await self._await_silence()
            self.raise_if_lost(unit)
            telegram = self._make(read, write, unit=unit)
            self._telegram, self._accept = telegram, accept
            self._answer = asyncio.get_running_loop().create_future()
            on_line = self._time_of(len(telegram.frame) + _RTU_OVERHEAD + telegram.answer_size)
            on_line += 2 * self._gap  # before the answer, and for the far end to see its end
            try:
                self._send(telegram.frame)
                self._is_owed = True
                self._free_from = self.last_sent + on_line + _REACTION
                return await reply_within(self._answer, max(timeout, on_line + _REACTION))
            except LinkError:
                raise
            except TimeoutError:
                raise LinkTimeout(
                    f"no answer from unit {unit} on {self.place} within {timeout * 1e3:g} ms; "
                    "check that the amplifier is switched on and has this unit"
                    + (f" and {self.url.baud} baud" if self.url.device else "")
                ) from None
            finally:
                self._answer = None

        return await self._turns.carry_out(kind, exchange, address=unit)

    async def broadcast(self, write: Write, kind: RequestPriority, *, unit: int | None) -> None:
        """Write to all units, in the turn of this kind and unit; nobody answers.

        unit: whose stop this gives way to, and which may be one that others ask meanwhile; or None.
        """

        async def send() -> None:
            await self._await_silence()
            self._telegram = None
            telegram = self._make(None, write, unit=_BROADCAST)
            self._send(telegram.frame)
            self._free_from = self.last_sent + self._time_of(len(telegram.frame)) + self._gap

        await self._turns.carry_out(kind, send, address=unit)

    def is_unsent(self, unit: int) -> bool:
        """Whether what is asked of a unit waits for others, or for the line to be silent."""
        return self._turns.is_unsent(unit)

    def silencing(self, request: Request, unit: int) -> AbstractContextManager[None]:
        """See `Backend.silencing`."""
        return self._turns.silencing(request, unit)

    def _make(self, read: Read | None, write: Write | None, *, unit: int) -> RequestAdu:
        self._transaction = (self._transaction + 1) % _TRANSACTIONS
        number = 0 if self.url.is_rtu else self._transaction
        return build_adu(read, write, unit=unit, transaction=number, is_rtu=self.url.is_rtu)

    def _send(self, frame: bytes) -> None:
        stream = self._ready()
        if self.url.is_rtu:
            self._reader.clear()
        self._is_owed = False
        self._given, self.is_contradicted = None, False
        self._came.clear()
        stream.write(frame)
        self._turns.sent()
        self.last_sent = clock.now()
        self.counters.frames_out += 1

    async def _await_silence(self) -> None:
        """Wait until a serial line is free."""
        if not self.url.is_rtu:
            return
        if self._is_owed and (wait := self._free_from - clock.now()) > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._came.wait()
        if (wait := self._free_from - clock.now()) > 0:
            await asyncio.sleep(wait)

    def _time_of(self, size: int) -> float:
        """Time [s] that so many bytes take on a serial line, be it behind a gateway."""
        return self._times.of(size) if self._times else 0.0

    def _received(self, data: bytes) -> None:
        for answer in self._reader.feed(data, self._telegram):
            if not self._accept(answer):
                self.counters.unexpected_frames += 1
                continue
            self._is_owed = False
            self._came.set()
            if self._answer is None or self._answer.done():
                self.counters.unexpected_frames += 1
                self.is_contradicted = self.is_contradicted or answer != self._given
            else:
                self._given = answer
                self._answer.set_result(answer)
        if not self._is_owed:
            self._free_from = clock.now() + self._gap

    def _give_up(self, what: str) -> None:
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(LinkError(what))


def modbus_line(url: ModbusUrl) -> ModbusLine:
    """The line of a URL in the running event loop."""
    return shared_line(ModbusLine, url.line, lambda: ModbusLine(url.line))


def _any(answer: ModbusResponse) -> bool:
    return True
