"""Decoder for the serial wire, from docs/reference/wire-protocol.md: COBS, CRC-32, messages."""

import struct
import zlib
from collections import deque
from dataclasses import replace

from sim.witness import quantities as q
from sim.witness.capture import Direction
from sim.witness.decoded import (
    REPLY_TO_DAMAGED_FRAME,
    SETS,
    ChannelCommand,
    Damaged,
    DecodedFrame,
    EnvelopeLoad,
    Message,
    Reply,
    Request,
    RequestKind,
    StateEvent,
    Status,
)
from sim.witness.quantities import INVALID, OutOfRange
from sim.witness.reports import check_identity, unpack_faults

_KINDS = {
    1: RequestKind.HELLO,
    2: RequestKind.CAPABILITIES,
    3: RequestKind.ARM,
    4: RequestKind.DISARM,
    5: RequestKind.STAGE,
    6: RequestKind.COMMIT,
    7: RequestKind.APPLY,
    8: RequestKind.STOP,
    9: RequestKind.STATUS,
    10: RequestKind.FAULTS,
    11: RequestKind.CLEAR,
    12: RequestKind.PING,
    13: RequestKind.ENVELOPE,
    14: RequestKind.READ,
    15: RequestKind.ADDRESS,
    **dict.fromkeys((16, 17, 18, 19), RequestKind.READ),  # of sensors: nothing that plays
}
_EVENT, _NAK = 30, 31
_VOICES_AT = 27  # in capabilities
_MAX_LENGTH = 249  # bytes of a frame
_DAMAGED = 16  # damaged requests kept, to recognise replies to them
_SIZES = {  # of the payload
    RequestKind.ARM: 4,
    RequestKind.DISARM: 2,
    RequestKind.COMMIT: 4,
    RequestKind.STOP: 2,
    RequestKind.CLEAR: 1,
    RequestKind.PING: 2,
}
_MEASURE = 17
_READ_SIZES = {16: 1, _MEASURE: 5, 18: 1, 19: 5}
_HELLO, _NEUTRAL, _VERSION = 1, 0, 2
_WITH_STATUS = {
    RequestKind.ARM,
    RequestKind.DISARM,
    RequestKind.STOP,
    RequestKind.STATUS,
    RequestKind.CLEAR,
    RequestKind.PING,
}


class SerialDecoder:
    """Decodes both directions."""

    def __init__(self) -> None:
        self._rest: dict[Direction, bytes] = {"amplifier": b"", "host": b""}
        self._damaged: deque[int] = deque(maxlen=_DAMAGED)

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = (self._rest[direction] + data).split(b"\0")
        self._rest[direction] = rest[-2 * _MAX_LENGTH :]
        return [(b"\0" + one + b"\0", self._decode(direction, one)) for one in pieces if one]

    def has_partial_frame(self, direction: Direction) -> bool:
        """Whether the last bytes in this direction begin a frame."""
        return bool(self._rest[direction])

    def _decode(self, direction: Direction, piece: bytes) -> Message:
        message = _decode(direction, piece)
        if direction == "amplifier":
            content = _cobs_decode(piece) or b""
            sequence = int.from_bytes(content[3:5], "little")
            if isinstance(message, Damaged):
                self._damaged.append(sequence)
            elif sequence in self._damaged:
                self._damaged.remove(sequence)
        elif isinstance(message, Reply) and _sequence(message) in self._damaged:
            return replace(message, key=None, problem=REPLY_TO_DAMAGED_FRAME)
        return message


def _decode(direction: Direction, piece: bytes) -> Message:
    body = _cobs_decode(piece)
    if body is None or len(body) < 9:
        return Damaged("a frame of invalid COBS or length")
    content, crc = body[:-4], int.from_bytes(body[-4:], "little")
    if zlib.crc32(content) != crc:
        return Damaged("a wrong CRC")
    first, version, address, sequence = struct.unpack_from("<BBBH", content)
    number, payload = first & 0x7F, content[5:]
    if version != (_NEUTRAL if number == _HELLO else _VERSION) and not (
        number == _NAK and version == _NEUTRAL  # of a Hello, or of another version
    ):
        return Damaged(f"protocol version {version}")
    if bool(first & 0x80) != (direction == "host"):
        return Damaged("a frame of the wrong direction")
    try:
        if direction == "amplifier":
            return _decode_request(number, address, sequence, payload)
        return _decode_reply(number, address, sequence, payload)
    except INVALID as problem:
        if direction == "amplifier":
            kind = _KINDS.get(number, RequestKind.READ)
            return Request(kind, address, (sequence, kind), problem=str(problem) or "too short")
        return Damaged(f"an invalid payload: {problem}")


def _sequence(reply: Reply) -> object:
    return reply.key[0] if isinstance(reply.key, tuple) else None


def _cobs_decode(piece: bytes) -> bytes | None:
    """Decode COBS; None where it is invalid."""
    if len(piece) > _MAX_LENGTH:
        return None
    found = bytearray()
    at = 0
    while at < len(piece):
        length = piece[at]
        block = piece[at + 1 : at + length]
        if len(block) != length - 1:
            return None
        found += block
        at += length
        if length < 255 and at < len(piece):
            found.append(0)
    return bytes(found)


