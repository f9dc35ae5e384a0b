"""Protocol 4 as data: quantities, messages, clock and times, each once, for every wire and end.

`records` turns messages into 16-bit words and back; a wire adds its frame. The meaning of messages
is defined in docs/reference/protocol.md.

The clock of an amplifier has 32 bits, which go round once in 20 s. A voice of frequency word n has
the angle n times clock modulo 2^32, in turns of 2^-32. Times are in s.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from drivers.errors import CommandError
from drivers.protocol.records import (
    WORD,
    Bits,
    Number,
    Numbers,
    Record,
    Refusal,
    Rest,
    Rows,
    Text,
    Values,
    View,
    WireQuantity,
)

VERSION: Final = 4
HELLO: Final = 1
"""Number of the message that every version has."""
BROADCAST: Final = 0
"""The address of all amplifiers on a line."""
MAX_WORDS: Final = 120
"""Maximum words per message, given by a serial frame and a Modbus write."""
CLOCK_TURN: Final = 20.0
"""Seconds until the 32-bit clock of an amplifier wraps around."""
CLOCK_UNKNOWN: Final = 0xFFFF
"""`clock_error` of an amplifier with an unknown error, or without a steerable clock."""
AHEAD_MAX: Final = 1638
"""Maximum lead of the time in a Commit, in steps of the clock's high word: 0.5 s."""
STAGED_LIFE: Final = 1.0
"""Seconds from the first part of a set after which it is discarded if it was not committed."""
REACTION: Final = 0.01
"""Longest time until a reply begins [s]."""
SHORTENED_FADE: Final = 0.002
"""Time in which the oldest fade ends where a set needs its voice [s]."""
NO_CHANNEL: Final = 255

STATES: Mapping[str, int] = {
    "NOT_READY": 0,
    "SWITCH_ON_DISABLED": 1,
    "READY_TO_SWITCH_ON": 2,
    "SWITCHED_ON": 3,
    "OPERATION_ENABLED": 4,
    "QUICK_STOP_ACTIVE": 5,
    "FAULT_REACTION_ACTIVE": 6,
    "FAULT": 7,
}
ENABLED: Final = STATES["OPERATION_ENABLED"]
"""The state in which an amplifier plays: armed."""
LATCHED: Final = (
    STATES["QUICK_STOP_ACTIVE"],
    STATES["FAULT_REACTION_ACTIVE"],
    STATES["FAULT"],
)
"""States that a stop or a fault leads to, until it is cleared."""
FAULTS: Mapping[str, int] = {
    "NONE": 0,
    "WATCHDOG": 1,
    "OVER_TEMPERATURE": 2,
    "OVER_VOLTAGE": 3,
    "ARC": 4,
    "CHANNEL": 5,
    "INTERNAL": 6,
    "INTERLOCK": 7,
    "OVER_CURRENT": 8,
}
REFUSALS: Mapping[str, int] = {
    "UNKNOWN_TYPE": 1,
    "BAD_LENGTH": 2,
    "BAD_VALUE": 3,
    "BAD_CHANNEL": 4,
    "WRONG_STATE": 5,
    "BAD_TOKEN": 6,
    "BUSY": 7,
    "UNSUPPORTED_VERSION": 8,
    "WRONG_SESSION": 10,
    "WRONG_LATCH": 11,
    "INCOMPLETE": 12,
}
STATUS_FLAGS: Mapping[str, int] = {"high_voltage": 0, "interlock_open": 1, "limited": 2}
FEATURES: Mapping[str, int] = {
    "output": 0,
    "events": 1,
    "levels_measured": 2,
    "interlock": 3,
    "electrical": 4,
    "address": 6,
    "mark": 7,
}
"""Bits; output: full level is a linear amplifier's full output, else the stroke of a motion."""


def _word(
    name: str, low: int, high: int, per_unit: int = 1, unit: str = "", zero: int = 0
) -> WireQuantity:
    """Return a quantity of the smallest type; low, high: before a shift by `zero` steps."""
    minimum = low + zero
    maximum = high + zero
    wire = "u16"
    if minimum < 0:
        wire = "i16"
    elif maximum >= WORD:
        wire = "u32"
    return WireQuantity(name, wire, per_unit, unit, minimum, maximum, name == "phase", zero)


