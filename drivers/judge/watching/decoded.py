"""Messages as they are decoded and sent, alike for every kind of wire; those of a serial line."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from drivers.judge.watching.capture import Direction
from drivers.protocol.definition import (
    ENABLED,
    EVENT,
    EVENT_RECORD,
    FAULTS,
    IDENTITY,
    LATCHED,
    MESSAGES,
    NAK,
    NAK_RECORD,
    NAMES,
    REFUSALS,
    STATES,
    STATUS,
    VERSION,
    read_request,
)
from drivers.protocol.definition import HELLO as HELLO_NUMBER
from drivers.protocol.records import Record, Refusal, Values
from drivers.protocol.sets import is_last
from drivers.wires.serial_frames import NEUTRAL, FrameReader, unpack_identity, unpack_words
from era_haptics.lab.expected_amplifier import FEEDING as FEEDING

HELLO = "Hello"
A_READ = "a read"
"""Name of a read that is no message, and changes nothing."""
REPLIES = {HELLO: IDENTITY, **{name: message.reply for name, message in MESSAGES.items()}}
"""Records of replies by the name of the request."""
BROADCAST = frozenset(name for name, message in MESSAGES.items() if message.is_broadcast)
"""Requests that may be for all amplifiers of a line."""
_WITH_STATE = (STATUS, EVENT_RECORD)


@dataclass(eq=False, slots=True)
class Request:
    """A request. address: 0 for broadcast; key: of its reply, None where there is none.

    values: of its record; problem: what is wrong with it, or ""; started_at: when its first byte
    passed, infinite where it has one frame, until that is known [s]. number: in the order of
    requests. since: from which on its amplifier has to respond, infinite while it is the host's
    turn; earliest, end: between which it is carried out, None for until its reply [s].
    is_given_up: whether the host has sent another behind it that need not wait for its reply, which
    a response that comes late does not undo.
    """

    name: str
    address: int
    key: Hashable = None
    values: Values = field(default_factory=dict)
    problem: str = ""
    started_at: float = math.inf
    number: int = 0
    since: float = math.inf
    earliest: float = math.inf
    end: float | None = None
    is_overdue: bool = False
    is_given_up: bool = False

    @property
    def has_reply(self) -> bool:
        """Whether it is replied to: all but a part of a set that is not the last."""
        return self.name != "Set" or bool(self.problem) or is_last(self.values)


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply. key: of its request, None where it matches none; values: None where it has none.

    refusal: code, 0 if granted; problem: what is wrong with it, or "".
    """

    address: int
    key: Hashable = None
    values: Values | None = None
    refusal: int = 0
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Notice:
    """What is neither: part of an exchange, a change, or what cannot be read.

    carried out: the amplifier has carried the request of a key out; read on: the host goes on with
    it. event: unasked, with the values of its record. boot: an amplifier has started, or a master
    has reset it. other host: its request, by name. damaged: invalid bytes, and why.
    started_at: when the first of its frames passed, infinite where it is one [s].
    """

    what: Literal["carried out", "read on", "event", "boot", "other host", "damaged"]
    address: int = 0
    key: Hashable = None
    values: Values = field(default_factory=dict)
    text: str = ""
    started_at: float = math.inf


class Decoder(ABC):
    """Decodes both directions of a kind of wire; rest: bytes that begin a frame."""

    def __init__(self) -> None:
        self.rest: dict[Direction, bytes] = {"amplifier": b"", "host": b""}

    @abstractmethod
    def feed(self, direction: Direction, time: float, data: bytes) -> list["DecodedFrame"]:
        """Decode bytes; returns the complete frames."""


Message: TypeAlias = Request | Reply | Notice
DecodedFrame: TypeAlias = tuple[bytes, Message | None]
"""A frame and its message; None for part of a message, or none that concerns the rules."""


def damaged(why: str, started_at: float = math.inf) -> Notice:
    """Return what is said of bytes that form no message."""
    return Notice("damaged", text=why, started_at=started_at)


def request_of(
    number: int,
    words: Sequence[int],
    address: int,
    key: Hashable,
    started_at: float = math.inf,
) -> Request:
    """Read a request by the number of its message."""
    name, values = NAMES.get(number, f"type {number}"), Values()
    problem = "" if address or name in BROADCAST else "must not be a broadcast"
    try:
        if number != HELLO_NUMBER:
            _, values = read_request(number, words)
    except Refusal as refusal:
        problem = str(refusal)
    return Request(name, address, key, values, problem, started_at)


