"""Modbus, from docs/reference/wire-modbus.md: registers written and read, and what they ask."""

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from sim.witness import quantities as q
from sim.witness.modbus_frames import RtuSplitter, Splitter, TcpSplitter, Telegram
from sim.witness.quantities import OutOfRange, signed, value, whole
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
    Toward,
)

_CONTROL, _HEARTBEAT, _LOOK, _SET, _ENVELOPE = 0, 8, 10, 14, 100
_STATUS, _REFUSAL, _CAPABILITIES, _IDENTITY, _ACHIEVED, _FAULTS = 1000, 1032, 1040, 1064, 1140, 1220
_WORDS = {15: Kind.ARM, 0: Kind.DISARM, 2: Kind.STOP, 128: Kind.CLEAR}
_READ_KINDS = {_IDENTITY: Kind.HELLO, _CAPABILITIES: Kind.CAPABILITIES, _FAULTS: Kind.FAULTS}
_TAGGED = (_CONTROL, _SET, _ENVELOPE)
_READ_TAGS = (*_TAGGED, _STATUS, _REFUSAL, _CAPABILITIES, _IDENTITY, _ACHIEVED, _FAULTS)


@dataclass(frozen=True, slots=True)
class _Open:
    """A telegram that waits for its answer, from the unit that was asked."""

    unit: int
    key: object
    function: int
    read_from: int | None
    count: int
    tag: int | None


class ModbusDecoder:
    """Bytes both ways to meanings, over TCP or RTU."""

    def __init__(self, *, over_tcp: bool) -> None:
        self._over_tcp = over_tcp
        self._split: dict[Toward, Splitter] = {
            "amplifier": TcpSplitter() if over_tcp else RtuSplitter("amplifier"),
            "host": TcpSplitter() if over_tcp else RtuSplitter("host"),
        }
        self._open: dict[int, _Open] = {}  # by transaction; over RTU there is one
        self._asked = 0
        self._is_damaged = False  # the last that the host sent
        self._tags: dict[int, int] = {}  # by unit, the last that was written

    def feed(self, toward: Toward, time: float, data: bytes) -> list[Decoded]:
        """What these bytes complete."""
        take = self._request if toward == "amplifier" else self._answer
        seen: list[Decoded] = []
        for one in self._split[toward].feed(time, data):
            if one.pdu is not None:
                seen.append((one.raw, take(one)))
                continue
            seen.append((one.raw, Damaged("no telegram, or a wrong CRC")))
            if toward == "amplifier" and not self._over_tcp:
                self._open.clear()
                self._is_damaged = True
        return seen

    def is_amid(self, toward: Toward) -> bool:
        """Whether the last bytes that went this way have begun what others may complete."""
        return self._split[toward].is_amid

    # what the host asks

    def _request(self, telegram: Telegram) -> Meaning:
        pdu = telegram.pdu or b""
        self._is_damaged = False
        self._asked += 1
        key = None if telegram.unit == 0 else (telegram.unit, self._asked)
        try:
            return self._asked_by(telegram, pdu, key)
        except (OutOfRange, struct.error, IndexError) as problem:
            self._remember(telegram, _Open(telegram.unit, key, pdu[0], None, 0, None))
            return Asked(Kind.LOOK, telegram.unit, key, problem=str(problem) or "too short")

    def _asked_by(self, telegram: Telegram, pdu: bytes, key: object) -> Meaning:
        function, body = pdu[0], pdu[1:]
        read: tuple[int, int] | None = None
        written: tuple[int, list[int]] | None = None
        match function:
            case 3 | 4:
                read = struct.unpack(">HH", body)
            case 6:
                at, word = struct.unpack(">HH", body)
                written = at, [word]
            case 16:
                written = _written(body)
            case 23:
                read = struct.unpack_from(">HH", body)
                written = _written(body[4:])
            case 43:
                pass
            case _:
                raise OutOfRange(f"function {function}")
        tag = None
        if written is not None:
            tag = self._tag(telegram.unit, *written)
        expected = tag if tag is not None else self._tags.get(telegram.unit)
        at, count = read or (None, 0)
        self._remember(telegram, _Open(telegram.unit, key, function, at, count, expected))
        if written is not None:
            return _of_write(telegram.unit, key, *written, read_from=at)
        kind = _READ_KINDS.get(at or 0, Kind.LOOK)
        return Asked(kind, telegram.unit, key)

    def _remember(self, telegram: Telegram, asked: _Open) -> None:
        if telegram.unit == 0:
            return
        if not self._over_tcp:
            self._open.clear()
        self._open[telegram.number] = asked

    def _tag(self, unit: int, at: int, words: Sequence[int]) -> int | None:
        """The tag that a write carries, which is read back."""
        if at in (*_TAGGED, _HEARTBEAT, _LOOK):
            self._tags[unit] = words[0]
            if at in _TAGGED and words[1] not in (0, check(words[2:])):
                raise OutOfRange("the check of a block is wrong")
            return words[0]
        return None

    # what the amplifier answers

    def _answer(self, telegram: Telegram) -> Meaning:
        pdu = telegram.pdu or b""
        asked = self._open.get(telegram.number)
        if asked is None or (telegram.unit, pdu[0] & 0x7F) != (asked.unit, asked.function):
            problem = ANSWERS_DAMAGE if self._is_damaged else ""
            return Answered(telegram.unit, problem=problem)
        key = asked.key
        if pdu[0] & 0x80:
            del self._open[telegram.number]
            return Answered(telegram.unit, key, refusal=pdu[1])
        try:
            answer = _of_read(telegram.unit, pdu, asked)
        except (OutOfRange, struct.error, IndexError) as problem:
            return Damaged(f"an answer that makes no sense: {problem}")
        if answer.key is not None:
            del self._open[telegram.number]
        return answer