_QUANTITIES = (
    _word("frequency", 0, 65535, 20, "Hz"),
    _word("level", 0, 10000, 10000, "of full level"),
    _word("phase", -18000, 17999, 100, "degrees"),
    _word("phase_step", 0, 18000, 100, "degrees"),
    _word("ramp", 0, 1000, 1000, "s"),
    _word("any_ramp", 0, 65535, 1000, "s"),
    _word("valid_for", 0, 60000, 1000, "s"),
    _word("watchdog", 100, 2000, 1000, "s"),
    _word("watchdog_left", 0, 2000, 1000, "s"),
    _word("session", 1, 65535),
    _word("token", 1, 65535),
    _word("played_token", 0, 65535),
    _word("latch", 0, 65535),
    _word("address", 1, 247),
    _word("channel", 0, 15),
    _word("channel_count", 1, 16),
    _word("layer", 0, 15),
    _word("layer_count", 4, 16),
    _word("voices", 8, 255),
    _word("set_words", 512, 65535),
    _word("knots", 0, 32),
    _word("envelope_step", 1, 1000, 10000, "s"),
    _word("slew", 0, 65535, 10, "full levels/s"),
    _word("channel_voltage", 0, 65535, 10, "V"),
    _word("channel_current", 0, 65535, 1000000, "A"),
    _word("age", 0, 0xFFFFFFFF, 1000, "s"),
    _word("count", 0, 65535),
    _word("flags", 0, 65535),
    _word("code", 0, 65535),
    _word("clock", 0, 0xFFFFFFFF),
    _word("shift", 0, 65535),
    _word("at", 0, 65535),
    _word("rate", -32768, 32767, 10000000),
    _word("clock_error", 0, 65535, 10000000, "s"),
)
QUANTITIES: dict[str, WireQuantity] = {quantity.name: quantity for quantity in _QUANTITIES}
"""Quantities by name, including the readings below."""


def _numbers(*names: str) -> tuple[Number, ...]:
    """Return fields by name; `name:quantity` if the quantity has another name."""
    fields = []
    for text in names:
        name, _, quantity_name = text.partition(":")
        fields.append(Number(name, QUANTITIES[quantity_name or name]))
    return tuple(fields)


def _record(*names: str) -> Record:
    """Return a record of such fields."""
    return Record(*_numbers(*names))


def status_reading(
    name: str,
    meaning: str,
    low: int,
    high: int,
    per_unit: int,
    unit: str,
    *views: View,
    is_added: bool = False,
) -> Number:
    """Return a field of Status that is a reading, with a quantity of its own.

    meaning: completes its name. `era amp status`, the API and the metrics show it under its name
    and unit, with the decimals of a step; low, high: in steps; views: additional places that show
    it. An added reading with a range from 0 or below is sent shifted to start at 1, because 0 means
    "not reported" there; raises ValueError if the shifted range exceeds a word.
    """
    is_shifted = is_added and low < 1
    zero = 1 - low if is_shifted else 0
    if high < WORD <= high + zero:
        raise ValueError(
            f"{name} must be from {low} to {WORD - 1 - zero}, or from 1 on, to be one word, where "
            f"0 of an added reading is not stated, got {low} to {high}"
        )
    return Number(name, _word(name, low, high, per_unit, unit, zero), is_added, meaning, views)


_TONES = _record("frequency", "level", "phase")
KNOT = _record("level", "phase")
ENVELOPE = _record("knots", "step:envelope_step")
COMMAND = Record(
    Bits((("channel", 4), ("keep_phase", 1), ("skip_ending", 1), ("onset", 1), ("ending", 1))),
    *_TONES.fields,
)
LAYER = Record(
    Bits((("layer", 4), ("after", 1), ("renew", 1), ("count", 5))),
    *_numbers("ramp", "valid_for"),
)

