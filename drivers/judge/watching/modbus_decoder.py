"""Messages on Modbus, over TCP and RTU: each is written, then its reply is read.

ADUs are found by docs/reference/modbus.md."""

import struct
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from drivers.judge.watching.capture import Direction
from drivers.judge.watching.decoded import (
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
from drivers.protocol.records import Refusal
from drivers.protocol.table import BY_NUMBER, MAX_WORDS, REFUSALS
from drivers.wires.modbus.frames import (
    EXCEPTION,
    READS,
    WRITE,
    Adu,
    request_size,
    response_form,
    response_size,
    split_rtu,
    split_tcp,
)
from drivers.wires.modbus.registers import (
    AREA,
    BOX,
    EXCEPTIONS,
    HEAD,
    IDENTITY,
    IDENTITY_COUNT,
    PRESENT,
    REPLY,
    unpack_identity,
)

_PAUSE = 0.04  # s; a longer pause ends a partial frame on RTU


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
        function, got = self.adu.pdu[0], response.pdu[0]
        if got == function | EXCEPTION and len(response.pdu) == 2:
            return ""
        if got != function:
            return f"function must be {function}, got {got}"
        head, size = response_form(self.adu.pdu)
        is_whole = len(response.pdu) == size and response.pdu.startswith(head)
        return "" if is_whole else f"response must be {size} bytes from {head.hex()} on"


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
            seen.append((adu.raw, take(adu) if adu.pdu else damaged("a malformed ADU")))
            if not adu.pdu and direction == "amplifier" and not self._over_tcp:
                self._open.clear()
        return seen

    def _split(self, direction: Direction, time: float, data: bytes) -> list[Adu]:
        before = self.rest[direction]
        if self._over_tcp:
            found, self.rest[direction] = split_tcp(before + data)
            return found
        is_late = before and time > self._last.get(direction, time) + _PAUSE
        cut_off = [Adu(0, b"", raw=before)] if is_late else []
        size_of = request_size if direction == "amplifier" else response_size
        found, self.rest[direction] = split_rtu(data if is_late else before + data, size_of)
        self._last[direction] = time
        return [*cut_off, *found]

    def _request(self, adu: Adu) -> Message:
        self._requests += 1
        key = (adu.unit, self._requests) if adu.unit or self._over_tcp else None
        function, body = adu.pdu[0], adu.pdu[1:]
        try:
            address, count = struct.unpack_from(">HH", body)
            if function in READS and len(body) == 4:
                return self._read(adu, key, address, count)
            if function == WRITE and body[4:5] == bytes([2 * count]) != b"\0":
                words = struct.unpack(f">{count}H", body[5:])
                return self._write(adu, key, address, words)
        except (struct.error, ValueError):
            pass
        self._remember(_Transaction(adu, key))
        problem = f"function {function} is malformed or none"
        return Request(A_READ, adu.unit, key, problem=problem)

    def _write(self, adu: Adu, key: Hashable, address: int, words: Sequence[int]) -> Request:
        self._remember(_Transaction(adu, key, address, len(words)))
        number, offset = divmod(address, BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1 or not words[0]:
            problem = f"write of {len(words)} registers to {address}, tag {words[0]}"
            return Request(A_READ, adu.unit, key, problem=problem)
        if adu.unit:
            self._written[adu.unit, number] = _Written(words[0], key)
        return request_of(number, words[1:], adu.unit, key)

    def _read(self, adu: Adu, key: Hashable, address: int, count: int) -> Request | Notice:
        number, offset = divmod(address, BOX)
        written = self._written.get((adu.unit, number))
        is_reply = number in BY_NUMBER and offset == REPLY
        if is_reply and written is not None and not written.is_read:
            self._remember(_Transaction(adu, written.key, address, count))
            return Notice("read on", key=written.key)
        self._remember(_Transaction(adu, key, address, count))
        if address == IDENTITY:
            return Request(HELLO, adu.unit, key)
        is_present = is_reply and BY_NUMBER[number].name in PRESENT
        return Request(BY_NUMBER[number].name if is_present else A_READ, adu.unit, key)

    def _remember(self, transaction: _Transaction) -> None:
        if transaction.key is not None:
            self._open[transaction.adu.transaction] = transaction

    def _response(self, adu: Adu) -> Message | None:
        request = self._open.get(adu.transaction)
        if request is None or request.adu.unit != adu.unit:
            return Reply(adu.unit)
        del self._open[adu.transaction]
        if problem := request.problem_of(adu):
            return Reply(adu.unit, problem=problem)
        if adu.pdu[0] & EXCEPTION:  # what gateways refuse is no response
            name = EXCEPTIONS.get(adu.pdu[1])
            return None if name is None else Reply(adu.unit, request.key, refusal=REFUSALS[name])
        if adu.pdu[0] == WRITE:
            return Notice("carried out", key=request.key)
        return self._reply(request, struct.unpack_from(f">{request.count}H", adu.pdu, 2))

    def _reply(self, request: _Transaction, words: Sequence[int]) -> Reply:
        number, offset = divmod(request.address, BOX)
        unit, key = request.adu.unit, request.key
        if request.address == IDENTITY and request.count == IDENTITY_COUNT:
            try:
                return Reply(unit, key, unpack_identity(words))
            except Refusal as refusal:
                return Reply(unit, key, problem=str(refusal))
        if offset != REPLY or number not in BY_NUMBER or len(words) < HEAD:
            return Reply(unit, key)
        written = self._written.get((unit, number))
        tag = 0 if written is None else written.tag
        if words[0] != tag:
            return Reply(unit, problem=f"tag must be {tag}, got {words[0]}")
        if written is not None and written.key == key:
            written.is_read = True
        if words[1]:
            return Reply(unit, key, refusal=words[1] >> 8)
        reply = reply_of(BY_NUMBER[number].reply, words[HEAD:], unit, key)
        is_part = len(words) < AREA and reply.values is None
        return Reply(unit, key) if is_part else reply