def check(words: Sequence[int]) -> int:
    """The check of a block: CRC-16, polynomial 1021, from FFFF; FFFF where that is 0."""
    return binascii.crc_hqx(struct.pack(f">{len(words)}H", *words), 0xFFFF) or 0xFFFF


def _written(body: bytes) -> tuple[int, list[int]]:
    at, count, size = struct.unpack_from(">HHB", body)
    words = list(struct.unpack(f">{count}H", body[5:]))
    if size != 2 * count:
        raise OutOfRange("a write of another length than it says")
    return at, words


def _of_write(unit: int, key: object, at: int, words: list[int], *, read_from: int | None) -> Asked:
    """What a write asks for."""
    if at == _HEARTBEAT:
        return Asked(Kind.PING, unit, key)
    if at == _LOOK:
        kind = Kind.FAULTS if read_from == _FAULTS else Kind.STATUS
        return Asked(kind, unit, key)
    head = 2 if at in _TAGGED else 0
    block, body = at + head, words[head:]
    match block:
        case 2:
            return _control(unit, key, body)
        case 16:
            return _set(unit, key, body)
        case 102:
            return Asked(Kind.ENVELOPE, unit, key, shape=_shape(body))
        case _:
            raise OutOfRange(f"register {at} is not written")


def _control(unit: int, key: object, body: list[int]) -> Asked:
    if body[0] not in _WORDS:
        raise OutOfRange(f"controlword {body[0]}")
    kind = _WORDS[body[0]]
    watchdog, ramp = (body[1:] + [250, 5][len(body) - 1 :])[:2]
    if kind is Kind.ARM:
        return Asked(kind, unit, key, watchdog=value(q.WATCHDOG, watchdog, "watchdog"))
    return Asked(kind, unit, key, ramp=value(q.RAMP, ramp, "ramp"))


