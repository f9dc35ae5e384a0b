"""Decoded messages, the same for every kind of wire."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import (
    BY_NUMBER,
    EVENT_RECORD,
    FAULTS,
    IDENTITY,
    MESSAGES,
    NAK_RECORD,
    STATES,
    read_request,
)

HELLO = "Hello"
A_READ = "a read"
"""Name of a read that is no message, and changes nothing."""
STATUS_RECORD = MESSAGES["GetStatus"].reply
CHANGING = frozenset({"Arm", "Disarm", "Set", "Commit", "Silence", "Stop", "Clear"})
"""Requests that change what the amplifier does."""
BROADCAST = frozenset(name for name, message in MESSAGES.items() if message.is_broadcast)
"""Requests that may be for all amplifiers of a line."""
FEEDING = frozenset(name for name, message in MESSAGES.items() if message.feeds)
"""Requests that feed the watchdog unless they are refused."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request. address: 0 for broadcast; key: of its reply, None where there is none.

    values: of its record; problem: what is wrong with it, or ""; begun: when the first of its
    frames passed, None where it has one [s].
    """

    name: str
    address: int
    key: Hashable = None
    values: Values = field(default_factory=dict)
    problem: str = ""
    begun: float | None = None


@dataclass(frozen=True, slots=True)
class Progress:
    """Part of an exchange: the amplifier has carried the request out, or the host goes on."""

    key: Hashable
    is_from_host: bool


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
class Event:
    """An unsolicited change of state: values of its record."""

    address: int
    values: Values


@dataclass(frozen=True, slots=True)
class BootUp:
    """An amplifier has started, or a master has reset it."""

    address: int


@dataclass(frozen=True, slots=True)
class OtherHost:
    """A request of another host to an amplifier, by its name."""

    address: int
    name: str


@dataclass(frozen=True, slots=True)
class Damaged:
    """Bytes that form no frame, or a frame that decodes to no message."""

    reason: str


Message: TypeAlias = Request | Progress | Reply | Event | BootUp | OtherHost | Damaged
DecodedFrame: TypeAlias = tuple[bytes, Message | None]
"""A frame and its message; None for part of a message, or none that concerns the rules."""


def request_of(number: int, words: Sequence[int], address: int, key: Hashable) -> Request:
    """Read a request by the number of its message."""
    name = BY_NUMBER[number].name if number in BY_NUMBER else f"type {number}"
    try:
        _, values = read_request(number, words)
    except Refusal as refusal:
        return Request(name, address, key, problem=str(refusal))
    problem = "" if address or name in BROADCAST else "must not be a broadcast"
    return Request(name, address, key, values, problem)


def reply_of(name: str, words: Sequence[int], address: int, key: Hashable) -> Reply:
    """Read the reply to a request of this name."""
    record = IDENTITY if name == HELLO else MESSAGES[name].reply
    try:
        values = record.unpack(words, is_strict=False)
    except Refusal as refusal:
        return Reply(address, key, problem=str(refusal))
    problem = state_problem(values) if record is STATUS_RECORD else ""
    return Reply(address, key, values, problem=problem)


def nak_of(words: Sequence[int], address: int, key: Hashable) -> Reply:
    """Read a refusal."""
    try:
        values = NAK_RECORD.unpack(words, is_strict=False)
    except Refusal as refusal:
        return Reply(address, key, problem=str(refusal))
    return Reply(address, key, refusal=values["code"])


def event_of(words: Sequence[int], address: int) -> Event | Damaged:
    """Read an Event."""
    try:
        values = EVENT_RECORD.unpack(words, is_strict=False)
    except Refusal as refusal:
        return Damaged(f"an invalid Event: {refusal}")
    problem = state_problem(values)
    return Damaged(f"an invalid Event: {problem}") if problem else Event(address, values)


def state_problem(values: Values) -> str:
    """Describe a state or fault that is none; "" if both are known."""
    for name, known in (("state", STATES), ("fault", FAULTS)):
        if values[name] not in known.values():
            return f"{name} must be 0 to {max(known.values())}, got {values[name]}"
    return ""
