"""Messages on Modbus, over TCP and RTU: each is written, then its reply is read.

ADUs are found by docs/reference/modbus.md."""

import struct
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from drivers.codec.modbus.crc import crc16
from drivers.codec.serial_line.frame import unpack_identity
from drivers.protocol.records import Refusal
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, REFUSALS
from sim.witness.capture import Direction
from sim.witness.decoded import (
    A_READ,
    HELLO,
    DecodedFrame,
    Decoder,
    Message,
    Notice,
    Reply,
    Request,
    damaged,
    reply_of,
    request_of,
)

READS, WRITE = (3, 4), 16
_MBAP, _RTU_MIN, _RTU_MAX = 7, 4, 256  # bytes
# Of RTU, by function: where a count of bytes stands, if one does, and bytes around those counted.
_SIZES: dict[Direction, dict[int, tuple[int | None, int]]] = {
    "amplifier": {**dict.fromkeys(READS, (None, 8)), WRITE: (6, 9)},
    "host": {
        **dict.fromkeys(READS, (2, 5)),
        WRITE: (None, 8),
        **dict.fromkeys(range(0x80, 0x100), (None, 5)),
    },
}


class Adu(NamedTuple):
    """An ADU; number: the TCP transaction, 0 over RTU; function 0: it is damaged."""

    raw: bytes
    unit: int = 0
    number: int = 0
    function: int = 0
    body: bytes = b""


def split_tcp(data: bytes) -> tuple[list[Adu], bytes]:
    """Split bytes by the headers (transaction, 0, length, unit); returns what is left, too."""
    found: list[Adu] = []
    while len(data) >= _MBAP:
        number, protocol, length, unit = struct.unpack_from(">HHHB", data)
        if protocol or not 2 <= length <= 254:
            return [*found, Adu(data)], b""
        raw, rest = data[: 6 + length], data[6 + length :]
        if len(raw) < 6 + length:
            break
        found.append(Adu(raw, unit, number, raw[7], raw[8:]))
        data = rest
    return found, data


def split_rtu(direction: Direction, data: bytes) -> tuple[list[Adu], bytes]:
    """Split bytes by functions, which determine lengths, and CRC-16; returns what is left, too."""
    found: list[Adu] = []
    begin = 0
    while begin + _RTU_MIN <= len(data):
        size = _size_of(direction, data[begin:])
        raw = data[begin : begin + size]
        if size and len(raw) == size and crc16(raw[:-2]) == raw[-2:]:
            if begin:
                found.append(Adu(data[:begin]))
            found.append(Adu(raw, raw[0], 0, raw[1], raw[2:-2]))
            begin, data = 0, data[begin + size :]
        else:
            begin += 1
    if len(data) >= max(_RTU_MIN, _size_of(direction, data)):  # it cannot become an ADU
        return [*found, Adu(data)], b""
    return found, data


def _size_of(direction: Direction, data: bytes) -> int:
    """Size of the ADU that begins with these bytes; 0 where it is invalid."""
    at, around = _SIZES[direction].get(data[1], (None, 0)) if len(data) > 1 else (None, 0)
    size = around if at is None else around + sum(data[at : at + 1])
    return size if size <= _RTU_MAX else 0


_BOX, _REPLY, _HEAD = 256, 128, 2  # registers: of a message, before its reply, of tag and result
_IDENTITY, _IDENTITY_SIZE, _TEXT_SIZE = 1065, 66, 32  # registers, and bytes of a text
_PAUSE = 0.04  # s; a longer pause ends a partial frame on RTU
_PRESENT = ("GetCaps", "GetStatus", "GetFaults")
"""Replies that are read as they are at that moment, written before or not."""
_EXCEPTIONS = {
    **dict.fromkeys((1, 2), REFUSALS["UNKNOWN_TYPE"]),
    3: REFUSALS["BAD_LENGTH"],
    **dict.fromkeys((5, 6), REFUSALS["BUSY"]),
}


@dataclass(slots=True)
class _Written:
    """The message written last to an area of a unit, until its reply was read."""

    tag: int
    key: Hashable
    is_read: bool = False


@dataclass(frozen=True, slots=True)
class _Transaction:
    """One whose response is missing; address, count: of registers read or written."""

    adu: Adu
    key: Hashable
    address: int = 0
    count: int = 0

    def problem_of(self, response: Adu) -> str:
        """Describe why something is no response to it; "" if it is one."""
        function, body = self.adu.function, response.body
        if response.function == function | 0x80 and len(body) == 1:
            return ""
        if response.function != function:
            return f"function must be {function}, got {response.function}"
        if function == WRITE:
            is_echo = body == struct.pack(">HH", self.address, self.count)
            return "" if is_echo else "address and count must be those that were written"
        is_whole = len(body) == 1 + 2 * self.count and body[0] == 2 * self.count
        return "" if is_whole else f"registers must be {self.count}"