def _set(unit: int, key: object, body: list[int]) -> Asked:
    if len(body) == 1:
        return Asked(Kind.COMMIT, unit, key, token=whole(q.TOKEN, body[0], "commit_token"))
    commit, token, ramp, valid_for = body[:4]
    if commit not in (0, token):
        raise OutOfRange(f"commit_token {commit} with token {token}")
    return Asked(
        Kind.APPLY if commit else Kind.STAGE,
        unit,
        key,
        token=whole(q.TOKEN, token, "token"),
        ramp=value(q.RAMP, ramp, "ramp"),
        valid_for=value(q.VALID_FOR, valid_for, "valid_for"),
        drives=_drives(body[4:]),
    )


def _drives(words: Sequence[int]) -> dict[int, Drive]:
    if len(words) % 4 or len(words) > 64:
        raise OutOfRange(f"{len(words)} registers of channels")
    drives = {}
    for channel in range(len(words) // 4):
        frequency, level, phase, flags = words[4 * channel : 4 * channel + 4]
        if not (frequency or level or phase or flags):
            continue  # not named
        if flags & 0b1100:
            raise OutOfRange(f"flags {flags:#06x}")
        drives[channel] = Drive(
            value(q.FREQUENCY, frequency, "frequency"),
            value(q.LEVEL, level, "level"),
            value(q.PHASE, signed(phase), "phase"),
            keep_phase=bool(flags & 1),
            skip_ending=bool(flags & 2),
            onset=flags >> 4 & 0x3F,
            ending=flags >> 10 & 0x3F,
        )
    return drives


def _shape(body: list[int]) -> Shape:
    slot, step, count = body[:3]
    knots = body[3:]
    if len(knots) != 2 * count:
        raise OutOfRange("an envelope of another length than its knots")
    whole(q.KNOTS, count, "envelope_knots")
    for phase in knots[1::2]:
        value(q.PHASE, signed(phase), "phase of a knot")
    return Shape(
        whole(q.SLOT, slot, "slot"),
        value(q.STEP, step, "step"),
        tuple(value(q.LEVEL, level, "level of a knot") for level in knots[::2]),
    )


def _of_read(unit: int, pdu: bytes, asked: _Open) -> Answered:
    """What the registers that were read say; key None where they answer another write."""
    if asked.read_from is None:
        return Answered(unit, asked.key)
    words = struct.unpack(f">{pdu[1] // 2}H", pdu[2:])
    if len(words) != asked.count:
        raise OutOfRange(f"{len(words)} registers instead of {asked.count}")
    if asked.read_from not in _READ_TAGS:
        return Answered(unit, asked.key)
    if words[1] not in (0, check(words[2:])):
        raise OutOfRange("the check of a block is wrong")
    constant = asked.read_from in (_CAPABILITIES, _IDENTITY)
    if asked.tag is not None and words[0] != asked.tag and not constant:
        problem = f"it carries tag {words[0]} instead of {asked.tag}"
        # A write that was damaged on its way is refused before its tag is read; the refusal that
        # is told then is an earlier write's, but it is what was asked for.
        is_earlier = asked.read_from == _REFUSAL and words[4] != asked.tag
        return Answered(unit, asked.key if is_earlier else None, problem=problem)
    body = words[2:]
    if asked.read_from == _STATUS:
        return Answered(unit, asked.key, condition=_condition(body))
    if asked.read_from == _ACHIEVED:
        condition = Condition(whole(q.STATE, body[0], "state"), whole(q.FAULT, body[1], "fault"))
        token = whole(q.ACTIVE_TOKEN, body[2], "token")
        drives = _drives(body[4:])
        return Answered(unit, asked.key, condition=condition, token=token, achieved=drives)
    return Answered(unit, asked.key)


def _condition(body: Sequence[int]) -> Condition:
    state, fault, token, high_voltage, _, temperature, left, count = body[:8]
    return Condition(
        state=whole(q.STATE, state, "state"),
        fault=whole(q.FAULT, fault, "fault"),
        token=token,
        watchdog_left=value(q.WATCHDOG_LEFT, left, "watchdog_left"),
        high_voltage=bool(high_voltage),
        temperature=value(q.TEMPERATURE, signed(temperature), "temperature"),
        levels=tuple(value(q.LEVEL, level, "level") for level in body[8 : 8 + count]),
    )