def _decode_request(number: int, address: int, sequence: int, payload: bytes) -> Request:
    if number not in _KINDS:
        raise OutOfRange(f"unknown message type {number}")
    kind = _KINDS[number]
    key = None if address == 0 else (sequence, kind)
    if kind in (RequestKind.STAGE, RequestKind.APPLY):
        session, token, ramp, valid_for = struct.unpack_from("<HHHH", payload)
        return q.request_of(
            kind,
            address,
            key,
            token=token,
            ramp=ramp,
            valid_for=valid_for,
            session=session,
            commands=_channel_commands(payload[8:]),
        )
    if kind is RequestKind.ENVELOPE:
        return Request(kind, address, key, envelope=_envelope(payload))
    if kind in (RequestKind.HELLO, RequestKind.ADDRESS):
        return Request(kind, address, key)
    tones = payload[4] if number == _MEASURE and len(payload) > 4 else 0
    size = _READ_SIZES.get(number, _SIZES.get(kind, 0)) + 2 * tones
    if len(payload) != size:
        raise OutOfRange(f"{kind.value} payload must have {size} bytes, got {len(payload)}")
    first = int.from_bytes(payload[:2], "little")
    second = int.from_bytes(payload[2:], "little")
    match kind:
        case RequestKind.READ:
            return Request(kind, address, key)
        case RequestKind.ARM:
            return q.request_of(kind, address, key, watchdog=first, session=second)
        case RequestKind.COMMIT:
            return q.request_of(kind, address, key, session=first, token=second)
        case RequestKind.PING:
            return q.request_of(kind, address, key, session=first)
        case RequestKind.CLEAR:
            return q.request_of(kind, address, key)
        case _:
            return q.request_of(kind, address, key, ramp=first)


def _channel_commands(data: bytes) -> dict[int, ChannelCommand]:
    count = q.CHANNEL_COUNT.whole(data[0])
    at, commands = 1, {}
    for _ in range(count):
        channel, flags, frequency, level, phase = struct.unpack_from("<BBHHh", data, at)
        at += 8
        onset = ending = 0
        if flags & 4:
            onset, ending = struct.unpack_from("<BB", data, at)
            at += 2
        if flags & ~7 or channel in commands:
            raise OutOfRange(f"flags {flags:#04x}, or channel {channel} named twice")
        commands[q.CHANNEL.whole(channel)] = q.command_of(
            frequency, level, phase, flags, onset=onset, ending=ending
        )
    if at != len(data):
        raise OutOfRange(f"{len(data) - at} excess bytes")
    return commands


def _envelope(payload: bytes) -> EnvelopeLoad:
    slot, step, count = struct.unpack_from("<BHB", payload)
    knots = list(struct.iter_unpack("<Hh", payload[4:]))
    levels, phases = zip(*knots, strict=True) if knots else ((), ())
    return q.envelope_of(slot, step, count, levels, phases)


def _decode_reply(number: int, address: int, sequence: int, payload: bytes) -> Message:
    if number == _EVENT:
        state, fault, _ = struct.unpack_from("<BBB", payload)
        return StateEvent(address, q.STATE.whole(state), q.FAULT.whole(fault))
    if number == _NAK:
        refused, code, _ = struct.unpack_from("<BBB", payload)
        return Reply(address, (sequence, _KINDS.get(refused)), refusal=code)
    kind = _KINDS.get(number)
    if kind in _WITH_STATUS:
        return Reply(address, (sequence, kind), status=_decode_status(payload))
    if kind in SETS:
        token = q.TOKEN.whole(int.from_bytes(payload[:2], "little"))
        return Reply(
            address, (sequence, kind), token=token, achieved=_channel_commands(payload[2:])
        )
    if kind is None:
        raise OutOfRange(f"unknown message type {number}")
    if kind in (RequestKind.HELLO, RequestKind.CAPABILITIES):
        return _decode_constant(address, (sequence, kind), payload)
    faults = unpack_faults(payload) if kind is RequestKind.FAULTS else None
    return Reply(address, (sequence, kind), faults=faults)


def _decode_constant(address: int, key: tuple[int, RequestKind], payload: bytes) -> Reply:
    """Decode an identity or capabilities."""
    problem = ""
    if key[1] is RequestKind.HELLO:
        try:
            check_identity(payload)
        except OutOfRange as found:
            problem = f"identity: {found}"
    voices = payload[_VOICES_AT] if key[1] is RequestKind.CAPABILITIES else 0
    return Reply(address, key, constant=payload, voices=voices, problem=problem)


def _decode_status(payload: bytes) -> Status:
    state, fault, token, flags, temperature, left, _, _, count = struct.unpack_from(
        "<BBHBhHHBB", payload
    )
    levels = struct.unpack_from(f"<{count}H", payload, 13)
    return q.status_of(
        state,
        fault,
        token,
        left=left,
        high_voltage=bool(flags & 1),
        temperature=temperature,
        levels=levels,
    )