_LIMITS = _record("frequency_min:frequency", "frequency_max:frequency", "level_max:level")
STATUS = Record(
    *_numbers("state:code", "fault:code", "flags", "latch", "watchdog_left"),
    status_reading("temperature", "of the amplifier", -1000, 2000, 10, "°C", "status", "page"),
    status_reading("high_voltage", "of the supply; 0: not measured", 0, 65535, 1, "V", "page"),
    *_numbers("clock", "token:played_token"),
    Bits((("channels", 8), ("layers", 8))),
    Numbers("levels", "channels", QUANTITIES["level"]),
    Numbers("tokens", "layers", QUANTITIES["played_token"]),
    # Later readings: reading(..., "status", "page", is_added=True), with the views that show it.
)
READINGS = [field for field in STATUS.fields if isinstance(field, Number) and field.meaning]
"""Fields of Status with values in physical units."""
QUANTITIES |= {reading.name: reading.quantity for reading in READINGS}


_CAPABILITIES = Record(
    *_numbers("channels:channel_count", "layers:layer_count", "voices", "set_words", "knots"),
    *_numbers("features:flags", "frequency_min:frequency", "frequency_max:frequency"),
    *_numbers("frequency_step:frequency", "level_max:level", "level_step:level", "phase_step"),
    *_numbers("ramp_max:ramp", "slew", "watchdog_min:watchdog", "watchdog_max:watchdog"),
    *_numbers("envelope_step_min:envelope_step", "envelope_step_max:envelope_step", "clock_error"),
    Rows("limits", "channels", _LIMITS),
)
_TAKEN = Record(
    *_numbers("token"),
    Bits((("exact", 1), ("staged", 1), ("played", 1))),
    *_numbers("missing:count"),
)
_FAULT = _record("fault:code", "channel:code", "age")
_FAULTS = Record(*_numbers("count"), Rows("faults", "count", _FAULT))
_MEASURED_CHANNEL = _record("channel_voltage", "channel_current")
_MEASURED = Record(*_numbers("count"), Rows("channels", "count", _MEASURED_CHANNEL))
_ACHIEVED = Record(
    *_numbers("token:played_token"), *LAYER.fields, Rows("commands", "count", COMMAND)
)


@dataclass(frozen=True, slots=True)
class Message:
    """A request with its number, the record of its reply, and its effects on an amplifier."""

    name: str
    number: int
    request: Record
    reply: Record
    is_broadcast: bool = False
    """Whether it can be sent to all amplifiers of a line together, without a reply."""
    feeds: bool = False
    """Whether it feeds the watchdog."""
    plays: bool = False
    """Whether it stages or starts a set, which the ledger must have admitted."""
    ends_playback: bool = False
    """Whether all channels ramp to zero."""
    changes_state: bool = False
    """Whether it can change the state; an event may then come before the reply."""

    @property
    def arms(self) -> bool:
        """Whether it switches the high voltage on."""
        return self.feeds and self.changes_state

    @property
    def disarms(self) -> bool:
        """Whether it switches the high voltage off after the ramp."""
        return self.ends_playback and self.changes_state

    @property
    def shows_clock(self) -> bool:
        """Whether its reply is a Status, which shows the clock."""
        return self.reply is STATUS

    @property
    def shows_watchdog(self) -> bool:
        """Whether its reply shows how the watchdog runs down."""
        return self.shows_clock and not self.feeds


EVENT: Final = 30
NAK: Final = 31
EVENT_RECORD = _record("state:code", "fault:code", "channel:code", "latch")
NAK_RECORD = _record("request:code", "code", "channel:code")
IDENTITY = Record(
    *_numbers("versions:flags"),
    Text("vendor"),
    Text("product"),
    Text("serial_number"),
    Text("firmware"),
)
"""The identity in CAN objects and Modbus registers; a serial Hello keeps the bytes of version 2."""
TEXTS = [field for field in IDENTITY.fields if isinstance(field, Text)]
"""The texts of an identity, in their order."""


_NOTHING = Record()
_ARM = _record("session", "watchdog", "shift")
_SET = Record(
    *_numbers("session", "token"),
    Bits((("index", 8), ("parts", 7), ("now", 1))),
    Rest("stream"),
)
_COMMIT = _record("session", "token", "at")
_ANY_RAMP = _record("ramp:any_ramp")
"""A ramp above the maximum counts as the maximum: nothing keeps an amplifier from silence."""
_SET_ADDRESS = Record(*_numbers("address"), Text("serial_number"))

