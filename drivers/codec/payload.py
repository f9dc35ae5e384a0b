"""Elements of payloads: numbers in range, flags, short texts.

Everything is little-endian. Reading yields values in range or raises `Malformed` with the code of
an amplifier's Nak.
"""

import struct
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from functools import lru_cache
from typing import Any, TypeVar, final

from drivers.errors import CommandError, FrameError
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import NakCode, Status

_CHANNEL = PROTOCOL.quantities.channel
_NO_CHANNEL = 255
_STATUS_FLAGS = PROTOCOL.status_flags
_KNOWN_FLAGS = sum(1 << bit for bit in _STATUS_FLAGS.values())
_TEXT_MAX = 32
_BAD_VALUE = NakCode.BAD_VALUE
_REAL_MAX = (2 - 2**-23) * 2.0**127  # of IEEE 754 binary32
_LAYOUTS = {code: struct.Struct("<" + code) for code in "BHIh"}
_REAL = struct.Struct("<f")

EnumT = TypeVar("EnumT", bound=IntEnum)


@final
class Row:
    """Quantities that follow each other in a payload."""

    def __init__(self, *quantities: WireQuantity) -> None:
        self.quantities = quantities
        self._layout = struct.Struct("<" + "".join(each.struct_code for each in quantities))
        self.size = self._layout.size
        self.pack_integers = self._layout.pack
        self.unpack_from = self._layout.unpack_from

    def pack(self, *values: float) -> bytes:
        """Pack values in their units; CommandError for one out of range."""
        return self.pack_integers(*self.to_wire(values))

    def to_wire(self, values: Iterable[float]) -> list[int]:
        """Encode values in their units as integers; CommandError for one out of range."""
        return [each.to_wire(value) for each, value in zip(self.quantities, values, strict=True)]


