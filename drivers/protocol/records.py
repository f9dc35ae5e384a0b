"""Messages as rows of 16-bit words: fields, records, and the conversion between both ends.

A record is compiled once from its fields. Values are the integers of the wire (see
`WireQuantity.to_wire`); only type f32 is a float, and a text a str. Requests are read strictly, by
the amplifier: `Refusal` for a word that is missing, too many or out of range. Replies may grow, so
what follows their fields is ignored.
"""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Protocol

from drivers.errors import FrameError
from drivers.protocol.quantity import WireQuantity

WORD = 0x10000
_REAL_MAX = (2 - 2**-23) * 2.0**127  # of IEEE 754 binary32

Values = dict[str, Any]


class Refusal(FrameError):
    """Words that no message can have; code: that of an amplifier's Nak, channel: at fault."""

    def __init__(self, text: str, code: str = "BAD_VALUE", channel: int | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.channel = channel


class Field(Protocol):
    """A field of a record: appends its words, or reads them from an index on."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its values."""

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the words of its values."""

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Add its values; returns the index behind its words. Raises Refusal."""


@dataclass(frozen=True, slots=True)
class Number:
    """An integer of a quantity: one word, or two with the high one first for u32."""

    name: str
    quantity: WireQuantity

    @property
    def names(self) -> tuple[str, ...]:
        """The one name."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the integer; ValueError for one out of range."""
        value = values[self.name]
        if not self.quantity.minimum <= value <= self.quantity.maximum:
            raise ValueError(_out_of_range(self.quantity, self.name, value))
        if self.quantity.wire == "u32":
            words.append(value >> 16)
        words.append(value % WORD)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the integer."""
        quantity = self.quantity
        value = words[at]
        if quantity.wire == "u32":
            at += 1
            value = value * WORD + words[at]
        elif quantity.minimum < 0 and value >= WORD // 2:
            value -= WORD
        if not quantity.minimum <= value <= quantity.maximum:
            code = {"channel": "BAD_CHANNEL", "token": "BAD_TOKEN"}.get(quantity.name, "BAD_VALUE")
            raise Refusal(_out_of_range(quantity, self.name, value), code)
        values[self.name] = value
        return at + 1


@dataclass(frozen=True, slots=True)
class Bits:
    """Unsigned numbers that share a word, the first in the highest bits; unused bits are 0."""

    parts: tuple[tuple[str, int], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(name for name, _ in self.parts)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the word; ValueError for a value that does not fit."""
        word = 0
        for name, bits in self.parts:
            value = int(values.get(name, 0))
            if not 0 <= value < 1 << bits:
                raise ValueError(f"{name} must be 0 to {(1 << bits) - 1}, got {value}")
            word = word << bits | value
        words.append(word)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the word."""
        word = words[at]
        for name, bits in reversed(self.parts):
            values[name] = word & (1 << bits) - 1
            word >>= bits
        if word:
            raise Refusal(f"unused bits beside {self.parts[0][0]} must be 0")
        return at + 1


@dataclass(frozen=True, slots=True)
class Real:
    """A number of type f32: finite and not negative, two words."""

    name: str

    @property
    def names(self) -> tuple[str, ...]:
        """The one name."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the number."""
        value = values[self.name]
        if not 0 <= value <= _REAL_MAX:
            raise ValueError(f"{self.name} must be 0 to {_REAL_MAX:.4g}, got {value:g}")
        words.extend(struct.unpack(">HH", struct.pack(">f", value)))

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the number."""
        (value,) = struct.unpack(">f", struct.pack(">HH", words[at], words[at + 1]))
        if not 0 <= value <= _REAL_MAX:
            raise Refusal(f"{self.name} must be 0 to {_REAL_MAX:.4g}, got {value}")
        values[self.name] = value
        return at + 2


@dataclass(frozen=True, slots=True)
class Text:
    """A text of at most 32 bytes of UTF-8: its length, then two bytes a word, the first high."""

    name: str
    max_bytes: int = 32

    @property
    def names(self) -> tuple[str, ...]:
        """The one name."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the text, cut at its longest length between two characters."""
        raw = values[self.name].encode()[: self.max_bytes].decode(errors="ignore").encode()
        words.append(len(raw))
        words.extend(word for (word,) in struct.iter_unpack(">H", raw + b"\0" * (len(raw) % 2)))

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the text."""
        length = words[at]
        end = at + 1 + (length + 1) // 2
        if length > self.max_bytes or end > len(words):
            raise Refusal(f"{self.name} must have at most {self.max_bytes} bytes", "BAD_LENGTH")
        raw = b"".join(word.to_bytes(2, "big") for word in words[at + 1 : end])[:length]
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError:
            raise Refusal(f"{self.name} must be UTF-8") from None
        if not text.isprintable():
            raise Refusal(f"{self.name} must not have control characters")
        values[self.name] = text
        return end


@dataclass(frozen=True, slots=True)
class Numbers:
    """Integers of one quantity, a word each; count: the name of the value that says how many."""

    name: str
    count: str
    quantity: WireQuantity

    @property
    def names(self) -> tuple[str, ...]:
        """The one name."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the integers; ValueError for another count, or one out of range."""
        numbers = values[self.name]
        if len(numbers) != values[self.count]:
            raise ValueError(f"{self.name} must be {values[self.count]}, got {len(numbers)}")
        for number in numbers:
            if not self.quantity.minimum <= number <= self.quantity.maximum:
                raise ValueError(_out_of_range(self.quantity, self.name, number))
        words.extend(numbers)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the integers."""
        end = at + int(values[self.count])
        if end > len(words):
            raise IndexError
        numbers = list(words[at:end])
        for number in numbers:
            if not self.quantity.minimum <= number <= self.quantity.maximum:
                raise Refusal(_out_of_range(self.quantity, self.name, number))
        values[self.name] = numbers
        return end


@dataclass(frozen=True, slots=True)
class Rows:
    """Records that follow each other; count: how many, or the name of the value that says it."""

    name: str
    count: str | int
    record: "Record"

    @property
    def names(self) -> tuple[str, ...]:
        """The one name; its value is a list of dictionaries."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append all records."""
        rows = values[self.name]
        count = self.count if isinstance(self.count, int) else values[self.count]
        if len(rows) != count:
            raise ValueError(f"{self.name} must have {count} rows, got {len(rows)}")
        for row in rows:
            self.record.append(row, words)

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

    @property
    def names(self) -> tuple[str, ...]:
        """The one name."""
        return (self.name,)

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the words."""
        words.extend(values[self.name])

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Take the words."""
        values[self.name] = list(words[at:])
        return len(words)


class Run:
    """Numbers and shared words that follow each other, in one loop: the codec's hot path."""

    def __init__(self, fields: Sequence[Number | Bits]) -> None:
        self.names = tuple(name for field in fields for name in field.names)
        self._fields = tuple(map(_parts_of, fields))

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the words; ValueError for a value out of range, KeyError for no number."""
        for _, parts, is_number in self._fields:
            word = 0
            for name, low, high, bits in parts:
                value = values[name] if is_number else values.get(name, 0)
                if not low <= value <= high:
                    raise ValueError(f"{name} must be {low} to {high}, got {value}")
                word = word << bits | value % (1 << bits)
            words.append(word)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the words; raises Refusal for one out of range."""
        for field, parts, is_number in self._fields:
            word = words[at]
            name, low, high, _ = parts[0]
            if not is_number:
                for name, _, high, bits in reversed(parts):
                    values[name] = word & high
                    word >>= bits
                if word:
                    raise Refusal(f"unused bits beside {parts[0][0]} must be 0")
            else:
                if low < 0 and word >= WORD // 2:
                    word -= WORD
                if not low <= word <= high:
                    field.unpack(words, at, values)  # raises
                values[name] = word
            at += 1
        return at


def _parts_of(
    field: Number | Bits,
) -> tuple[Number | Bits, tuple[tuple[str, int, int, int], ...], bool]:
    """Return name, least, greatest and bits of each part of a word, and whether it is a number."""
    if isinstance(field, Bits):
        return field, tuple((name, 0, (1 << bits) - 1, bits) for name, bits in field.parts), False
    quantity = field.quantity
    return field, ((field.name, quantity.minimum, quantity.maximum, 16),), True


def _is_word(field: Field) -> bool:
    return isinstance(field, Bits) or (isinstance(field, Number) and field.quantity.wire != "u32")


def _in_runs(fields: Sequence[Field]) -> Iterator[Field]:
    """Yield fields, with single words that follow each other as runs."""
    for is_word, several in groupby(fields, _is_word):
        if is_word:
            yield Run([field for field in several if isinstance(field, Number | Bits)])
        else:
            yield from several


class Record:
    """Fields that follow each other in words."""

    append: Callable[[Mapping[str, Any], list[int]], None]
    """Append the words of values; ValueError for one out of range, KeyError for none."""

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        self._compiled: tuple[Field, ...] = tuple(_in_runs(fields))
        self.names = tuple(name for field in fields for name in field.names)
        self.append = self._compiled[0].pack if len(self._compiled) == 1 else self._append_all

    def _append_all(self, values: Mapping[str, Any], words: list[int]) -> None:
        for field in self._compiled:
            field.pack(values, words)

    def pack(self, values: Mapping[str, Any]) -> list[int]:
        """Return the words of values."""
        words: list[int] = []
        self.append(values, words)
        return words

    def read(self, words: Sequence[int], at: int = 0) -> tuple[Values, int]:
        """Read the values from an index on, and the index behind them; raises Refusal."""
        values: Values = {}
        try:
            for field in self._compiled:
                at = field.unpack(words, at, values)
        except IndexError:
            raise Refusal("message is too short", "BAD_LENGTH") from None
        return values, at

    def unpack(self, words: Sequence[int], *, is_strict: bool) -> Values:
        """Read the values; is_strict: nothing may follow them. Raises Refusal."""
        values, end = self.read(words)
        if is_strict and end != len(words):
            raise Refusal(f"message is {len(words) - end} words too long", "BAD_LENGTH")
        return values


def _out_of_range(quantity: WireQuantity, name: str, value: int) -> str:
    return f"{name} must be {quantity.minimum} to {quantity.maximum}, got {value}"
