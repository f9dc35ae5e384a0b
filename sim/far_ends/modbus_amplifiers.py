"""The amplifiers' side of Modbus, without I/O: bytes in, bytes out.

ADUs are RTU with CRC, or TCP with MBAP header; a long pause ends a frame. Each message is a
mailbox: written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words). Not modeled: parity and collisions on a serial line.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial

from drivers.protocol.definition import BROADCAST, NAK, Message
from drivers.urls import RTU_BAUD
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    IDENTITY_REGISTER,
    PRESENT,
    READS,
    REPLY_OFFSET,
    WRITE,
    Adu,
    AduReader,
    Pdu,
    exception_to,
    framed,
    message_shown,
    message_written,
    pack_identity,
    parse_request,
    response_pdu,
)
from sim.transport.far_end import AmplifierPort, FarEnd, SendBytes, carry_out
from sim.transport.serving import FarEndKind, MakeEnd, Numbered

FRAME_TIMEOUT = 0.02
"""Longest pause [s] within an RTU frame: less than the 30 ms after which a host repeats it."""
TCP_TIMEOUT = 1.0
"""Longest pause [s] within a TCP frame, whose segments may be delayed."""
_MARGIN = 0.001  # s; behind the end of a pause, which must be exceeded
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3


class ModbusAmplifiers(FarEnd):
    """Amplifiers by unit on one line or port; send: called with the bytes for the host."""

    def __init__(
        self,
        amplifiers: Mapping[int, AmplifierPort],
        send: SendBytes,
        *,
        is_rtu: bool,
    ) -> None:
        self._units = {unit: _Unit(amplifier) for unit, amplifier in amplifiers.items()}
        self._send = send
        self._is_rtu = is_rtu
        self._reader = AduReader(is_rtu=is_rtu, of_requests=True, waits=True)
        self._timeout = FRAME_TIMEOUT if is_rtu else TCP_TIMEOUT
        self._last = 0.0

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self.tick(now)
        self._last = now
        self._take(self._reader.feed(data), now)

    def of_connection(self, send: SendBytes) -> "ModbusAmplifiers":
        """Return the same units for another connection; send: see above."""
        connection = ModbusAmplifiers({}, send, is_rtu=self._is_rtu)
        connection._units = self._units
        return connection

    @property
    def next_event(self) -> float:
        """Time [s] when silence ends an incomplete frame; infinite without one."""
        return self._last + self._timeout + _MARGIN if self._reader.rest else math.inf

    def tick(self, now: float) -> None:
        """Process the silence of the line until a time [s], which ends an incomplete frame."""
        if self._reader.rest and now - self._last > self._timeout:
            self._take(self._reader.end(), now)

    def _take(self, requests: Sequence[Adu], now: float) -> None:
        for request in requests:
            is_for_all = self._is_rtu and request.unit == BROADCAST
            if not request.pdu or (is_for_all and request.pdu[0] != WRITE):
                continue
            for number, unit in [*self._units.items()]:
                if unit.amplifier.is_answering and (is_for_all or number == request.unit):
                    pdu = unit.reply(request, now, is_for_all=is_for_all)
                    if not is_for_all:
                        self._send(framed(number, pdu, request.transaction, is_rtu=self._is_rtu))
                    if unit.is_moving:
                        unit.is_moving = False
                        self._units[unit.address] = self._units.pop(number)


@dataclass(frozen=True, slots=True)
class _Reply:
    """The reply to a message: tag of the request, result (0: done), words."""

    tag: int
    result: int
    words: Sequence[int]

    @property
    def area(self) -> tuple[int, ...]:
        """The registers of the reply area, with zeros behind the reply."""
        registers = (self.tag, self.result, *self.words)
        return registers + (0,) * (AREA - len(registers))


_NO_REPLY = _Reply(0, 0, ())


class _Unit:
    """The registers of an amplifier.

    address: set by SetAddress; is_moving: its reply has been read, so that the unit moves there.
    """

    def __init__(self, amplifier: AmplifierPort) -> None:
        self.address = 0
        self.is_moving = False
        self.amplifier = amplifier
        self._replies: dict[int, _Reply] = {}  # by number of the message

    def reply(self, adu: Adu, now: float, *, is_for_all: bool) -> bytes:
        """Return the PDU of the response to a request, an exception where Modbus defines one.

        is_for_all: whether it is a write to all units, which does not change the reply area.
        """
        function = adu.pdu[0]
        request = parse_request(adu)
        if request is None:
            is_known = function in (*READS, WRITE)
            return exception_to(function, _ILLEGAL_VALUE if is_known else _ILLEGAL_FUNCTION)
        if function in READS:
            registers = self._read(request, now)
            if not registers:
                return exception_to(function, _ILLEGAL_ADDRESS)
            return response_pdu(request, registers)
        message = message_written(request)
        if message is None:
            return exception_to(function, _ILLEGAL_ADDRESS)
        tag, *words = request.registers
        if message.name in PRESENT and not words:
            reply = _Reply(tag, 0, ())  # reads carry it out
        else:
            reply = self._execute(tag, message, words, now, is_for_all=is_for_all)
        if is_for_all:
            self.is_moving = message.name == "SetAddress" and reply.result == 0
        else:
            self._replies[message.number] = reply
        return response_pdu(request)

    def _execute(
        self, tag: int, message: Message, words: Sequence[int], now: float, *, is_for_all: bool
    ) -> _Reply:
        """Carry out a message, and return its reply."""
        kind, reply = carry_out(self.amplifier, message.number, words, now, is_for_all=is_for_all)
        if kind == NAK:
            _, code, channel = reply or (0, 0, 0)
            return _Reply(tag, code << 8 | channel, ())
        if message.name == "SetAddress":
            self.address = words[0]
        return _Reply(tag, 0, reply)

    def _read(self, request: Pdu, now: float) -> Sequence[int]:
        """Return the registers that a request reads; none if any register cannot be read."""
        message = message_shown(request)
        if message is None:
            first = IDENTITY_REGISTER
            area = tuple(pack_identity(self.amplifier.identity))
        else:
            first = message.number * BOX + REPLY_OFFSET
            area = self._present_reply(message, now).area
        begin = request.address - first
        end = begin + request.count
        is_within = 0 <= begin <= end <= len(area)
        return area[begin:end] if is_within else ()

    def _present_reply(self, message: Message, now: float) -> _Reply:
        """Return the reply that a read of a message shows now."""
        reply = self._replies.get(message.number, _NO_REPLY)
        if message.name in PRESENT:
            if not reply.result:
                return self._execute(reply.tag, message, (), now, is_for_all=False)
            self._replies[message.number] = _Reply(reply.tag, 0, ())  # a rejection is read once
        elif message.name == "SetAddress":
            self.is_moving = self.address > 0 and reply.result == 0
        return reply


class SharedUnits(FarEndKind):
    """A kind of wire whose units are shared by all connections."""

    def serve(self, speed: int | None, numbered: Numbered) -> AbstractContextManager[MakeEnd]:
        """Serve amplifiers by unit; yields how to make the far end of a connection."""
        units = ModbusAmplifiers(numbered, lambda data: None, is_rtu=False)
        return nullcontext(units.of_connection)


MODBUS_TCP_KIND = SharedUnits(
    "modbus-tcp",
    "modbus+tcp://{host}:{port}/{address}",
    "a loopback port with a unit per amplifier; any free port if PORT is omitted",
    RTU_BAUD,
    "ethernet",
    ModbusAmplifiers,
)
MODBUS_RTU_KIND = FarEndKind(
    "modbus-rtu",
    "modbus+rtu://{port}?baud={speed}#{address}",
    "a pseudo-terminal with a unit per amplifier",
    RTU_BAUD,
    "usb-high-speed",
    partial(ModbusAmplifiers, is_rtu=True),
    bits=11,
)
