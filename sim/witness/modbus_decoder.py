"""Decoder for Modbus, from docs/reference/wire-modbus.md."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from sim.witness import quantities as q
from sim.witness.capture import Direction
from sim.witness.decoded import (
    REPLY_TO_DAMAGED_FRAME,
    ChannelCommand,
    Damaged,
    DecodedFrame,
    EnvelopeLoad,
    Message,
    Reply,
    Request,
    RequestKind,
    Status,
)
from sim.witness.modbus_frames import Adu, RtuSplitter, Splitter, TcpSplitter
from sim.witness.quantities import INVALID, OutOfRange, signed
from sim.witness.reports import check_text, faults_of_words

_CONTROL, _HEARTBEAT, _LOOK, _SET, _ENVELOPE, _ADDRESS = 1, 9, 12, 15, 101, 181
_STATUS, _REFUSAL, _CAPABILITIES, _IDENTITY, _ACHIEVED, _FAULTS = 1001, 1033, 1351, 1065, 1141, 1221
_TEXT_WORDS = 16
_WORDS = {15: RequestKind.ARM, 0: RequestKind.DISARM, 2: RequestKind.STOP, 128: RequestKind.CLEAR}
_MEASURED = 1421
_OF_SENSORS = (221, 231, 261)  # written to select or begin what is read: nothing that plays
_SENSORS, _READING, _SAMPLES = 1501, 1641, 1781
_READ_KINDS = {
    _IDENTITY: RequestKind.HELLO,
    _CAPABILITIES: RequestKind.CAPABILITIES,
    _FAULTS: RequestKind.FAULTS,
}
_TAGGED = (_CONTROL, _HEARTBEAT, _SET, _ENVELOPE, _ADDRESS, *_OF_SENSORS)
_READ_TAGS = (
    *(*_TAGGED, _STATUS, _REFUSAL, _CAPABILITIES, _IDENTITY, _ACHIEVED, _FAULTS),
    *(_SENSORS, _READING, _SAMPLES),
)


@dataclass(frozen=True, slots=True)
class _Open:
    """A request ADU whose reply is pending."""

    unit: int
    key: object
    function: int
    read_from: int | None
    count: int
    tag: int | None


class ModbusDecoder:
    """Decodes both directions, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        self._over_tcp = over_tcp
        self._split: dict[Direction, Splitter] = {
            "amplifier": TcpSplitter() if over_tcp else RtuSplitter("amplifier"),
            "host": TcpSplitter() if over_tcp else RtuSplitter("host"),
        }
        self._open: dict[int, _Open] = {}  # by transaction; over RTU at most one
        self._decode_request = 0
        self._is_damaged = False  # the last request
        self._tags: dict[int, int] = {}  # the last written, by unit

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        take = self._request if direction == "amplifier" else self._answer
        seen: list[DecodedFrame] = []
        for one in self._split[direction].feed(time, data):
            if one.pdu is not None:
                seen.append((one.raw, take(one)))
                continue
            seen.append((one.raw, Damaged("a malformed ADU, or a wrong CRC")))
            if direction == "amplifier" and not self._over_tcp:
                self._open.clear()
                self._is_damaged = True
        return seen

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return self._split[direction].has_partial_frame

    # requests

    def _request(self, adu: Adu) -> Message:
        pdu = adu.pdu or b""
        self._is_damaged = False
        self._decode_request += 1
        key = None if adu.unit == 0 else (adu.unit, self._decode_request)
        try:
            return self._decode_pdu(adu, pdu, key)
        except INVALID as problem:
            self._remember(adu, _Open(adu.unit, key, pdu[0], None, 0, None))
            return Request(RequestKind.READ, adu.unit, key, problem=str(problem) or "too short")

    def _decode_pdu(self, adu: Adu, pdu: bytes, key: object) -> Message:
        function, body = pdu[0], pdu[1:]
        read: tuple[int, int] | None = None
        written: tuple[int, list[int]] | None = None
        match function:
            case 3 | 4:
                read = struct.unpack(">HH", body)
            case 16:
                written = _written(body)
            case 23:
                read = struct.unpack_from(">HH", body)
                written = _written(body[4:])
            case _:
                raise OutOfRange(f"function {function}")
        tag = None if written is None else self._tag(adu.unit, *written)
        expected = tag if tag is not None else self._tags.get(adu.unit)
        at, count = read or (None, 0)
        self._remember(adu, _Open(adu.unit, key, function, at, count, expected))
        if written is not None:
            return _of_write(adu.unit, key, *written, read_from=at)
        kind = _READ_KINDS.get(at or 0, RequestKind.READ)
        return Request(kind, adu.unit, key)

    def _remember(self, adu: Adu, request: _Open) -> None:
        if adu.unit == 0:
            return
        if not self._over_tcp:
            self._open.clear()
        self._open[adu.number] = request

    def _tag(self, unit: int, at: int, words: Sequence[int]) -> int | None:
        """The tag of a write, which reads repeat."""
        if at in (*_TAGGED, _LOOK):
            self._tags[unit] = words[0]
            return words[0]
        return None

    # replies

    def _answer(self, adu: Adu) -> Message:
        pdu = adu.pdu or b""
        request = self._open.get(adu.number)
        if request is None or (adu.unit, pdu[0] & 0x7F) != (request.unit, request.function):
            problem = REPLY_TO_DAMAGED_FRAME if self._is_damaged else ""
            return Reply(adu.unit, problem=problem)
        key = request.key
        if pdu[0] & 0x80:
            if len(pdu) != 2:
                return Damaged(f"an exception must have two bytes, got {len(pdu)}")
            del self._open[adu.number]
            return Reply(adu.unit, key, refusal=pdu[1])
        try:
            reply = _of_read(adu.unit, pdu, request)
        except INVALID as problem:
            return Damaged(f"an invalid reply: {problem}")
        if reply.key is not None:
            del self._open[adu.number]
        return reply


