"""Decoders of the witness for CAN adapters and Modbus.

CAN messages are read from the text of an adapter: socketcand over TCP, slcan on a serial port. Of
other frames NMT, boot-up and what resets a node are decoded; heartbeats, emergencies and SDO, which
other masters read, concern no rule. Other text is ignored.

On Modbus, over TCP or RTU, a message is written, then its reply is read. ADUs are delimited as in
docs/reference/modbus.md, and read by pymodbus.
"""

import re
from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from drivers.errors import WireCounters
from drivers.protocol.definition import BY_NUMBER, EVENT, MAX_WORDS, NAMES, REFUSALS
from drivers.protocol.records import Refusal
from drivers.wires.can_frames import (
    BLOCK,
    CANOPEN,
    NODE_MAX,
    REPLY,
    REQUEST,
    SLCAN,
    SOCKETCAND,
    Assembler,
    CanFrame,
    cob_id,
    frames_of,
)
from drivers.wires.can_frames import CanMessage as Words
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    EXCEPTION,
    EXCEPTIONS,
    HEAD,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    PRESENT,
    READS,
    REPLY_OFFSET,
    WRITE,
    Adu,
    AduReader,
    Pdu,
    parse_request,
    response_to,
    unpack_identity,
)
from era_haptics.lab.witness.capture import (
    A_READ,
    HELLO,
    DecodedFrame,
    Decoder,
    Direction,
    Message,
    Notice,
    WitnessedReply,
    WitnessedRequest,
    damaged,
    reply_of,
    request_of,
    sent_by_amplifier,
)

_MAX_REST = 512  # bytes kept of text that does not end
_KEPT = 3 * frames_of(MAX_WORDS)  # frames of the host, which an adapter may echo
_NMT_START: int = CANOPEN["nmt"]["start"]
_FORMS = {"slcan": SLCAN, "socketcand": SOCKETCAND}
_IS_FRAME = re.compile(rb"t|< (?:send|frame) [0-9A-Fa-f]{1,3} ")  # with an 11-bit identifier