class ModbusDecoder(Decoder):
    """Decodes both directions, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        super().__init__()
        self._over_tcp = over_tcp
        self._last: dict[Direction, float] = {}  # times of the last bytes [s]
        self._open: dict[int, _Transaction] = {}  # by number; over RTU at most one
        self._written: dict[tuple[int, int], _Written] = {}  # by unit and number of the message
        self._requests = 0

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        take = self._request if direction == "amplifier" else self._response
        seen: list[DecodedFrame] = []
        for adu in self._split(direction, time, data):
            seen.append((adu.raw, take(adu) if adu.function else damaged("a malformed ADU")))
            if not adu.function and direction == "amplifier" and not self._over_tcp:
                self._open.clear()
        return seen

    def _split(self, direction: Direction, time: float, data: bytes) -> list[Adu]:
        before = self.rest[direction]
        if self._over_tcp:
            found, self.rest[direction] = split_tcp(before + data)
            return found
        is_late = before and time > self._last.get(direction, time) + _PAUSE
        cut_off = [Adu(before)] if is_late else []
        found, self.rest[direction] = split_rtu(direction, data if is_late else before + data)
        self._last[direction] = time
        return [*cut_off, *found]

    def _request(self, adu: Adu) -> Message:
        self._requests += 1
        key = (adu.unit, self._requests) if adu.unit or self._over_tcp else None
        try:
            address, count = struct.unpack_from(">HH", adu.body)
            if adu.function in READS and len(adu.body) == 4:
                return self._read(adu, key, address, count)
            if adu.function == WRITE and adu.body[4:5] == bytes([2 * count]) != b"\0":
                words = struct.unpack(f">{count}H", adu.body[5:])
                return self._write(adu, key, address, words)
        except (struct.error, ValueError):
            pass
        self._remember(_Transaction(adu, key))
        problem = f"function {adu.function} is malformed or none"
        return Request(A_READ, adu.unit, key, problem=problem)

    def _write(self, adu: Adu, key: Hashable, address: int, words: Sequence[int]) -> Request:
        self._remember(_Transaction(adu, key, address, len(words)))
        number, offset = divmod(address, _BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1 or not words[0]:
            problem = f"write of {len(words)} registers to {address}, tag {words[0]}"
            return Request(A_READ, adu.unit, key, problem=problem)
        if adu.unit:
            self._written[adu.unit, number] = _Written(words[0], key)
        return request_of(number, words[1:], adu.unit, key)

    def _read(self, adu: Adu, key: Hashable, address: int, count: int) -> Request | Notice:
        number, offset = divmod(address, _BOX)
        written = self._written.get((adu.unit, number))
        is_reply = number in BY_NUMBER and offset == _REPLY
        if is_reply and written is not None and not written.is_read:
            self._remember(_Transaction(adu, written.key, address, count))
            return Notice("read on", key=written.key)
        self._remember(_Transaction(adu, key, address, count))
        if address == _IDENTITY:
            return Request(HELLO, adu.unit, key)
        is_present = is_reply and BY_NUMBER[number].name in _PRESENT
        return Request(BY_NUMBER[number].name if is_present else A_READ, adu.unit, key)

    def _remember(self, transaction: _Transaction) -> None:
        if transaction.key is not None:
            self._open[transaction.adu.number] = transaction

    def _response(self, adu: Adu) -> Message | None:
        request = self._open.get(adu.number)
        if request is None or request.adu.unit != adu.unit:
            return Reply(adu.unit)
        del self._open[adu.number]
        if problem := request.problem_of(adu):
            return Reply(adu.unit, problem=problem)
        if adu.function != request.adu.function:  # what gateways refuse is no response
            refusal = _EXCEPTIONS.get(adu.body[0])
            return None if refusal is None else Reply(adu.unit, request.key, refusal=refusal)
        if adu.function == WRITE:
            return Notice("carried out", key=request.key)
        return self._reply(request, struct.unpack_from(f">{request.count}H", adu.body, 1))

    def _reply(self, request: _Transaction, words: Sequence[int]) -> Reply:
        number, offset = divmod(request.address, _BOX)
        unit, key = request.adu.unit, request.key
        if request.address == _IDENTITY and request.count == _IDENTITY_SIZE:
            return _identity(unit, key, words)
        if offset != _REPLY or number not in BY_NUMBER or len(words) < _HEAD:
            return Reply(unit, key)
        written = self._written.get((unit, number))
        tag = 0 if written is None else written.tag
        if words[0] != tag:
            return Reply(unit, problem=f"tag must be {tag}, got {words[0]}")
        if written is not None and written.key == key:
            written.is_read = True
        if words[1]:
            return Reply(unit, key, refusal=words[1] >> 8)
        reply = reply_of(BY_NUMBER[number].reply, words[_HEAD:], unit, key)
        is_part = len(words) < _HEAD + MAX_WORDS and reply.values is None
        return Reply(unit, key) if is_part else reply


def _identity(unit: int, key: Hashable, words: Sequence[int]) -> Reply:
    """Read the identity: tag 0, versions, texts padded with zeros."""
    raw = struct.pack(f">{len(words) - 2}H", *words[2:])
    texts = [raw[at : at + _TEXT_SIZE].rstrip(b"\0") for at in range(0, len(raw), _TEXT_SIZE)]
    payload = struct.pack("<H", words[1]) + b"".join(bytes([len(each)]) + each for each in texts)
    try:
        return Reply(unit, key, unpack_identity(payload))
    except Refusal as refusal:
        return Reply(unit, key, problem=str(refusal))
