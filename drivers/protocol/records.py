"""Messages as rows of 16-bit words: fields, records, and the conversion between both ends.

A record is compiled once from its fields. Values are the integers of the wire (see
`WireQuantity.to_wire`); only type f32 is a float, and a text a str. Requests are read strictly, by
the amplifier: `Refusal` for a word that is missing, too many or out of range. Replies may grow, so
what follows their fields is ignored.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.errors import FrameError
from drivers.protocol.quantity import WireQuantity

WORD = 0x10000
_CODES = {"channel": "BAD_CHANNEL", "token": "BAD_TOKEN"}
"""Of Naks, by quantity; others are BAD_VALUE."""
TEXT_MAX = 32  # bytes
_REAL_MAX = (2 - 2**-23) * 2.0**127  # of IEEE 754 binary32

Values = dict[str, Any]


def bits_of(word: int) -> list[int]:
    """Return the numbers of the bits of a word that are set, as of versions and features."""
    return [bit for bit in range(16) if word >> bit & 1]


class Refusal(FrameError):
    """Words that no message can have; code: that of an amplifier's Nak, channel: at fault."""

    def __init__(self, text: str, code: str = "BAD_VALUE", channel: int | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.channel = channel


@dataclass(frozen=True, slots=True)
class Number:
    """An integer of a quantity: one word, or two with the high one first for u32."""

    name: str
    quantity: WireQuantity


@dataclass(frozen=True, slots=True)
class Bits:
    """Unsigned numbers that share a word, the first in the highest bits; unused bits are 0."""

    parts: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class Real:
    """A number of type f32: finite and not negative, two words."""

    name: str

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
        """Return the bytes of the text, cut at its longest length between two characters."""
        text: str = values[self.name]
        return text.encode()[:TEXT_MAX].decode(errors="ignore").encode()

    def read(self, raw: bytes, length: int, values: Values) -> None:
        """Read the text from its bytes, of which there must be a number."""
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
    """Integers of one quantity, a word each; count: the name of the value that says how many."""

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
                raise ValueError(_out_of_range(self.name, low, high, number))
        words.extend(numbers)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the integers."""
        end = at + int(values[self.count])
        if end > len(words):
            raise IndexError
        numbers = list(words[at:end])
        low, high = self.quantity.minimum, self.quantity.maximum
        for number in numbers:
            if not low <= number <= high:
                raise Refusal(_out_of_range(self.name, low, high, number))
        values[self.name] = numbers
        return end


@dataclass(frozen=True, slots=True)
class Rows:
    """Records that follow each other; count: how many, or the name of the value that says it."""

    name: str
    count: str | int
    record: "Record"

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

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the words."""
        words.extend(values[self.name])

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Take the words."""
        values[self.name] = list(words[at:])
        return len(words)


Field = Number | Bits | Real | Text | Numbers | Rows | Rest


@dataclass(frozen=True, slots=True)
class _Word:
    """The word of a field, or the two of an u32: name, least, greatest and bits of each part."""

    parts: tuple[tuple[str, int, int, int], ...]
    quantity: WireQuantity | None
    is_long: bool

    @classmethod
    def of(cls, field: Number | Bits) -> "_Word":
        """Lay out a field."""
        if isinstance(field, Bits):
            parts = tuple((name, 0, (1 << bits) - 1, bits) for name, bits in field.parts)
            return cls(parts, None, False)
        each = field.quantity
        is_long = each.wire == "u32"
        part = (field.name, each.minimum, each.maximum, 32 if is_long else 16)
        return cls((part,), each, is_long)


class _Run:
    """Numbers and shared words that follow each other, in one loop: the codec's hot path."""

    def __init__(self, fields: Iterable[Number | Bits]) -> None:
        self._words = tuple(map(_Word.of, fields))

    def pack(self, values: Mapping[str, Any], words: list[int]) -> None:
        """Append the words; ValueError for a value out of range, KeyError for no number."""
        for each in self._words:
            word = 0
            for name, low, high, bits in each.parts:
                value = values.get(name, 0) if each.quantity is None else values[name]
                if not low <= value <= high:
                    raise ValueError(_out_of_range(name, low, high, value))
                word = word << bits | value % (1 << bits)
            if each.is_long:
                words.append(word >> 16)
            words.append(word % WORD)

    def unpack(self, words: Sequence[int], at: int, values: Values) -> int:
        """Read the words; raises Refusal for one out of range."""
        for each in self._words:
            word = words[at]
            if each.quantity is None:
                for name, _, high, bits in reversed(each.parts):
                    values[name] = word & high
                    word >>= bits
                if word:
                    raise Refusal(f"unused bits beside {name} must be 0")
            else:
                name, low, high, _ = each.parts[0]
                if each.is_long:
                    at += 1
                    word = word * WORD + words[at]
                elif low < 0 and word >= WORD // 2:
                    word -= WORD
                if not low <= word <= high:
                    code = _CODES.get(each.quantity.name, "BAD_VALUE")
                    raise Refusal(_out_of_range(name, low, high, word), code)
                values[name] = word
            at += 1
        return at


class Record:
    """Fields that follow each other in words."""

    append: Callable[[Mapping[str, Any], list[int]], None]
    """Append the words of values; ValueError for one out of range, KeyError for none."""

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        self.names = tuple(name for field in fields for name in _names(field))
        self._codecs = tuple(_codecs(fields))
        self.append = self._codecs[0].pack if len(self._codecs) == 1 else self._append_all

    def _append_all(self, values: Mapping[str, Any], words: list[int]) -> None:
        for codec in self._codecs:
            codec.pack(values, words)

    def pack(self, values: Mapping[str, Any]) -> list[int]:
        """Return the words of values."""
        words: list[int] = []
        self.append(values, words)
        return words

    def read(self, words: Sequence[int], at: int = 0) -> tuple[Values, int]:
        """Read the values from an index on, and the index behind them; raises Refusal."""
        values: Values = {}
        try:
            for codec in self._codecs:
                at = codec.unpack(words, at, values)
        except IndexError:
            raise Refusal("message is too short", "BAD_LENGTH") from None
        return values, at

    def unpack(self, words: Sequence[int], *, is_strict: bool) -> Values:
        """Read the values; is_strict: nothing may follow them. Raises Refusal."""
        values, end = self.read(words)
        if is_strict and end != len(words):
            raise Refusal(f"message is {len(words) - end} words too long", "BAD_LENGTH")
        return values


def _names(field: Field) -> Iterator[str]:
    if isinstance(field, Bits):
        yield from (name for name, _ in field.parts)
    else:
        yield field.name


def _codecs(fields: Iterable[Field]) -> Iterator[_Run | Real | Text | Numbers | Rows | Rest]:
    """Yield what packs and unpacks fields: of words that follow each other together."""
    run: list[Number | Bits] = []
    for field in fields:
        if isinstance(field, Number | Bits):
            run.append(field)
            continue
        if run:
            yield _Run(run)
            run = []
        yield field
    if run:
        yield _Run(run)


def _out_of_range(name: str, low: int, high: int, value: int) -> str:
    return f"{name} must be {low} to {high}, got {value}"
