"""The amplifiers' side of Modbus, without I/O: bytes in, bytes out.

ADUs are RTU with CRC, or TCP with MBAP header; a long pause ends a frame. Each message is a
mailbox: written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words). Not modelled: parity and collisions on a serial line.
"""

import math
import struct
from collections.abc import Mapping, Sequence

from drivers.protocol.records import Refusal
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, Message, nak_of, read_request
from drivers.wires.modbus.frames import (
    EXCEPTION,
    READS,
    RTU_MAX,
    WRITE,
    Adu,
    checked,
    framed,
    request_size,
    split_tcp,
)
from drivers.wires.modbus.registers import (
    AREA,
    BOX,
    IDENTITY,
    PRESENT,
    REPLY,
    pack_identity,
)
from sim.transport.far_end import AmplifierPort, FarEnd, Send

FRAME_TIMEOUT = 0.02
"""Longest pause [s] within an RTU frame: less than the 30 ms after which a host repeats it."""
TCP_TIMEOUT = 1.0
"""Longest pause [s] within a TCP frame, whose segments may be delayed."""


class RequestReader:
    """Splits a stream of bytes into requests; timeout [s]: the longest pause within one."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.timeout = FRAME_TIMEOUT if is_rtu else TCP_TIMEOUT
        self._is_rtu = is_rtu
        self._buffer = b""
        self._last = 0.0

    @property
    def gives_up_at(self) -> float:
        """Time after which `pause` discards a partial frame [s]; infinite without one."""
        return self._last + self.timeout if self._buffer else math.inf

    def feed(self, data: bytes, now: float) -> list[Adu]:
        """The requests that these bytes complete, in order."""
        before = self.pause(now)
        self._last = now
        split = _split_rtu if self._is_rtu else split_tcp
        found, self._buffer = split(self._buffer + data)
        return before + [each for each in found if each.pdu]

    def pause(self, now: float) -> list[Adu]:
        """Discard a partial frame after a timeout; requests that it ends are returned."""
        if not self._buffer or now - self._last <= self.timeout:
            return []
        ended, self._buffer = self._buffer, b""
        return _split_rtu(ended, is_ended=True)[0] if self._is_rtu else []


def _split_rtu(data: bytes, *, is_ended: bool = False) -> tuple[list[Adu], bytes]:
    """Split bytes by functions, which determine lengths, and CRCs; returns what is left, too.

    Behind a damaged frame the next valid one is searched at every byte; a frame of an unknown
    function ends with the pause after it.
    """
    whole = checked(data) if is_ended else None
    if whole is not None:
        return [whole], b""
    found: list[Adu] = []
    while is_ended or 0 < request_size(data) <= len(data) or len(data) > RTU_MAX:
        request, data = _first_request(data)
        if request is None:
            break
        found.append(request)
    return found, data


def _first_request(data: bytes) -> tuple[Adu | None, bytes]:
    """Take the first valid request, with what is before it; returns what is left, too."""
    for start in range(len(data)):
        request = checked(data, start, request_size(data[start:]))
        if request is not None:
            return request, data[start + len(request.raw) :]
    return None, data[-RTU_MAX:]


_MARGIN = 0.001  # s; behind the end of a pause, which must be exceeded
_BROADCAST = 0
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_READ_MAX, _WRITE_MAX = 125, 123
_WRITE_HEAD = struct.Struct(">HHB")  # address, registers, bytes


class ModbusAmplifiers(FarEnd):
    """Amplifiers by their units on one line or port; send: called with the bytes for the host."""

    def __init__(
        self,
        amplifiers: Mapping[int, AmplifierPort],
        send: Send,
        *,
        is_rtu: bool,
    ) -> None:
        self._units = {unit: _Unit(amplifier) for unit, amplifier in amplifiers.items()}
        self._send = send
        self._is_rtu = is_rtu
        self._reader = RequestReader(is_rtu=is_rtu)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self._take(self._reader.feed(data, now), now)

    def of_connection(self, send: Send) -> "ModbusAmplifiers":
        """Return the same units for another connection; send: see above."""
        other = ModbusAmplifiers({}, send, is_rtu=self._is_rtu)
        other._units = self._units
        return other

    @property
    def next_event(self) -> float:
        """Time by which silence has ended a frame that is not whole [s]; infinite without one."""
        return self._reader.gives_up_at + _MARGIN

    def tick(self, now: float) -> None:
        """Take the silence of the line until a time [s], which ends a frame that is not whole."""
        self._take(self._reader.pause(now), now)

    def _take(self, requests: Sequence[Adu], now: float) -> None:
        for request in requests:
            if request.unit == _BROADCAST and self._is_rtu:
                for number, each in [*self._units.items()]:
                    if each.amplifier.is_answering:
                        each.take_broadcast(request.pdu, now)
                        self._move(number)
                continue
            unit = self._units.get(request.unit)
            if unit is not None and unit.amplifier.is_answering:
                pdu = unit.reply(request.pdu, now)
                frame = framed(request.unit, pdu, request.transaction, is_rtu=self._is_rtu)
                self._send(frame)
                self._move(request.unit)

    def _move(self, number: int) -> None:
        """Move a unit to the address that it has taken."""
        unit = self._units[number]
        if unit.is_moving:
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

    def reply(self, pdu: bytes, now: float) -> bytes:
        """Return the response to a request, an exception where Modbus defines one."""
        function = pdu[0]
        try:
            if function == WRITE:
                message, tag, words = _written(pdu)
                self._replies[message.number] = tag, *self._execute(message, words, now)
                return pdu[:5]  # function, address and count
            if function in READS:
                words = self._read(*_to_read(pdu[1:]), now)
                return struct.pack(f">BB{len(words)}H", function, 2 * len(words), *words)
        except _ModbusException as exception:
            return bytes([function | EXCEPTION, exception.code])
        return bytes([function | EXCEPTION, _ILLEGAL_FUNCTION])

    def take_broadcast(self, pdu: bytes, now: float) -> None:
        """Carry a request out that is for all units; its reply area stays as it is."""
        if pdu[0] != WRITE:
            return
        try:
            message, _, words = _written(pdu)
        except _ModbusException:
            return
        if message.is_broadcast:
            result, _ = self._execute(message, words, now)
            self.is_moving = message.name == "SetAddress" and result == 0

    def _execute(
        self, message: Message, words: Sequence[int], now: float
    ) -> tuple[int, Sequence[int]]:
        """Return the result and the words of the reply to a message."""
        try:
            name, values = read_request(message.number, words)
            reply = self.amplifier.handle(name, values, now)
        except Refusal as refusal:
            _, code, channel = nak_of(refusal, message.number)
            return code << 8 | channel, ()
        if message.name == "SetAddress":
            self.address = values["address"]
        return 0, message.reply.pack(reply)

    def _read(self, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers that can be read; raises _ModbusException."""
        number, offset = divmod(address, BOX)
        if offset >= REPLY and number in BY_NUMBER:
            first = number * BOX + REPLY
            area = self._reply_area(BY_NUMBER[number], now)
        else:
            first, area = IDENTITY, pack_identity(self.amplifier.identity)
        if not first <= address <= address + count <= first + len(area):
            raise _ModbusException(_ILLEGAL_ADDRESS)
        return area[address - first :][:count]

    def _reply_area(self, message: Message, now: float) -> Sequence[int]:
        """Return the registers of a reply, with zeros behind it."""
        tag, result, words = self._replies.get(message.number, (0, 0, ()))
        if message.name in PRESENT:
            if result:  # a refusal is read once
                self._replies[message.number] = tag, 0, ()
            else:
                result, words = self._execute(message, (), now)
        elif message.name == "SetAddress":
            self.is_moving = self.address > 0 and result == 0
        row = (tag, result, *words)
        return row + (0,) * (AREA - len(row))


class _ModbusException(Exception):
    """A Modbus exception, by its code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def _to_read(body: bytes) -> tuple[int, int]:
    """Return address and count of the registers that are to be read; raises _ModbusException."""
    address, count = struct.unpack(">HH", body) if len(body) == 4 else (0, 0)
    if not 1 <= count <= _READ_MAX:
        raise _ModbusException(_ILLEGAL_VALUE)
    return address, count


def _written(pdu: bytes) -> tuple[Message, int, Sequence[int]]:
    """Return the message that is written, its tag and words; raises _ModbusException."""
    head, rest = pdu[1:6].ljust(_WRITE_HEAD.size, b"\0"), pdu[6:]
    address, count, size = _WRITE_HEAD.unpack(head)
    if not (1 <= count <= _WRITE_MAX and size == 2 * count == len(rest)):
        raise _ModbusException(_ILLEGAL_VALUE)
    tag, *words = struct.unpack(f">{count}H", rest)
    number, offset = divmod(address, BOX)
    if offset or number not in BY_NUMBER or len(words) > MAX_WORDS:
        raise _ModbusException(_ILLEGAL_ADDRESS)
    return BY_NUMBER[number], tag, words