class Malformed(FrameError):
    """An invalid payload; code and channel are those of an amplifier's Nak."""

    def __init__(self, text: str, *, code: NakCode, channel: int | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.channel = channel


class Cursor:
    """Reads a payload from front to back; Malformed for missing or out-of-range values."""

    def __init__(self, payload: bytes) -> None:
        self._payload = payload
        self._at = 0

    def integer(self, quantity: WireQuantity) -> int:
        """Read an integer."""
        value = self._raw(quantity.struct_code)
        if not quantity.minimum <= value <= quantity.maximum:
            raise _out_of_range(quantity, value)
        return value

    def integers(self, row: Row) -> Sequence[int]:
        """Read the integers of a row."""
        end = self._at + row.size
        if end > len(self._payload):  # raises for the first that is missing or out of range
            return [self.integer(quantity) for quantity in row.quantities]
        values: tuple[int, ...] = row.unpack_from(self._payload, self._at)
        self._at = end
        for quantity, value in zip(row.quantities, values, strict=True):
            if not quantity.minimum <= value <= quantity.maximum:
                raise _out_of_range(quantity, value)
        return values

    def numbers(self, row: Row) -> list[float]:
        """Read the values of a row in their units."""
        integers = self.integers(row)
        return [
            value / quantity.per_unit
            for quantity, value in zip(row.quantities, integers, strict=True)
        ]

    def number(self, quantity: WireQuantity) -> float:
        """Read a value in its unit."""
        return quantity.from_wire(self.integer(quantity))

    def value(self, quantity: WireQuantity) -> float:
        """Read a value in its unit; as an integer if it has whole steps."""
        return self.integer(quantity) if quantity.per_unit == 1 else self.number(quantity)

    def nearest(self, quantity: WireQuantity) -> float:
        """Read a value in its unit, clipped into range: for what must never be refused."""
        value = self._raw(quantity.struct_code)
        return quantity.from_wire(min(max(value, quantity.minimum), quantity.maximum))

    def one_of(self, kind: type[EnumT]) -> EnumT:
        """Read a member of an enumeration, one byte."""
        return member(kind, self._raw("B"))

    def optional_channel(self) -> int | None:
        """Read a channel, None for 255."""
        value = self._raw("B")
        if value == _NO_CHANNEL:
            return None
        if not _CHANNEL.holds(value):
            raise Malformed(f"channel {value} does not exist", code=NakCode.BAD_VALUE)
        return value

    def text(self) -> str:
        """Read a text: its length in bytes, then UTF-8 without control characters."""
        length = self._raw("B")
        if length > _TEXT_MAX:
            raise Malformed(
                f"text must have at most {_TEXT_MAX} bytes, got {length}", code=NakCode.BAD_VALUE
            )
        return read_text(self._take(length), "text")

    def byte(self) -> int:
        """Read any byte."""
        return self._raw("B")

    def signed(self) -> int:
        """Read any signed integer of two bytes."""
        return self._raw("h")

    def real(self) -> float:
        """Read a number of type f32, which must be finite and not negative."""
        (value,) = _REAL.unpack(self._take(_REAL.size))
        return checked_real(value)

    def rest(self) -> bytes:
        """Read all that is left."""
        return self._take(len(self._payload) - self._at)

    def end(self) -> None:
        """Require the end of the payload."""
        if self._at != len(self._payload):
            extra = len(self._payload) - self._at
            raise Malformed(f"payload is {extra} bytes too long", code=NakCode.BAD_LENGTH)

    def _raw(self, struct_code: str) -> int:
        layout = _LAYOUTS[struct_code]
        at = self._at
        self._at += layout.size
        if self._at > len(self._payload):
            raise Malformed("payload is too short", code=NakCode.BAD_LENGTH)
        value: int = layout.unpack_from(self._payload, at)[0]
        return value

    def _take(self, length: int) -> bytes:
        piece = self._payload[self._at : self._at + length]
        if len(piece) < length:
            raise Malformed("payload is too short", code=NakCode.BAD_LENGTH)
        self._at += length
        return piece


def member(kind: type[EnumT], value: int) -> EnumT:
    """Return the member of an enumeration with a value; Malformed for an unknown one."""
    try:
        return kind(value)
    except ValueError:
        raise Malformed(f"unknown {kind.__name__} {value}", code=NakCode.BAD_VALUE) from None


def _out_of_range(quantity: WireQuantity, value: int) -> Malformed:
    code = {"channel": NakCode.BAD_CHANNEL, "token": NakCode.BAD_TOKEN}.get(quantity.name)
    return Malformed(
        f"{quantity.name} must be {quantity.minimum} to {quantity.maximum}, got {value}",
        code=code or NakCode.BAD_VALUE,
    )


def read_text(raw: bytes, name: str) -> str:
    """Decode a printable text; name: for the message of Malformed."""
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise Malformed(f"{name} must be UTF-8", code=NakCode.BAD_VALUE) from None
    if not text.isprintable():
        raise Malformed(f"{name} must not have control characters", code=NakCode.BAD_VALUE)
    return text


def pack(*pairs: tuple[WireQuantity, float]) -> bytes:
    """Pack values in their units; CommandError for one out of range."""
    return b"".join(
        [_LAYOUTS[quantity.struct_code].pack(quantity.to_wire(value)) for quantity, value in pairs]
    )


def pack_text(text: str) -> bytes:
    """Pack a text, truncated to its longest length; see `Cursor.text`."""
    raw = text.encode()[:_TEXT_MAX].decode(errors="ignore").encode()
    return bytes([len(raw)]) + raw


def pack_real(value: float) -> bytes:
    """Pack a finite number as type f32; CommandError for one out of range."""
    if not 0 <= value <= _REAL_MAX:
        raise CommandError(f"a number must be 0 to {_REAL_MAX:.4g}, got {value:g}")
    return _REAL.pack(value)


def checked_real(value: float) -> float:
    """Return a number of type f32 as it arrived; Malformed unless finite and not negative."""
    if not 0 <= value <= _REAL_MAX:
        raise Malformed(f"a number must be 0 to {_REAL_MAX:.4g}, got {value}", code=_BAD_VALUE)
    return value


def pack_optional_channel(channel: int | None) -> bytes:
    """Pack a channel, 255 for None."""
    return bytes([_NO_CHANNEL]) if channel is None else pack((_CHANNEL, channel))


def status_flags(status: Status) -> int:
    """Return the flags of a status."""
    known = (bool(getattr(status, name)) << bit for name, bit in _STATUS_FLAGS.items())
    return status.other_flags | sum(known)


@lru_cache(maxsize=256)
def flags_of(flags: int) -> Mapping[str, Any]:
    """Return the fields of a status that its flags give."""
    known = {name: bool(flags >> bit & 1) for name, bit in _STATUS_FLAGS.items()}
    return {**known, "other_flags": flags & ~_KNOWN_FLAGS}


def versions_of(mask: int) -> tuple[int, ...]:
    """Return the versions of the protocol in a mask: version n for bit n."""
    return tuple(version for version in range(1, 16) if mask >> version & 1)


def versions_mask(versions: Iterable[int]) -> int:
    """Return the mask of versions; see `versions_of`."""
    return sum(1 << version for version in set(versions))
