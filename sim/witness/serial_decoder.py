"""The serial wire, from docs/reference/wire-protocol.md: COBS between zeros, CRC-32, messages."""

import struct
import zlib
from collections import deque
from dataclasses import replace

from sim.witness import quantities as q
from sim.witness.quantities import OutOfRange, value, whole
from sim.witness.seen import (
    ANSWERS_DAMAGE,
    Answered,
    Asked,
    Condition,
    Damaged,
    Decoded,
    Drive,
    Kind,
    Meaning,
    Shape,
    Told,
    Toward,
)

_KINDS = {
    1: Kind.HELLO,
    2: Kind.CAPABILITIES,
    3: Kind.ARM,
    4: Kind.DISARM,
    5: Kind.STAGE,
    6: Kind.COMMIT,
    7: Kind.APPLY,
    8: Kind.STOP,
    9: Kind.STATUS,
    10: Kind.FAULTS,
    11: Kind.CLEAR,
    12: Kind.PING,
    13: Kind.ENVELOPE,
}
_EVENT, _NAK = 30, 31
_LONGEST = 249  # bytes between two zeros
_DAMAGED = 16  # frames that are remembered, lest one of them is answered
_STATUS_OF = {Kind.ARM, Kind.DISARM, Kind.STOP, Kind.STATUS, Kind.CLEAR, Kind.PING}
_SET_OF = {Kind.STAGE, Kind.COMMIT, Kind.APPLY}


class SerialDecoder:
    """Bytes both ways to meanings; any bytes may come."""

    def __init__(self) -> None:
        self._rest: dict[Toward, bytes] = {"amplifier": b"", "host": b""}
        self._damaged: deque[int] = deque(maxlen=_DAMAGED)

    def feed(self, toward: Toward, time: float, data: bytes) -> list[Decoded]:
        """What these bytes complete."""
        *pieces, rest = (self._rest[toward] + data).split(b"\0")
        self._rest[toward] = rest[-2 * _LONGEST :]
        return [(b"\0" + one + b"\0", self._meaning(toward, one)) for one in pieces if one]

    def is_amid(self, toward: Toward) -> bool:
        """Whether the last bytes that went this way have begun what others may complete."""
        return bool(self._rest[toward])

    def _meaning(self, toward: Toward, piece: bytes) -> Meaning:
        meaning = _meaning(toward, piece)
        if toward == "amplifier":
            content = _unstuffed(piece) or b""
            sequence = int.from_bytes(content[2:4], "little")
            if isinstance(meaning, Damaged):
                self._damaged.append(sequence)
            elif sequence in self._damaged:
                self._damaged.remove(sequence)
        elif isinstance(meaning, Answered) and _sequence(meaning) in self._damaged:
            return replace(meaning, key=None, problem=ANSWERS_DAMAGE)
        return meaning


def _meaning(toward: Toward, piece: bytes) -> Meaning:
    body = _unstuffed(piece)
    if body is None or len(body) < 8:
        return Damaged("no frame: it cannot be unstuffed, or is too short or too long")
    content, crc = body[:-4], int.from_bytes(body[-4:], "little")
    if zlib.crc32(content) != crc:
        return Damaged("the CRC is wrong")
    first, address, sequence = struct.unpack_from("<BBH", content)
    payload = content[4:]
    if first >> 5 & 3 != 1:
        return Damaged(f"version {first >> 5 & 3} of the protocol")
    if bool(first & 0x80) != (toward == "host"):
        return Damaged("a reply from the host, or a request from an amplifier")
    try:
        if toward == "amplifier":
            return _asked(first & 0x1F, address, sequence, payload)
        return _said(first & 0x1F, address, sequence, payload)
    except (OutOfRange, struct.error, IndexError) as problem:
        if toward == "amplifier":
            kind = _KINDS.get(first & 0x1F, Kind.LOOK)
            return Asked(kind, address, (sequence, kind), problem=str(problem) or "too short")
        return Damaged(f"a payload that makes no message: {problem}")


def _sequence(answer: Answered) -> object:
    return answer.key[0] if isinstance(answer.key, tuple) else None


def _unstuffed(piece: bytes) -> bytes | None:
    """COBS undone: each block begins with its length, and a zero stands between two."""
    if len(piece) > _LONGEST:
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


