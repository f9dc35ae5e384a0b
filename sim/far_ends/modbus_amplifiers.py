"""The amplifiers' side of Modbus, without I/O: bytes in, bytes out.

Each message is a mailbox: written from register 256 n on (tag, words), its reply read from
256 n + 128 on (tag, result, words).

Not modelled: parity and collisions on a serial line.
"""

import struct
from collections.abc import Mapping, Sequence

from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, Message, nak_of, read_request
from sim.far_ends.modbus_frames import (
    READS,
    WRITE,
    RequestAdu,
    RequestReader,
    rtu_frame,
    tcp_frame,
)
from sim.transport.far_end import AmplifierPort, FarEnd, Send

_MARGIN = 0.001  # s; behind the end of a pause, which must be exceeded
_BOX = 256  # registers of a message
_REPLY = 128  # offset of its reply
_REPLY_HEAD = 2  # registers: tag, result
_IDENTITY = 1065
_TEXTS = ("vendor", "product", "serial_number", "firmware")
_TEXT_SIZE = 32  # bytes
_BROADCAST = 0
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_READ_MAX, _WRITE_MAX = 125, 123
_WRITE_HEAD = struct.Struct(">HHB")  # address, registers, bytes
_PRESENT = ("GetCaps", "GetStatus", "GetFaults")


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

    def _take(self, requests: Sequence[RequestAdu], now: float) -> None:
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
                is_rtu = self._is_rtu
                self._send(rtu_frame(request.unit, pdu) if is_rtu else tcp_frame(request, pdu))
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
            return bytes([function | 0x80, exception.code])
        return bytes([function | 0x80, _ILLEGAL_FUNCTION])

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
        number, offset = divmod(address, _BOX)
        if offset >= _REPLY and number in BY_NUMBER:
            first = number * _BOX + _REPLY
            area = self._reply_area(BY_NUMBER[number], now)
        else:
            first, area = _IDENTITY, _identity(self.amplifier.identity)
        if not first <= address <= address + count <= first + len(area):
            raise _ModbusException(_ILLEGAL_ADDRESS)
        return area[address - first :][:count]

    def _reply_area(self, message: Message, now: float) -> Sequence[int]:
        """Return the registers of a reply, with zeros behind it."""
        tag, result, words = self._replies.get(message.number, (0, 0, ()))
        if message.name in _PRESENT:
            if result:  # a refusal is read once
                self._replies[message.number] = tag, 0, ()
            else:
                result, words = self._execute(message, (), now)
        elif message.name == "SetAddress":
            self.is_moving = self.address > 0 and result == 0
        row = (tag, result, *words)
        return row + (0,) * (_REPLY_HEAD + MAX_WORDS - len(row))


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
    number, offset = divmod(address, _BOX)
    if offset or number not in BY_NUMBER or len(words) > MAX_WORDS:
        raise _ModbusException(_ILLEGAL_ADDRESS)
    return BY_NUMBER[number], tag, words


def _identity(identity: Values) -> Sequence[int]:
    """Return the registers of the identity: tag 0, versions, texts padded with zeros."""
    raw = [identity[name].encode()[:_TEXT_SIZE].decode(errors="ignore").encode() for name in _TEXTS]
    texts = b"".join(text.ljust(_TEXT_SIZE, b"\0") for text in raw)
    return (0, identity["versions"], *struct.unpack(f">{len(texts) // 2}H", texts))
