"""Captures of wires, the witness's configuration, its violations, and messages as it decodes them.

A capture is text, a line for each piece of bytes:

    TIME WIRE > HEX        toward the amplifier
    TIME WIRE < HEX        toward the host

TIME is in seconds of any one clock; # begins a comment. The configuration (wires, amplifiers,
limits of channels, time limits) is independent of the controller's. Messages are alike for every
kind of wire; the decoder of serial lines is here, the others are in
`witness.decoders`.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

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
    REFUSALS,
    REQUEST_NAMES,
    STATES,
    STATUS,
    VERSION,
    decode_request,
)
from drivers.protocol.definition import HELLO as HELLO_NUMBER
from drivers.protocol.records import Record, Refusal, Values
from drivers.protocol.sets import is_last
from drivers.wires.serial_frames import NEUTRAL, FrameReader, words_of
from era_haptics.lab.expected_amplifier import FEEDING as FEEDING

TransferDirection: TypeAlias = Literal["amplifier", "host"]
"""Direction of transfer: toward the amplifier or the host."""
_ARROWS: dict[TransferDirection, str] = {"amplifier": ">", "host": "<"}


def capture_line(time: float, wire: str, direction: TransferDirection, data: bytes) -> str:
    """Return bytes as a line of a capture."""
    return f"{time:.6f} {wire} {_ARROWS[direction]} {data.hex(' ').upper()}"


ReportViolation: TypeAlias = Callable[[str, float, str], None]
"""Called with the rule, the time [s] and a sentence."""

_FRAMES_BEFORE, _FRAMES_AFTER = 6, 3
_MAX_VIOLATIONS = 200


@dataclass
class RuleViolation:
    """A broken rule: its name, wire, time [s], a sentence, and the frames around it."""

    invariant: str
    wire: str
    time_s: float
    sentence: str
    frames: list[str]

    def __str__(self) -> str:
        """The violation as a paragraph."""
        head = f"{self.time_s:.6f} {self.wire}: {self.invariant}: {self.sentence}"
        return "\n".join((head, *(f"    {frame}" for frame in self.frames)))


class WitnessReport:
    """Collects violations, at most 200: those `found`."""

    def __init__(self) -> None:
        self.found: list[RuleViolation] = []
        self._frames: dict[str, deque[str]] = {}  # by wire, the last
        self._followed: list[tuple[RuleViolation, int]] = []  # and how many frames they will have

    def frame(self, wire: str, time: float, direction: TransferDirection, raw: bytes) -> None:
        """Note a frame, and add it to the violations just before it."""
        line = capture_line(time, wire, direction, raw)
        self._frames.setdefault(wire, deque(maxlen=_FRAMES_BEFORE)).append(line)
        for violation, _ in self._followed:
            if violation.wire == wire:
                violation.frames.append(line)
        self._followed = [each for each in self._followed if len(each[0].frames) < each[1]]

    def add(self, wire: str, invariant: str, time: float, sentence: str) -> None:
        """Add a violation of a rule on a wire."""
        if len(self.found) < _MAX_VIOLATIONS:
            frames = [*self._frames.get(wire, ())]
            self.found.append(RuleViolation(invariant, wire, time, sentence, frames))
            self._followed.append((self.found[-1], len(frames) + _FRAMES_AFTER))


WireKind: TypeAlias = Literal["serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan"]


@dataclass(frozen=True)
class ChannelLimits:
    """Limits of one channel: frequencies [Hz], level 0..1, rise of the level [1/s]."""

    frequency: tuple[float, float]
    level: float
    slew: float = math.inf


@dataclass(frozen=True)
class TimeLimits:
    """Time limits [s].

    heartbeat: between frames that feed the watchdog; reply: to a reply; together: until all
    amplifiers have a set; slack: error of the witness's own clock.
    """

    heartbeat: float = 0.075
    reply: float = 0.030
    together: float = 0.020
    slack: float = 0.001


@dataclass(frozen=True)
class AmplifierConfig:
    """An amplifier: its wire, its address, unit or node there, and the limits of its channels."""

    wire: str
    address: int
    channels: Mapping[int, ChannelLimits]


@dataclass(frozen=True)
class WitnessConfig:
    """Kinds of wires and amplifiers, both by name, and time limits."""

    wires: Mapping[str, WireKind]
    amplifiers: Mapping[str, AmplifierConfig]
    times: TimeLimits = TimeLimits()


HELLO_REQUEST = "Hello"
A_READ = "a read"
"""Name of a read that is no message, and changes nothing."""
REPLIES = {HELLO_REQUEST: IDENTITY, **{name: message.reply for name, message in MESSAGES.items()}}
"""Records of replies by the name of the request."""
BROADCAST_REQUESTS = frozenset(name for name, message in MESSAGES.items() if message.is_broadcast)
"""Requests that may be for all amplifiers of a line."""
_WITH_STATE = (STATUS, EVENT_RECORD)


@dataclass(eq=False, slots=True)
class WitnessedRequest:
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
class WitnessedReply:
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
        self.rest: dict[TransferDirection, bytes] = {"amplifier": b"", "host": b""}

    @abstractmethod
    def feed(self, direction: TransferDirection, time: float, data: bytes) -> list["DecodedFrame"]:
        """Decode bytes; returns the complete frames."""


WitnessedMessage: TypeAlias = WitnessedRequest | WitnessedReply | Notice
DecodedFrame: TypeAlias = tuple[bytes, WitnessedMessage | None]
"""A frame and its message; None for part of a message, or none that concerns the rules."""


def damaged(why: str, started_at: float = math.inf) -> Notice:
    """Return what is said of bytes that form no message."""
    return Notice("damaged", text=why, started_at=started_at)


def witnessed_request(
    number: int,
    words: Sequence[int],
    address: int,
    key: Hashable,
    started_at: float = math.inf,
) -> WitnessedRequest:
    """Read a request by the number of its message."""
    name, values = REQUEST_NAMES.get(number, f"type {number}"), Values()
    problem = "" if address or name in BROADCAST_REQUESTS else "must not be a broadcast"
    try:
        if number != HELLO_NUMBER:
            _, values = decode_request(number, words)
    except Refusal as refusal:
        problem = str(refusal)
    return WitnessedRequest(name, address, key, values, problem, started_at)


def reply_of(record: Record, words: Sequence[int], address: int, key: Hashable) -> WitnessedReply:
    """Read what an amplifier sends: the record of a reply, a refusal or an Event."""
    try:
        values = record.unpack(words, is_strict=False)
    except Refusal as refusal:
        return WitnessedReply(address, key, problem=str(refusal))
    problem = ""
    for name, known in (("state", STATES), ("fault", FAULTS)) if record in _WITH_STATE else ():
        if values[name] not in known.values():
            problem = f"{name} must be 0 to {max(known.values())}, got {values[name]}"
    return WitnessedReply(
        address, key, values, values["code"] if record is NAK_RECORD else 0, problem
    )


def sent_by_amplifier(
    number: int, words: Sequence[int], address: int, sequence: int
) -> WitnessedReply | Notice:
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
    if number not in REQUEST_NAMES:
        return damaged(f"a reply of unknown type {number}")
    return reply_of(REPLIES[REQUEST_NAMES[number]], words, address, (address, sequence, number))


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


def is_carried_out(request: WitnessedRequest, status: Values) -> bool:
    """Whether a later status shows that a request was carried out."""
    return bool(_CARRIED_OUT[request.name](request.values, status))


_MAX_REST = 512  # bytes kept of a frame that does not end


class SerialDecoder(Decoder):
    """Decodes frames between zero bytes."""

    def feed(self, direction: TransferDirection, time: float, data: bytes) -> list[DecodedFrame]:
        """Decode bytes; returns the complete frames."""
        *pieces, rest = (self.rest[direction] + data).split(b"\0")
        self.rest[direction] = rest[-_MAX_REST:]
        return [(b"\0" + one + b"\0", _decode(direction, one)) for one in pieces if one]


def _decode(direction: TransferDirection, piece: bytes) -> WitnessedMessage:
    frames = FrameReader().feed(piece + b"\0")
    if not frames:
        return damaged("a frame of invalid length or checksum")
    (frame,) = frames
    if frame.is_reply != (direction == "host") and frame.type != EVENT:
        return damaged("a frame of the wrong direction")
    key = (frame.address, frame.sequence, frame.type) if frame.address else None
    version = NEUTRAL if frame.type == HELLO_NUMBER else VERSION
    is_other = frame.version != version
    try:
        words = words_of(frame)
    except Refusal as refusal:
        if direction == "amplifier":
            return WitnessedRequest(f"type {frame.type}", frame.address, key, problem=str(refusal))
        return WitnessedReply(frame.address, key, problem=str(refusal))
    if direction == "amplifier":
        request = witnessed_request(frame.type, words, frame.address, key)
        # One of another version has its reply, too: the identity, or a refusal.
        wrong = f"version must be {version}, got {frame.version}" if is_other else ""
        return replace(request, problem=wrong or request.problem)
    message = sent_by_amplifier(frame.type, words, frame.address, frame.sequence)
    if is_other and getattr(message, "refusal", 0) != REFUSALS["UNSUPPORTED_VERSION"]:
        return damaged(f"protocol version {frame.version}")
    return message