def _written(body: bytes) -> tuple[int, list[int]]:
    at, count, size = struct.unpack_from(">HHB", body)
    words = list(struct.unpack(f">{count}H", body[5:]))
    if size != 2 * count:
        raise OutOfRange("byte count does not match the register count")
    return at, words


def _of_write(
    unit: int, key: object, at: int, words: list[int], *, read_from: int | None
) -> Request:
    """Decode a write."""
    if at == _LOOK:
        kinds = {_FAULTS: RequestKind.FAULTS, _MEASURED: RequestKind.READ}
        kind = kinds.get(read_from or 0, RequestKind.STATUS)
        return Request(kind, unit, key)
    head = 1 if at in _TAGGED else 0
    if at in _OF_SENSORS:
        return Request(RequestKind.READ, unit, key)
    block, body = at + head, words[head:]
    match block:
        case 2:
            return _control(unit, key, body)
        case 10:
            return q.request_of(RequestKind.PING, unit, key, session=body[0])
        case 16:
            return _set(unit, key, body)
        case 182:
            return Request(RequestKind.ADDRESS, unit, key)
        case 102:
            return Request(RequestKind.ENVELOPE, unit, key, envelope=_envelope(body))
        case _:
            raise OutOfRange(f"register {at} cannot be written")


def _control(unit: int, key: object, body: list[int]) -> Request:
    if body[0] not in _WORDS:
        raise OutOfRange(f"controlword {body[0]}")
    kind = _WORDS[body[0]]
    watchdog, ramp, session = (body[1:4] + [250, 5, 0][len(body) - 1 :])[:3]
    if kind is RequestKind.ARM:
        return q.request_of(kind, unit, key, watchdog=watchdog, session=session)
    return q.request_of(kind, unit, key, ramp=ramp)


