"""Decoders of the witness for CAN adapters and Modbus.

CAN messages are read from the text of an adapter: socketcand over TCP, slcan on a serial port. Of
other frames NMT, boot-up and what resets a node are decoded; heartbeats, emergencies and SDO, which
other masters read, concern no rule. Other text is ignored.

On Modbus, over TCP or RTU, a message is written, then its reply is read. ADUs are delimited as in
docs/reference/modbus.md, and read by pymodbus.
"""

import re
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    EVENT,
    MAX_WORDS,
    NAK,
    NAK_RECORD,
    REFUSALS,
    REQUEST_NAMES,
    REQUESTS,
)
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
    REPLY_OFFSET,
    WRITE,
    Adu,
    AduReader,
    Pdu,
    Response,
    message_shown,
    message_written,
    parse_request,
    reply_in,
    response_to,
)
from witness.capture import (
    A_READ,
    HELLO_REQUEST,
    REPLIES,
    DecodedFrame,
    Decoder,
    Notice,
    TransferDirection,
    WitnessedMessage,
    WitnessedReply,
    WitnessedRequest,
    damaged,
    reply_of,
    sent_by_amplifier,
    witnessed_request,
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

    def feed(self, direction: TransferDirection, time: float, data: bytes) -> list[DecodedFrame]:
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

    def _from_host(
        self, time: float, frame: CanFrame, sender: Assembler
    ) -> WitnessedMessage | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        self._sent.append(frame)
        if frame.id == cob_id("nmt") and len(frame.data) == 2:
            return None if frame.data[0] == _NMT_START else Notice("boot", frame.data[1])
        words = self._words(time, frame, sender) if kind == REQUEST else None
        if not isinstance(words, Words):
            return words
        key = (node, words.number, words.type) if node else None
        return witnessed_request(words.type, words.words, node, key, sender.began)

    def _from_bus(self, time: float, frame: CanFrame, sender: Assembler) -> WitnessedMessage | None:
        node, kind = frame.id & NODE_MAX, frame.id & ~NODE_MAX
        if frame.id == cob_id("heartbeat", node) and frame.data == b"\0":
            return Notice("boot", node)
        if kind == REQUEST and node and frame not in self._sent:
            is_first = len(frame.data) == BLOCK and frame.data[1] == 0
            name = REQUEST_NAMES.get(frame.data[2]) if is_first else None
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


class _Transaction(NamedTuple):
    """A transaction whose response is missing.

    request: None for a malformed one; shows: name of the message whose reply is read; written: the
    write of that message before it.
    """

    adu: Adu
    key: Hashable
    request: Pdu | None
    shows: str = ""
    written: _Written | None = None


class ModbusDecoder(Decoder):
    """Decodes both directions, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        super().__init__()
        self._over_tcp = over_tcp
        self._readers: dict[TransferDirection, AduReader] = {
            direction: AduReader(
                is_rtu=not over_tcp,
                of_requests=direction == "amplifier",
                waits=direction == "host",  # a piece of a response may hold what looks like one
            )
            for direction in self.rest
        }
        self._last: dict[TransferDirection, float] = {}  # times of the last bytes [s]
        self._open: dict[int, _Transaction] = {}  # by number; over RTU at most one
        self._written: dict[tuple[int, str], _Written] = {}  # by unit and name of the message
        self._requests = 0

    def feed(self, direction: TransferDirection, time: float, data: bytes) -> list[DecodedFrame]:
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

    def _request(self, adu: Adu) -> WitnessedMessage:
        self._requests += 1
        key = (adu.unit, self._requests) if adu.unit or self._over_tcp else None
        request = parse_request(adu)
        opened, taken = _Transaction(adu, key, request), WitnessedRequest(A_READ, adu.unit, key)
        if request is None:
            taken.problem = f"function {adu.pdu[0]} is malformed or none"
        elif request.function_code == WRITE:
            message, tag = message_written(request), request.registers[0]
            if message is None or not tag:
                taken.problem = (
                    f"write of {request.count} registers to {request.address}, tag {tag}"
                )
            else:
                self._written[adu.unit, message.name] = _Written(tag, key)
                taken = witnessed_request(message.number, request.registers[1:], adu.unit, key)
        elif request.address == IDENTITY_REGISTER:
            opened, taken.name = opened._replace(shows=HELLO_REQUEST), HELLO_REQUEST
        elif (message := message_shown(request)) and request.address % BOX == REPLY_OFFSET:
            written = self._written.get((adu.unit, message.name))
            opened = opened._replace(shows=message.name, written=written)
            if written is not None and not written.is_read:
                self._open[adu.transaction] = opened._replace(key=written.key)
                return Notice("read on", key=written.key)
            taken.name = message.name if message.name in PRESENT else A_READ
        if key is not None:
            self._open[adu.transaction] = opened
        return taken

    def _response(self, adu: Adu) -> WitnessedMessage | None:
        opened = self._open.get(adu.transaction)
        if opened is None or opened.adu.unit != adu.unit:
            return WitnessedReply(adu.unit)
        del self._open[adu.transaction]
        key, request, sent = opened.key, opened.request, opened.adu.pdu
        if adu.pdu[0] == sent[0] | EXCEPTION and len(adu.pdu) == 2:
            name = EXCEPTIONS.get(adu.pdu[1])  # what gateways refuse is no response
            return None if name is None else WitnessedReply(adu.unit, key, refusal=REFUSALS[name])
        response = response_to(request, adu)
        if request is None or response is None:
            problem = f"function must be {sent[0]}, got {adu.pdu[0]}"
            if adu.pdu[0] == sent[0]:
                problem = f"response must fit {sent[:5].hex()}, got {adu.pdu.hex()}"
            return WitnessedReply(adu.unit, problem=problem)
        if request.function_code == WRITE:
            return Notice("carried out", key=key)
        return self._reply(opened, response)

    def _reply(self, opened: _Transaction, response: Response) -> WitnessedReply:
        unit, key, written, shown = opened.adu.unit, opened.key, opened.written, response.registers
        tag = 0 if written is None else written.tag
        if not opened.shows or len(shown) < (
            IDENTITY_COUNT if opened.shows == HELLO_REQUEST else HEAD
        ):
            return WitnessedReply(unit, key)
        if shown[0] != tag:
            return WitnessedReply(unit, problem=f"tag must be {tag}, got {shown[0]}")
        if written is not None and written.key == key:
            written.is_read = True
        number = REQUESTS[opened.shows].number
        try:
            kind, words = reply_in(number, response)
        except Refusal as refusal:
            return WitnessedReply(unit, key, problem=str(refusal))
        reply = reply_of(NAK_RECORD if kind == NAK else REPLIES[opened.shows], words, unit, key)
        is_part = len(shown) < AREA and reply.values is None
        return WitnessedReply(unit, key) if is_part else reply
