"""The amplifiers' side of Modbus, without I/O: bytes in, bytes out.

ADUs are RTU with CRC, or TCP with MBAP header; a long pause ends a frame. Each message is a
mailbox: written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words). Not modelled: parity and collisions on a serial line.
"""

import math
from collections.abc import Mapping, Sequence

from drivers.protocol.definition import BROADCAST, NAK, Message
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
        other = ModbusAmplifiers({}, send, is_rtu=self._is_rtu)
        other._units = self._units
        return other

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
                    if unit.is_moving:  # to the address that it has taken
                        unit.is_moving = False
                        self._units[unit.address] = self._units.pop(number)


class _Unit:
    """The registers of an amplifier.

    address: taken by SetAddress, once is_moving: after its reply was read.
    """

    def __init__(self, amplifier: AmplifierPort) -> None:
        self.address = 0
        self.is_moving = False
        self.amplifier = amplifier
        self._replies: dict[int, tuple[int, int, Sequence[int]]] = {}  # tag, result, words

    def reply(self, adu: Adu, now: float, *, is_for_all: bool) -> bytes:
        """Return the PDU of the response to a request, an exception where Modbus defines one.

        is_for_all: whether it is a write that is for all units; the reply area stays as it is.
        """
        function, request = adu.pdu[0], parse_request(adu)
        if request is None:
            is_known = function in (*READS, WRITE)
            return exception_to(function, _ILLEGAL_VALUE if is_known else _ILLEGAL_FUNCTION)
        if function in READS:
            shown = self._read(request, now)
            return (
                response_pdu(request, shown) if shown else exception_to(function, _ILLEGAL_ADDRESS)
            )
        message = message_written(request)
        if message is None:
            return exception_to(function, _ILLEGAL_ADDRESS)
        tag, *words = request.registers
        is_made_by_reads = message.name in PRESENT and not words
        done = (
            (0, ())
            if is_made_by_reads
            else self._execute(message, words, now, is_for_all=is_for_all)
        )
        if is_for_all:
            self.is_moving = message.name == "SetAddress" and done[0] == 0
        else:
            self._replies[message.number] = tag, *done
        return response_pdu(request)

    def _execute(
        self, message: Message, words: Sequence[int], now: float, is_for_all: bool
    ) -> tuple[int, Sequence[int]]:
        """Return the result and the words of the reply to a message."""
        kind, reply = carry_out(self.amplifier, message.number, words, now, is_for_all=is_for_all)
        if kind == NAK:
            _, code, channel = reply or (0, 0, 0)
            return code << 8 | channel, ()
        if message.name == "SetAddress":
            self.address = words[0]
        return 0, reply

    def _read(self, request: Pdu, now: float) -> Sequence[int]:
        """Return the registers that a request reads; none if any register cannot be read."""
        address, count = request.address, request.count
        if (message := message_shown(request)) is not None:
            first = message.number * BOX + REPLY_OFFSET
            tag, result, words = self._replies.get(message.number, (0, 0, ()))
            if message.name in PRESENT:
                if result:  # a rejection is read once
                    self._replies[message.number] = tag, 0, ()
                else:
                    result, words = self._execute(message, (), now, is_for_all=False)
            elif message.name == "SetAddress":
                self.is_moving = self.address > 0 and result == 0
            row = (tag, result, *words)
            area = row + (0,) * (AREA - len(row))  # zeros behind a reply
        else:
            first, area = IDENTITY_REGISTER, tuple(pack_identity(self.amplifier.identity))
        is_within = first <= address <= address + count <= first + len(area)
        return area[address - first :][:count] if is_within else ()