def _set(unit: int, key: object, body: list[int]) -> Request:
    if len(body) == 2:
        return q.request_of(RequestKind.COMMIT, unit, key, token=body[0], session=body[1])
    commit, session, token, ramp, valid_for = body[:5]
    if commit not in (0, token):
        raise OutOfRange(f"commit_token {commit} with token {token}")
    return q.request_of(
        RequestKind.APPLY if commit else RequestKind.STAGE,
        unit,
        key,
        token=token,
        ramp=ramp,
        valid_for=valid_for,
        session=session,
        commands=_channel_commands(body[5:]),
    )


def _channel_commands(words: Sequence[int]) -> dict[int, ChannelCommand]:
    if len(words) % 4 or len(words) > 64:
        raise OutOfRange(f"{len(words)} registers of channels")
    commands = {}
    for channel in range(len(words) // 4):
        frequency, level, phase, flags = words[4 * channel : 4 * channel + 4]
        if not (frequency or level or phase or flags):
            continue  # not named
        if flags & 0b1100:
            raise OutOfRange(f"flags {flags:#06x}")
        commands[channel] = q.command_of(
            frequency,
            level,
            signed(phase),
            flags,
            onset=flags >> 4 & 0x3F,
            ending=flags >> 10 & 0x3F,
        )
    return commands


def _envelope(body: list[int]) -> EnvelopeLoad:
    slot, step, count = body[:3]
    return q.envelope_of(slot, step, count, body[3::2], [signed(phase) for phase in body[4::2]])


def _of_read(unit: int, pdu: bytes, request: _Open) -> Reply:
    """Decode a read; key None where it belongs to another write."""
    if request.read_from is None:
        return Reply(unit, request.key)
    words = struct.unpack(f">{pdu[1] // 2}H", pdu[2:])
    if len(words) != request.count:
        raise OutOfRange(f"{len(words)} registers, expected {request.count}")
    if request.read_from not in _READ_TAGS:
        return Reply(unit, request.key)
    constant = request.read_from in (_CAPABILITIES, _IDENTITY)
    if request.tag is not None and words[0] != request.tag and not constant:
        problem = f"tag {words[0]}, expected {request.tag}"
        # A damaged write is refused before its tag is stored: the refusal read then is that of an
        # earlier write, and matches this read all the same.
        is_earlier = request.read_from == _REFUSAL and words[3] != request.tag
        return Reply(unit, request.key if is_earlier else None, problem=problem)
    body = words[1:]
    if request.read_from == _STATUS:
        return Reply(unit, request.key, status=_decode_status(body))
    if request.read_from == _ACHIEVED:
        status = Status(q.STATE.whole(body[0]), q.FAULT.whole(body[1]))
        token = q.ACTIVE_TOKEN.whole(body[2])
        commands = _channel_commands(body[4:])
        return Reply(unit, request.key, status=status, token=token, achieved=commands)
    if request.read_from == _FAULTS:
        return Reply(unit, request.key, faults=faults_of_words(body))
    if constant:
        problem = _text_problem(body) if request.read_from == _IDENTITY else ""
        raw = struct.pack(f">{len(body)}H", *body)
        return Reply(unit, request.key, constant=raw, problem=problem)
    return Reply(unit, request.key)


def _text_problem(body: Sequence[int]) -> str:
    """Describe what is wrong with the texts behind the versions of an identity; "" if nothing."""
    for start in range(1, len(body), _TEXT_WORDS):
        words = body[start : start + _TEXT_WORDS]
        try:
            check_text(struct.pack(f">{len(words)}H", *words).rstrip(b"\0"))
        except OutOfRange as found:
            return f"identity: {found}"
    return ""


def _decode_status(body: Sequence[int]) -> Status:
    state, fault, token, flags, _, temperature, left, _, count = body[:9]
    return q.status_of(
        state,
        fault,
        token,
        left=left,
        high_voltage=bool(flags & 1),
        temperature=signed(temperature),
        levels=body[9 : 9 + count],
    )