def _asked(number: int, address: int, sequence: int, payload: bytes) -> Asked:
    if number not in _KINDS:
        raise OutOfRange(f"there is no message of type {number}")
    kind = _KINDS[number]
    key = None if address == 0 else (sequence, kind)
    size = {Kind.ARM: 2, Kind.DISARM: 2, Kind.COMMIT: 2, Kind.STOP: 2}.get(kind, 0)
    if kind in (Kind.STAGE, Kind.APPLY):
        token, ramp, valid_for, drives = _set(payload)
        return Asked(kind, address, key, token=token, ramp=ramp, valid_for=valid_for, drives=drives)
    if kind is Kind.ENVELOPE:
        return Asked(kind, address, key, shape=_shape(payload))
    if len(payload) != size:
        raise OutOfRange(f"{kind.value} has {len(payload)} bytes of payload instead of {size}")
    number = int.from_bytes(payload, "little")
    match kind:
        case Kind.ARM:
            return Asked(kind, address, key, watchdog=value(q.WATCHDOG, number, "watchdog"))
        case Kind.DISARM | Kind.STOP:
            return Asked(kind, address, key, ramp=value(q.RAMP, number, "ramp"))
        case Kind.COMMIT:
            return Asked(kind, address, key, token=whole(q.TOKEN, number, "token"))
        case _:
            return Asked(kind, address, key)


def _set(payload: bytes) -> tuple[int, float, float, dict[int, Drive]]:
    token, ramp, valid_for = struct.unpack_from("<HHH", payload)
    drives = _drives(payload[6:])
    return (
        whole(q.TOKEN, token, "token"),
        value(q.RAMP, ramp, "ramp"),
        value(q.VALID_FOR, valid_for, "valid_for"),
        drives,
    )


def _drives(data: bytes) -> dict[int, Drive]:
    count = whole(q.CHANNEL_COUNT, data[0], "channel_count")
    at, drives = 1, {}
    for _ in range(count):
        channel, flags, frequency, level, phase = struct.unpack_from("<BBHHh", data, at)
        at += 8
        onset = ending = 0
        if flags & 4:
            onset, ending = struct.unpack_from("<BB", data, at)
            at += 2
        if flags & ~7 or channel in drives:
            raise OutOfRange(f"flags {flags:#04x}, or channel {channel} named twice")
        drives[whole(q.CHANNEL, channel, "channel")] = Drive(
            value(q.FREQUENCY, frequency, "frequency"),
            value(q.LEVEL, level, "level"),
            value(q.PHASE, phase, "phase"),
            keep_phase=bool(flags & 1),
            skip_ending=bool(flags & 2),
            onset=whole(q.SLOT, onset, "onset"),
            ending=whole(q.SLOT, ending, "ending"),
        )
    if at != len(data):
        raise OutOfRange(f"{len(data) - at} bytes too many")
    return drives


def _shape(payload: bytes) -> Shape:
    slot, step, count = struct.unpack_from("<BHB", payload)
    knots = [struct.unpack_from("<Hh", payload, 4 + 4 * number) for number in range(count)]
    if len(payload) != 4 + 4 * count:
        raise OutOfRange("an envelope of another length than its knots")
    whole(q.KNOTS, count, "envelope_knots")
    for _, phase in knots:
        value(q.PHASE, phase, "phase of a knot")
    return Shape(
        whole(q.SLOT, slot, "envelope_slot"),
        value(q.STEP, step, "envelope_step"),
        tuple(value(q.LEVEL, level, "level of a knot") for level, _ in knots),
    )


def _said(number: int, address: int, sequence: int, payload: bytes) -> Meaning:
    if number == _EVENT:
        state, fault, _ = struct.unpack("<BBB", payload)
        return Told(address, whole(q.STATE, state, "state"), whole(q.FAULT, fault, "fault"))
    if number == _NAK:
        refused, code, _ = struct.unpack("<BBB", payload)
        return Answered(address, (sequence, _KINDS.get(refused)), refusal=code)
    kind = _KINDS.get(number)
    if kind in _STATUS_OF:
        return Answered(address, (sequence, kind), condition=_condition(payload))
    if kind in _SET_OF:
        token = whole(q.TOKEN, int.from_bytes(payload[:2], "little"), "token")
        return Answered(address, (sequence, kind), token=token, achieved=_drives(payload[2:]))
    if kind is None:
        raise OutOfRange(f"there is no message of type {number}")
    return Answered(address, (sequence, kind))


def _condition(payload: bytes) -> Condition:
    state, fault, token, flags, temperature, left, _, count = struct.unpack_from(
        "<BBHBhHHB", payload
    )
    levels = struct.unpack_from(f"<{count}H", payload, 12)
    if len(payload) != 12 + 2 * count or flags & ~1:
        raise OutOfRange("a status of another length than its channels, or with unknown flags")
    return Condition(
        state=whole(q.STATE, state, "state"),
        fault=whole(q.FAULT, fault, "fault"),
        token=token,
        watchdog_left=value(q.WATCHDOG_LEFT, left, "watchdog_left"),
        high_voltage=bool(flags & 1),
        temperature=value(q.TEMPERATURE, temperature, "temperature"),
        levels=tuple(value(q.LEVEL, level, "level") for level in levels),
    )