def reply_of(record: Record, words: Sequence[int], address: int, key: Hashable) -> Reply:
    """Read what an amplifier sends: the record of a reply, a refusal or an Event."""
    try:
        values = record.unpack(words, is_strict=False)
    except Refusal as refusal:
        return Reply(address, key, problem=str(refusal))
    problem = ""
    for name, known in (("state", STATES), ("fault", FAULTS)) if record in _WITH_STATE else ():
        if values[name] not in known.values():
            problem = f"{name} must be 0 to {max(known.values())}, got {values[name]}"
    return Reply(address, key, values, values["code"] if record is NAK_RECORD else 0, problem)


def sent_by_amplifier(
    number: int, words: Sequence[int], address: int, sequence: int
) -> Reply | Notice:
    """Read a message that an amplifier sends by its number; sequence: 0 for an Event on CAN."""
    if number == EVENT:
        event = reply_of(EVENT_RECORD, words, address, None)
        if event.problem or event.values is None:
            return damaged(f"an invalid Event: {event.problem}")
        return Notice("event", address, values=event.values)
    if number == NAK:
        return reply_of(
            NAK_RECORD,
            words,
            address,
            (address, sequence, *words[: NAK_RECORD.places["request"] + 1]),
        )
    if number not in NAMES:
        return damaged(f"a reply of unknown type {number}")
    return reply_of(REPLIES[NAMES[number]], words, address, (address, sequence, number))


_CARRIED_OUT: dict[str, Callable[[Values, Values], bool]] = {
    "Arm": lambda values, status: status["state"] == ENABLED,
    "Disarm": lambda values, status: status["state"] != ENABLED,
    "Set": lambda values, status: values["now"] and status["token"] == values["token"],
    "Commit": lambda values, status: status["token"] == values["token"],
    "Silence": lambda values, status: not any(status["tokens"]),
    "Stop": lambda values, status: status["state"] in LATCHED,
    "Clear": lambda values, status: True,
}
CHANGING = frozenset(_CARRIED_OUT)
"""Requests that change what the amplifier does."""


def is_carried_out(request: Request, status: Values) -> bool:
    """Whether a later status shows that a request was carried out."""
    return bool(_CARRIED_OUT[request.name](request.values, status))


_MAX_REST = 512  # bytes kept of a frame that does not end


class SerialDecoder(Decoder):
    """Decodes frames between zero bytes."""

    def feed(self, direction: Direction, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = (self.rest[direction] + data).split(b"\0")
        self.rest[direction] = rest[-_MAX_REST:]
        return [(b"\0" + one + b"\0", _decode(direction, one)) for one in pieces if one]


def _decode(direction: Direction, piece: bytes) -> Message:
    frames = FrameReader().feed(piece + b"\0")
    if not frames:
        return damaged("a frame of invalid length or checksum")
    (frame,) = frames
    if frame.is_reply != (direction == "host") and frame.type != EVENT:
        return damaged("a frame of the wrong direction")
    key = (frame.address, frame.sequence, frame.type) if frame.address else None
    is_hello = frame.type == HELLO_NUMBER
    version = NEUTRAL if is_hello else VERSION
    is_other = frame.version != version
    try:
        words = () if is_hello else unpack_words(frame.payload)
        if direction == "amplifier":
            request = request_of(frame.type, words, frame.address, key)
            # One of another version has its reply, too: the identity, or a refusal.
            wrong = f"version must be {version}, got {frame.version}" if is_other else ""
            return replace(request, problem=wrong or request.problem)
        if is_hello:
            message: Message = Reply(frame.address, key, unpack_identity(frame.payload))
        else:
            message = sent_by_amplifier(frame.type, words, frame.address, frame.sequence)
    except Refusal as refusal:
        if direction == "amplifier":
            return Request(f"type {frame.type}", frame.address, key, problem=str(refusal))
        return Reply(frame.address, key, problem=str(refusal))
    if is_other and getattr(message, "refusal", 0) != REFUSALS["UNSUPPORTED_VERSION"]:
        return damaged(f"protocol version {frame.version}")
    return message