class CanDecoder(Decoder):
    """Decodes the text of an adapter of this kind."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._form = _FORMS[kind]
        self._sent: deque[CanFrame] = deque(maxlen=_KEPT)
        self._counters = WireCounters()
        # Messages of a sender, by its identifier and whether they are numbered.
        self._senders: dict[tuple[int, bool], Assembler] = {}

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = self._form.end.split(self.rest[direction] + data)
        self.rest[direction] = rest[-_MAX_REST:]
        decode = self._form.decode_sent if direction == "amplifier" else self._form.decode
        seen: list[DecodedFrame] = []
        for piece in map(bytes.strip, pieces):
            frame = decode(piece)
            if frame is None:
                if _IS_FRAME.match(piece):
                    seen.append((piece, damaged("a malformed frame line")))
                continue
            is_numbered = frame.data[:1] != b"\0"
            made = Assembler(self._counters, is_numbered=is_numbered)
            sender = self._senders.setdefault((frame.id, is_numbered), made)
            take = self._from_host if direction == "amplifier" else self._from_bus
            message = take(time, frame, sender)
            if sender.given_up is not None:
                number, started_at = sender.given_up
                seen.append((b"", damaged(f"message {number} without all frames", started_at)))
                sender.given_up = None
            seen.append((piece, message))
        return seen

    def _words(self, time: float, frame: CanFrame, sender: Assembler) -> Words | Notice | None:
        """Take a frame; returns the message that it completes, or that it fits none."""
        before = self._counters.invalid_frames
        words = sender.add(frame.data, time)
        return (
            damaged("a frame that fits no message")
            if self._counters.invalid_frames > before
            else words
        )

    def _from_host(self, time: float, frame: CanFrame, sender: Assembler) -> Message | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        self._sent.append(frame)
        if frame.id == cob_id("nmt") and len(frame.data) == 2:
            return None if frame.data[0] == _NMT_START else Notice("boot", frame.data[1])
        words = self._words(time, frame, sender) if kind == REQUEST else None
        if not isinstance(words, Words):
            return words
        key = (node, words.number, words.type) if node else None
        return request_of(words.type, words.words, node, key, sender.began)

    def _from_bus(self, time: float, frame: CanFrame, sender: Assembler) -> Message | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        if frame.id == cob_id("heartbeat", node) and frame.data == b"\0":
            return Notice("boot", node)
        if kind == REQUEST and node and frame not in self._sent:
            is_first = len(frame.data) == BLOCK and frame.data[1] == 0
            name = NAMES.get(frame.data[2]) if is_first else None
            return Notice("other host", node, text=name) if name else None
        words = self._words(time, frame, sender) if kind == REPLY and node else None
        if not isinstance(words, Words):
            return words
        if words.number == 0 and words.type != EVENT:
            return damaged(f"a message of type {words.type} without a number")
        return sent_by_amplifier(words.type, words.words, node, words.number)


_PAUSE = 0.04  # s; a longer pause ends a partial frame on RTU


@dataclass(slots=True)
class _Written:
    """The message written last to an area of a unit, until its reply was read."""

    tag: int
    key: Hashable
    is_read: bool = False


@dataclass(frozen=True, slots=True)
class _Transaction:
    """One whose response is missing; request: None where it is none; tag: of what it reads."""

    adu: Adu
    key: Hashable
    request: Pdu | None = None
    tag: int = 0


class ModbusDecoder(Decoder):
    """Decodes both directions, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        super().__init__()
        self._over_tcp = over_tcp
        self._readers: dict[Direction, AduReader] = {
            direction: AduReader(
                is_rtu=not over_tcp,
                of_requests=direction == "amplifier",
                waits=direction == "host",  # a piece of a response may hold what looks like one
            )
            for direction in self.rest
        }
        self._last: dict[Direction, float] = {}  # times of the last bytes [s]
        self._open: dict[int, _Transaction] = {}  # by number; over RTU at most one
        self._written: dict[tuple[int, int], _Written] = {}  # by unit and number of the message
        self._requests = 0

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        take = self._request if direction == "amplifier" else self._response
        seen: list[DecodedFrame] = []
        reader = self._readers[direction]
        is_late = not self._over_tcp and time > self._last.get(direction, time) + _PAUSE
        found = [*(reader.end() if is_late else ()), *reader.feed(data)]
        self.rest[direction], self._last[direction] = reader.rest, time
        for adu in found:
            seen.append((adu.raw, take(adu) if adu.pdu else damaged("a malformed ADU")))
            if not adu.pdu and direction == "amplifier" and not self._over_tcp:
                self._open.clear()
        return seen

    def _request(self, adu: Adu) -> Message:
        self._requests += 1
        key = (adu.unit, self._requests) if adu.unit or self._over_tcp else None
        request = parse_request(adu)
        if request is None:
            self._remember(_Transaction(adu, key))
            problem = f"function {adu.pdu[0]} is malformed or none"
            return WitnessedRequest(A_READ, adu.unit, key, problem=problem)
        if adu.pdu[0] in READS:
            return self._read(adu, key, request)
        return self._write(adu, key, request)

    def _write(self, adu: Adu, key: Hashable, request: Pdu) -> WitnessedRequest:
        self._remember(_Transaction(adu, key, request))
        words = request.registers
        number, offset = divmod(request.address, BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1 or not words[0]:
            problem = f"write of {len(words)} registers to {request.address}, tag {words[0]}"
            return WitnessedRequest(A_READ, adu.unit, key, problem=problem)
        if adu.unit:
            self._written[adu.unit, number] = _Written(words[0], key)
        return request_of(number, words[1:], adu.unit, key)

    def _read(self, adu: Adu, key: Hashable, request: Pdu) -> WitnessedRequest | Notice:
        number, offset = divmod(request.address, BOX)
        written = self._written.get((adu.unit, number))
        is_reply = number in BY_NUMBER and offset == REPLY_OFFSET
        if is_reply and written is not None and not written.is_read:
            self._remember(_Transaction(adu, written.key, request, written.tag))
            return Notice("read on", key=written.key)
        self._remember(_Transaction(adu, key, request, written.tag if written is not None else 0))
        if request.address == IDENTITY_REGISTER:
            return WitnessedRequest(HELLO, adu.unit, key)
        is_present = is_reply and BY_NUMBER[number].name in PRESENT
        return WitnessedRequest(BY_NUMBER[number].name if is_present else A_READ, adu.unit, key)

    def _remember(self, transaction: _Transaction) -> None:
        if transaction.key is not None:
            self._open[transaction.adu.transaction] = transaction

    def _response(self, adu: Adu) -> Message | None:
        transaction = self._open.get(adu.transaction)
        if transaction is None or transaction.adu.unit != adu.unit:
            return WitnessedReply(adu.unit)
        del self._open[adu.transaction]
        key, request, function = transaction.key, transaction.request, transaction.adu.pdu[0]
        if adu.pdu[0] == function | EXCEPTION and len(adu.pdu) == 2:
            name = EXCEPTIONS.get(adu.pdu[1])  # what gateways refuse is no response
            return None if name is None else WitnessedReply(adu.unit, key, refusal=REFUSALS[name])
        response = response_to(request, adu)
        if request is None or response is None:
            problem = f"function must be {function}, got {adu.pdu[0]}"
            if adu.pdu[0] == function:
                problem = f"response must fit {transaction.adu.pdu[:5].hex()}, got {adu.pdu.hex()}"
            return WitnessedReply(adu.unit, problem=problem)
        if request.function_code == WRITE:
            return Notice("carried out", key=key)
        return self._reply(transaction, request.address, response.registers)

    def _reply(
        self, transaction: _Transaction, address: int, words: Sequence[int]
    ) -> WitnessedReply:
        unit, key, tag = transaction.adu.unit, transaction.key, transaction.tag
        number, offset = divmod(address, BOX)
        if address == IDENTITY_REGISTER and len(words) == IDENTITY_COUNT:
            try:
                return WitnessedReply(unit, key, unpack_identity(words))
            except Refusal as refusal:
                return WitnessedReply(unit, key, problem=str(refusal))
        if offset != REPLY_OFFSET or number not in BY_NUMBER or len(words) < HEAD:
            return WitnessedReply(unit, key)
        written = self._written.get((unit, number))
        if words[0] != tag:
            return WitnessedReply(unit, problem=f"tag must be {tag}, got {words[0]}")
        if written is not None and written.key == key:
            written.is_read = True
        if words[1]:
            return WitnessedReply(unit, key, refusal=words[1] >> 8)
        reply = reply_of(BY_NUMBER[number].reply, words[HEAD:], unit, key)
        is_part = len(words) < AREA and reply.values is None
        return WitnessedReply(unit, key) if is_part else reply