_SILENCE = _record("session", "ramp")

_MESSAGES = (
    Message("GetCaps", 2, _NOTHING, _CAPABILITIES),
    Message("Arm", 3, _ARM, STATUS, feeds=True, changes_state=True),
    Message("Disarm", 4, _ANY_RAMP, STATUS, ends_playback=True, changes_state=True),
    Message("Set", 5, _SET, _TAKEN, feeds=True, plays=True),
    Message("Commit", 6, _COMMIT, STATUS, is_broadcast=True, feeds=True, plays=True),
    Message("Silence", 7, _SILENCE, STATUS, feeds=True, ends_playback=True),
    Message(
        "Stop", 8, _ANY_RAMP, STATUS, is_broadcast=True, ends_playback=True, changes_state=True
    ),
    Message("GetStatus", 9, _NOTHING, STATUS),
    Message("GetFaults", 10, _NOTHING, _FAULTS),
    Message("Clear", 11, _record("latch"), STATUS, changes_state=True),
    Message("Ping", 12, _record("session", "rate"), STATUS, feeds=True),
    Message("GetAchieved", 13, _record("layer"), _ACHIEVED),
    Message("GetMeasured", 14, _NOTHING, _MEASURED),
    Message("SetAddress", 15, _SET_ADDRESS, STATUS, is_broadcast=True),
    Message("Mark", 19, _NOTHING, STATUS, is_broadcast=True),
)
MESSAGES: Mapping[str, Message] = {message.name: message for message in _MESSAGES}
RESERVED_MESSAGES: Final = (16, 17, 18)
"""Numbers of former messages, with feature bit 5; must not be reused."""
BY_NUMBER: Mapping[int, Message] = {message.number: message for message in _MESSAGES}
REQUESTS: Mapping[str, Message] = {
    "Hello": Message("Hello", HELLO, _NOTHING, IDENTITY),
    **MESSAGES,
}
"""Requests by name: Hello, common to all versions, and the requests of this version."""
REQUEST_NAMES: Mapping[int, str] = {message.number: name for name, message in REQUESTS.items()}
"""Names of requests by number."""


def decode_request(number: int, words: Sequence[int]) -> tuple[str, Values]:
    """Read the name and the values of a request with a message's number; raises Refusal."""
    message = BY_NUMBER.get(number)
    if message is None:
        raise Refusal(f"type {number} is unknown", "UNKNOWN_TYPE")
    return message.name, message.request.unpack(words, is_strict=True)


def nak_of(refusal: Refusal, number: int) -> list[int]:
    """Return the words of the Nak to a request with a message's number."""
    channel = NO_CHANNEL if refusal.channel is None else refusal.channel
    code = REFUSALS[refusal.code]
    return NAK_RECORD.pack({"request": number, "code": code, "channel": channel})


