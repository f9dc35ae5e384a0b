"""Messages as rows of 16-bit words: numbers, fields, records, and their conversion.

Values are wire integers (see `WireQuantity.to_wire`), except f32 (a float) and texts (str). The
amplifier reads requests strictly: `Refusal` for a missing, additional or out-of-range word. Replies
can grow at their end: words after the fields of a record are ignored, and a number that `is_added`
is None if an amplifier does not have it.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, product
from typing import Any, Literal

from drivers.errors import CommandError, FrameError

WORD = 0x10000
_CODES = {"channel": "BAD_CHANNEL", "token": "BAD_TOKEN"}
"""Nak codes by quantity; all others are BAD_VALUE."""
TEXT_MAX = 32  # bytes
_TOLERANCE = 1e-3  # of a step; sums of floats may exceed a range by rounding

UNITS: Mapping[str, tuple[str, str]] = {
    "": ("", ""),
    "of full level": ("", ""),
    "full levels/s": ("_per_s", "_per_second"),
    "Hz": ("_hz", "_hertz"),
    "s": ("_s", "_seconds"),
    "degrees": ("_deg", "_degrees"),
    "m": ("_m", "_meters"),
    "V": ("_v", "_volts"),
    "°C": ("_c", "_celsius"),
    "A": ("_a", "_amperes"),
    "mA": ("_ma", "_milliamperes"),
    "W": ("_w", "_watts"),
    "%": ("_percent", "_percent"),
    "rpm": ("_rpm", "_rpm"),
}
"""Units of quantities, with the suffixes of their keys in JSON and of their metrics."""

Values = dict[str, Any]
View = Literal["status", "page"]
"""Where a reading is shown: the line of `era status`, the dashboard."""


@dataclass(frozen=True)
class WireQuantity:
    """A kind of number on the wire: an integer of `per_unit` steps per unit, within a range.

    wire: u16, u32 or i16; minimum, maximum: as integers; wraps: an angle, modulo 360; zero: the
    integer for 0 of the unit.
    """

    name: str
    wire: str
    per_unit: int
    unit: str
    minimum: int
    maximum: int
    wraps: bool = False
    zero: int = 0

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise ValueError(
                f"unit of {self.name} must be one of {', '.join(UNITS)[2:]}, got {self.unit}; add "
                "it there with its ends of keys"
            )

    @cached_property
    def step(self) -> float:
        """Resolution on the wire, in the unit."""
        return 1 / self.per_unit

    @property
    def low(self) -> float:
        """Smallest value, in the unit."""
        return self.from_wire(self.minimum)

    @property
    def high(self) -> float:
        """Largest value, in the unit."""
        return self.from_wire(self.maximum)

    @property
    def scale(self) -> str:
        """One step for people, and which integer is the lowest value if steps count from there."""
        step = f"{self.step:.6g} {self.unit}".strip()
        origin = f"{self.minimum} is {self.low:g} {self.unit}".strip()
        return f"{step}; {origin}" if self.zero else step

    def to_wire(self, value: float) -> int:
        """Encode a value [unit] as an integer, rounded to the nearest step.

        Raises CommandError for NaN, infinities and values out of range; nothing is clipped.
        """
        scaled = value * self.per_unit + self.zero
        if self.minimum <= scaled <= self.maximum:
            return round(scaled)
        if not math.isfinite(value):
            raise CommandError(f"{self.name} must be a finite number, got {value}")
        if self.wraps:
            span = self.maximum - self.minimum + 1
            return (round(scaled) - self.minimum) % span + self.minimum
        if not self.minimum - _TOLERANCE <= scaled <= self.maximum + _TOLERANCE:
            unit = f" {self.unit}" if self.unit else ""
            raise CommandError(
                f"{self.name} must be {self.low:g} to {self.high:g}{unit}, got {value:g}{unit}"
            )
        return round(scaled)

    def from_wire(self, integer: int) -> float:
        """Decode an integer to a value [unit]."""
        return (integer - self.zero) / self.per_unit

    def quantise(self, value: float) -> float:
        """Return the value [unit] after transmission, with its rounding."""
        return self.from_wire(self.to_wire(value))


def bits_of(word: int) -> list[int]:
    """Return the indices of the set bits of a word, such as versions or features."""
    return [bit for bit in range(16) if word >> bit & 1]


class Refusal(FrameError):
    """Invalid words of a message; code: of the amplifier's Nak; channel: the invalid one."""

    def __init__(self, text: str, code: str = "BAD_VALUE", channel: int | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.channel = channel


@dataclass(frozen=True, slots=True)
class Number:
    """An integer of a quantity: one word, or two with the high one first for u32.

    is_added: added to the end of its record after the first edition. Amplifiers can omit it: their
    reply ends before it, or has 0 there, as in Modbus registers. meaning: of a reading, completes
    its label; views: places that show it in addition to `era amp status`, the API and the metrics.
    """

    name: str
    quantity: WireQuantity
    is_added: bool = False
    meaning: str = ""
    views: tuple[View, ...] = ()

    def __post_init__(self) -> None:
        if self.is_added and self.quantity.minimum < 1:
            raise ValueError(
                f"{self.name} must begin at 1, since 0 is not stated, got {self.quantity.minimum}; "
                f"give its quantity the zero {self.quantity.zero + 1 - self.quantity.minimum}, and "
                "a range from there"
            )

    @property
    def words(self) -> int:
        """How many words it takes."""
        return 2 if self.quantity.wire == "u32" else 1

    @property
    def key(self) -> str:
        """Its name in JSON, which ends in the unit."""
        return self.name + UNITS[self.quantity.unit][0]

    @property
    def metric(self) -> str:
        """Its name among metrics, which ends in the unit."""
        return self.name + UNITS[self.quantity.unit][1]

    @property
    def label(self) -> str:
        """Its name for people."""
        return self.name.replace("_", " ")

    @property
    def decimals(self) -> int:
        """Number of decimals to display, given by a step."""
        return math.ceil(math.log10(self.quantity.per_unit))

    def in_unit(self, values: Values) -> float | None:
        """Return its value in the unit, an int without one; None if it is not reported."""
        value: int | None = values[self.name]
        if value is None:
            return None
        if not self.quantity.unit:
            return value - self.quantity.zero
        return self.quantity.from_wire(value)


@dataclass(frozen=True, slots=True)
class Bits:
    """Unsigned numbers that share a word, the first in the highest bits; unused bits are 0."""

    parts: tuple[tuple[str, int], ...]
    words = 1

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the numbers."""
        word = words[at]
        for name, bits in reversed(self.parts):
            values[name] = word & (1 << bits) - 1
            word >>= bits
        if word:
            raise Refusal(f"unused bits next to {self.parts[0][0]} must be 0")
        return at + 1

    @property
    def shifts(self) -> list[int]:
        """By how much each is shifted."""
        return [*accumulate((bits for _, bits in self.parts[:0:-1]), initial=0)][::-1]


@dataclass(frozen=True, slots=True)
class Text:
    """A text of at most 32 bytes of UTF-8: its length, then two bytes a word, the first high."""

    name: str

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the text, cut at its longest length between two characters."""
        raw = self.encoded(values)
        words.append(len(raw))
        words.extend(word for (word,) in struct.iter_unpack(">H", raw + b"\0" * (len(raw) % 2)))

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the text."""
        end = at + 1 + (words[at] + 1) // 2
        raw = struct.pack(f">{len(words[at + 1 : end])}H", *words[at + 1 : end])
        self.read(raw[: words[at]], words[at], values)
        return end

    def encoded(self, values: Mapping[str, Any]) -> bytes:
        """Return the bytes of the text, cut to the maximum length at a character boundary."""
        text: str = values[self.name]
        return text.encode()[:TEXT_MAX].decode(errors="ignore").encode()

    def read(self, raw: bytes, length: int, values: Values) -> None:
        """Read the text from its bytes, of the given length."""
        if length != len(raw) or length > TEXT_MAX:
            raise Refusal(f"{self.name} must have at most {TEXT_MAX} bytes", "BAD_LENGTH")
        try:
            values[self.name] = raw.decode("utf-8")
        except UnicodeDecodeError:
            raise Refusal(f"{self.name} must be UTF-8") from None
        if not values[self.name].isprintable():
            raise Refusal(f"{self.name} must not have control characters")


@dataclass(frozen=True, slots=True)
class Numbers:
    """Integers with a common quantity, one word each; count: name of the field that counts them."""

    name: str
    count: str
    quantity: WireQuantity

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the integers; ValueError for another count, or one out of range."""
        numbers = values[self.name]
        if len(numbers) != values[self.count]:
            raise ValueError(f"{self.name} must be {values[self.count]}, got {len(numbers)}")
        low, high = self.quantity.minimum, self.quantity.maximum
        for number in numbers:
            if not low <= number <= high:
                raise ValueError(_out_of_range(self.name, self.quantity, number))
        words.extend(numbers)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the integers."""
        end = at + int(values[self.count])
        if end > len(words):
            raise IndexError
        numbers = list(words[at:end])
        for number in numbers:
            if not self.quantity.minimum <= number <= self.quantity.maximum:
                raise Refusal(_out_of_range(self.name, self.quantity, number))
        values[self.name] = numbers
        return end


@dataclass(frozen=True, slots=True)
class Rows:
    """Consecutive records; count: their number, or the name of the value with it."""

    name: str
    count: str | int
    record: "Record"

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append all records."""
        rows = values[self.name]
        count = self.count if isinstance(self.count, int) else values[self.count]
        if len(rows) != count:
            raise ValueError(f"{self.name} must have {count} rows, got {len(rows)}")
        self.record.append(words, *rows)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read all records."""
        rows: list[Values] = []
        for _ in range(self.count if isinstance(self.count, int) else values[self.count]):
            row, at = self.record.read(words, at)
            rows.append(row)
        values[self.name] = rows
        return at


@dataclass(frozen=True, slots=True)
class Rest:
    """All words that are left."""

    name: str

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Take the words."""
        values[self.name] = list(words[at:])
        return len(words)


Field = Number | Bits | Text | Numbers | Rows | Rest


class Record:
    """Consecutive fields in words, added fields last.

    places: word index of each value by name, up to the first field of variable length; words: their
    number.
    """

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        self.added = [part for part in fields if isinstance(part, Number) and part.is_added]
        self._unstated = [0] * sum(number.words for number in self.added)
        self.names: list[str] = []
        for field in fields:
            self.names += dict(field.parts) if isinstance(field, Bits) else [field.name]
        self.places: dict[str, int] = {}
        self.words = 0
        for field in fields:
            if not isinstance(field, Number | Bits) or field in self.added:
                break
            names = dict(field.parts) if isinstance(field, Bits) else [field.name]
            self.places |= dict.fromkeys(names, self.words)
            self.words += field.words
        self.shifts = [shift for part in fields if isinstance(part, Bits) for shift in part.shifts]
        """Of the numbers that share a word."""

    @property
    def form(self) -> str:
        """The fields as `struct` names them, a word each: shared ones and numbers."""
        signed = [isinstance(part, Number) and part.quantity.minimum < 0 for part in self.fields]
        return "".join("h" if is_signed else "H" for is_signed in signed)

    def append(self, words: list[int], *rows: Mapping[str, Any]) -> list[int]:
        """Append the words of values, by row, and return all.

        ValueError for a value out of range, KeyError for a missing one. Added values without a
        value are left out at the end, and 0 before a field with a value.

        Single-word numbers, nearly all, are packed without a call: every set has dozens.
        """
        if self.added:
            unstated = dict.fromkeys(number.name for number in self.added)
            rows = tuple([{**unstated, **row} for row in rows])
        for values, field in product(rows, self.fields):
            if isinstance(field, Number):
                quantity, value = field.quantity, values[field.name]
                if field.is_added and value is None:
                    value = 0
                elif not quantity.minimum <= value <= quantity.maximum:
                    raise ValueError(_out_of_range(field.name, quantity, value))
                if quantity.wire == "u32":
                    words.append(value >> 16)
                words.append(value % WORD)
            elif isinstance(field, Bits):
                word = 0
                for name, bits in field.parts:
                    value = values.get(name, 0)
                    if not 0 <= value < 1 << bits:
                        raise ValueError(f"{name} must be below {1 << bits}, got {value}")
                    word = word << bits | value
                words.append(word)
            elif isinstance(field, Rest):
                words.extend(values[field.name])
            else:
                field.pack(values, words)
        for _ in self._unstated:
            if words[-1]:
                break
            words.pop()
        return words

    def pack(self, values: Mapping[str, Any]) -> list[int]:
        """Return the words of values."""
        return self.append([], values)

    def read(self, words: Sequence[int], at: int = 0) -> tuple[Values, int]:
        """Read the values from an index, and return the index after them; raises Refusal."""
        values: Values = {}
        end_of_words = len(words)
        if self.added:
            words = [*words, *self._unstated]
        try:
            for field in self.fields:
                if isinstance(field, Number):  # nearly all; read without a call
                    quantity = field.quantity
                    word = words[at]
                    if quantity.wire == "u32":
                        at += 1
                        word = word * WORD + words[at]
                    elif quantity.minimum < 0 and word >= WORD // 2:
                        word -= WORD
                    is_unstated = field.is_added and not word
                    if not is_unstated and not quantity.minimum <= word <= quantity.maximum:
                        code = _CODES.get(quantity.name, "BAD_VALUE")
                        raise Refusal(_out_of_range(field.name, quantity, word), code)
                    values[field.name] = None if is_unstated else word
                    at += 1
                else:
                    at = field.unpack(words, at, values)
        except IndexError:
            raise Refusal("message is too short", "BAD_LENGTH") from None
        return values, min(at, end_of_words)

    def unpack(self, words: Sequence[int], *, is_strict: bool) -> Values:
        """Read the values; is_strict: nothing may follow them. Raises Refusal."""
        values, end = self.read(words)
        if is_strict and end != len(words):
            raise Refusal(f"message is {len(words) - end} words too long", "BAD_LENGTH")
        return values


def _out_of_range(name: str, quantity: WireQuantity, value: int) -> str:
    return f"{name} must be {quantity.minimum} to {quantity.maximum}, got {value}"
