"""Messages on Modbus, over TCP and RTU: each is written, then its reply is read."""

import struct
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from drivers.protocol.records import Refusal
from drivers.protocol.table import BY_NUMBER, IDENTITY, MAX_WORDS, REFUSALS
from sim.witness.capture import Direction
from sim.witness.decoded import (
    A_READ,
    HELLO,
    Damaged,
    DecodedFrame,
    Message,
    Progress,
    Reply,
    Request,
    reply_of,
    request_of,
)
from sim.witness.modbus_frames import Adu, RtuSplitter, Splitter, TcpSplitter

_BOX, _REPLY, _HEAD = 256, 128, 2  # registers: of a message, before its reply, of tag and result
_IDENTITY, _IDENTITY_SIZE, _TEXT_SIZE = 1065, 66, 16  # registers
_WRITE, _READS = 16, (3, 4)
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
class _Open:
    """A transaction whose response is missing; address, count: of registers read or written."""

    unit: int
    key: Hashable
    function: int
    address: int
    count: int


class ModbusDecoder:
    """Decodes both directions, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        self._over_tcp = over_tcp
        self._split: dict[Direction, Splitter] = {
            "amplifier": TcpSplitter() if over_tcp else RtuSplitter("amplifier"),
            "host": TcpSplitter() if over_tcp else RtuSplitter("host"),
        }
        self._open: dict[int, _Open] = {}  # by transaction; over RTU at most one
        self._written: dict[tuple[int, int], _Written] = {}  # by unit and number of the message
        self._requests = 0

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        take = self._request if direction == "amplifier" else self._response
        seen: list[DecodedFrame] = []
        for adu in self._split[direction].feed(time, data):
            if adu.pdu is None:
                seen.append((adu.raw, Damaged("a malformed ADU, or a wrong CRC")))
                if direction == "amplifier" and not self._over_tcp:
                    self._open.clear()
            else:
                seen.append((adu.raw, take(adu, adu.pdu)))
        return seen

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return self._split[direction].has_partial_frame

    def _request(self, adu: Adu, pdu: bytes) -> Message:
        self._requests += 1
        key = (adu.unit, self._requests) if adu.unit or self._over_tcp else None
        function, body = pdu[0], pdu[1:]
        try:
            if function in _READS:
                address, count = struct.unpack(">HH", body)
                return self._read(adu, key, function, address, count)
            if function == _WRITE:
                address, count, size = struct.unpack_from(">HHB", body)
                words = struct.unpack(f">{count}H", body[5:])
                if size == 2 * count and count:
                    return self._write(adu, key, address, words)
        except struct.error:
            pass
        self._remember(adu, key, function, 0, 0)
        return Request(A_READ, adu.unit, key, problem=f"function {function} is malformed or none")

    def _write(self, adu: Adu, key: Hashable, address: int, words: Sequence[int]) -> Request:
        self._remember(adu, key, _WRITE, address, len(words))
        number, offset = divmod(address, _BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1 or not words[0]:
            problem = f"write of {len(words)} registers to {address}, tag {words[0]}"
            return Request(A_READ, adu.unit, key, problem=problem)
        if adu.unit:
            self._written[adu.unit, number] = _Written(words[0], key)
        return request_of(number, words[1:], adu.unit, key)

    def _read(
        self, adu: Adu, key: Hashable, function: int, address: int, count: int
    ) -> Request | Progress:
        number, offset = divmod(address, _BOX)
        written = self._written.get((adu.unit, number))
        is_reply = number in BY_NUMBER and offset == _REPLY
        if is_reply and written is not None and not written.is_read:
            self._remember(adu, written.key, function, address, count)
            return Progress(written.key, is_from_host=True)
        self._remember(adu, key, function, address, count)
        if address == _IDENTITY:
            return Request(HELLO, adu.unit, key)
        is_present = is_reply and BY_NUMBER[number].name in _PRESENT
        return Request(BY_NUMBER[number].name if is_present else A_READ, adu.unit, key)

    def _remember(self, adu: Adu, key: Hashable, function: int, address: int, count: int) -> None:
        if key is None:
            return
        if not self._over_tcp:
            self._open.clear()
        self._open[adu.number] = _Open(adu.unit, key, function, address, count)

    def _response(self, adu: Adu, pdu: bytes) -> Message | None:
        request = self._open.get(adu.number)
        if request is None or request.unit != adu.unit:
            return Reply(adu.unit)
        del self._open[adu.number]
        if pdu[0] == request.function | 0x80 and len(pdu) == 2:
            return self._refused(request, pdu[1])
        if pdu[0] != request.function:
            return Reply(adu.unit, problem=f"function must be {request.function}, got {pdu[0]}")
        if request.function == _WRITE:
            if pdu[1:] != struct.pack(">HH", request.address, request.count):
                return Reply(adu.unit, problem="address and count must be those that were written")
            return Progress(request.key, is_from_host=False)
        if len(pdu) != 2 + 2 * request.count or pdu[1] != 2 * request.count:
            return Reply(adu.unit, problem=f"registers must be {request.count}")
        return self._reply(request, struct.unpack(f">{request.count}H", pdu[2:]))

    def _refused(self, request: _Open, code: int) -> Message | None:
        """Return what an exception means; those of gateways are no response."""
        if code not in _EXCEPTIONS:
            return None
        return Reply(request.unit, request.key, refusal=_EXCEPTIONS[code])

    def _reply(self, request: _Open, words: Sequence[int]) -> Reply:
        number, offset = divmod(request.address, _BOX)
        if request.address == _IDENTITY and request.count == _IDENTITY_SIZE:
            return _identity(request, words)
        if offset != _REPLY or number not in BY_NUMBER or len(words) < _HEAD:
            return Reply(request.unit, request.key)
        written = self._written.get((request.unit, number))
        tag = 0 if written is None else written.tag
        if words[0] != tag:
            problem = f"tag must be {tag}, got {words[0]}"
            return Reply(request.unit, problem=problem)
        if written is not None and written.key == request.key:
            written.is_read = True
        if words[1]:
            return Reply(request.unit, request.key, refusal=words[1] >> 8)
        reply = reply_of(BY_NUMBER[number].name, words[_HEAD:], request.unit, request.key)
        is_part = len(words) < _HEAD + MAX_WORDS and reply.values is None
        return Reply(request.unit, request.key) if is_part else reply


def _identity(request: _Open, words: Sequence[int]) -> Reply:
    """Read the identity: tag 0, versions, texts padded with zeros."""
    row = [words[1]]
    for at in range(2, len(words), _TEXT_SIZE):
        text = struct.pack(f">{_TEXT_SIZE}H", *words[at : at + _TEXT_SIZE]).rstrip(b"\0")
        padded = text + b"\0" * (len(text) % 2)
        row += [len(text), *struct.unpack(f">{len(padded) // 2}H", padded)]
    try:
        values = IDENTITY.unpack(row, is_strict=True)
    except Refusal as refusal:
        return Reply(request.unit, request.key, problem=str(refusal))
    return Reply(request.unit, request.key, values)