def capability_ranges(capabilities: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield name, minimum, value and maximum of capabilities with additional bounds."""
    largest = WORD - 1
    for name in ("frequency_step", "level_step", "phase_step", "level_max"):
        yield name, 1, capabilities[name], largest
    yield "voices", capabilities["layers"], capabilities["voices"], largest
    for quantity in ("frequency", "watchdog", "envelope_step"):
        name = f"{quantity}_max"
        yield name, capabilities[f"{quantity}_min"], capabilities[name], largest


def has_feature(capabilities: Values, name: str) -> bool:
    """Whether capabilities include a feature of FEATURES."""
    return bool(capabilities["features"] >> FEATURES[name] & 1)


def has_flag(status: Values, name: str) -> bool:
    """Whether a status shows a flag, of STATUS_FLAGS."""
    return bool(status["flags"] >> STATUS_FLAGS[name] & 1)


def name_of(names: Mapping[str, int], number: int) -> str:
    """Return the name of a number in a table, or the number."""
    for name, named_number in names.items():
        if named_number == number:
            return name
    return str(number)


SPAN = 1 << 32
HIGH_STEPS = 1 << 16
"""Clock steps per step of the high word; shifts and moments are its multiples."""
HIGH_WORDS = SPAN // HIGH_STEPS
HIGH_TIME = CLOCK_TURN / HIGH_WORDS
"""Seconds of a step of the high word."""
MAX_AHEAD = AHEAD_MAX * HIGH_TIME
"""Maximum lead of the time in a Commit [s]."""
_PER_SECOND = SPAN / CLOCK_TURN
_PASSED = 0.25  # s


def clock_at(seconds: float) -> int:
    """Return the value of a clock this many seconds after 0."""
    return round(seconds % CLOCK_TURN * _PER_SECOND) % SPAN


def ahead(clock: int, of: int) -> float:
    """Return by how much [s] a clock is ahead of another, at most half a turn either way."""
    half_turn = SPAN // 2
    steps = (clock - of + half_turn) % SPAN - half_turn
    return steps / _PER_SECOND


def word_passed(seconds: float) -> int:
    """Return a high word that is no moment ahead at a time [s], by a clock near `clock_at`.

    A quarter of a second behind: before it is steered, a clock may be some steps behind.
    """
    return high_word(clock_at(seconds - _PASSED))


def moment_behind(seconds: float) -> float:
    """Return when [s] a clock of `clock_at` next begins a high word, from a time [s] on."""
    steps_left = -clock_at(seconds) % HIGH_STEPS
    return seconds + steps_left / _PER_SECOND


def moment_of(at: int, seconds: float) -> float | None:
    """Return the start time [s] in a Commit sent at a time; None for an immediate start.

    at: the high word of a clock of `clock_at`.
    """
    steps_left = (at * HIGH_STEPS - clock_at(seconds)) % SPAN
    if not 0 < steps_left <= AHEAD_MAX * HIGH_STEPS:
        return None
    return seconds + steps_left / _PER_SECOND


def high_word(clock: int) -> int:
    """Return the high word of a clock, as a Commit names a moment."""
    return clock // HIGH_STEPS


BOOT_TIME = 6.0
"""Timeout [s] of the first reply on a line, for boards that restart when the port is opened."""
REPLY_TIMEOUT = 0.030
"""Timeout [s] of a reply on a fast wire; with a heartbeat, three timeouts are below 150 ms."""
FAST = REPLY_TIMEOUT - REACTION
"""Longest exchange [s] with a reply within that timeout."""
ATTEMPTS = 3
"""Number of times that a request is sent; one less on a slow wire."""
STOP_RAMP = 0.005
"""Shortest ramp without a step [s]."""
HEARTBEAT = 0.05
"""Interval of heartbeats [s]."""
MAX_LOSS_DETECTION_TIME = 3 * HEARTBEAT
"""Longest time to detect a loss without a warning [s]."""
_HEARTBEATS = 3  # a watchdog must outlast this many intervals

SET_WORDS = MESSAGES["Set"].request.words
"""Number of words of a part of a set before its stream."""


def shortest_watchdog(round_trip: float) -> float:
    """Return the shortest watchdog for a wire with this round trip of a set."""
    return _HEARTBEATS * HEARTBEAT + round_trip


def check_watchdog(watchdog: float, round_trip: float) -> None:
    """Raise CommandError for a watchdog shorter than three heartbeats and one round trip."""
    shortest = shortest_watchdog(round_trip)
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"watchdog must be at least {shortest * 1e3:.0f} ms ({_HEARTBEATS} heartbeats of "
            f"{HEARTBEAT * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms), got "
            f"{watchdog * 1e3:g} ms; use a faster line"
        )


def loss_detection_time(round_trips: Iterable[float]) -> float:
    """Return the maximum time until mute amplifiers on a line are detected.

    In the worst case all become mute right after a reply, and each is then sent a set, one after
    the other, with all attempts (one less on a slow wire). round_trips: of the longest set to each.
    """
    detected = HEARTBEAT
    for round_trip in round_trips:
        slow = (ATTEMPTS - 1) * (REPLY_TIMEOUT + round_trip - FAST)
        detected += max(ATTEMPTS * REPLY_TIMEOUT, slow)
    return detected
