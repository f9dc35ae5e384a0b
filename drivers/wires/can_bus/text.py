"""CAN frames as text: slcan lines of serial adapters, and elements of socketcand; no I/O."""

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

from drivers.wires.can_bus.canopen import CanFrame

_MAX_LENGTH = 512  # characters without a terminator; ten times the longest frame
_ID_MAX = 0x7FF
_LINE = re.compile(rb"t([0-9A-Fa-f]{3})([0-8])((?:[0-9A-Fa-f]{2})*)")
SLCAN_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates [bit/s] by the number of the command S of LAWICEL."""
_STAMP = 4  # digits of a timestamp, if the adapter is configured to send it
_HEARD = re.compile(
    rb"< frame ([0-9A-Fa-f]{3}) (?:[0-9A-Fa-f]{2} )?[0-9]+\.[0-9]+ "
    rb"((?:[0-9A-Fa-f]{2} ?){0,8}) ?"
)
_SENT = re.compile(rb"< *send ([0-7]?[0-9A-Fa-f]{1,2}) ([0-8])((?: [0-9A-Fa-f]{1,2})*) *")


class TextFormat(NamedTuple):
    """How frames are written: what ends each text, a frame as text to an adapter, and text as one.

    decode: text of an adapter; decode_sent: text to it; None for what is no data frame with an
    11-bit identifier.
    """

    end: re.Pattern[bytes]
    encode: Callable[[CanFrame], bytes]
    decode: Callable[[bytes], CanFrame | None]
    decode_sent: Callable[[bytes], CanFrame | None]


def _slcan_line(frame: CanFrame) -> bytes:
    return f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}\r".encode()


def _of_slcan_line(line: bytes) -> CanFrame | None:
    found = _LINE.fullmatch(line)
    if found is None:
        return None
    identifier, length, digits = found.groups()
    count = 2 * int(length)
    if len(digits) not in (count, count + _STAMP):
        return None
    return _frame(identifier, digits[:count])


def _element(frame: CanFrame) -> bytes:
    return f"< send {frame.id:03X} {len(frame.data):X} {frame.data.hex(' ')} >".encode()


def _of_element(element: bytes) -> CanFrame | None:
    found = _HEARD.fullmatch(element, max(element.rfind(b"<"), 0))
    return None if found is None else _frame(*found.groups())


def _of_sent(element: bytes) -> CanFrame | None:
    found = _SENT.fullmatch(element, max(element.rfind(b"<"), 0))
    if found is None or len(found[3].split()) != int(found[2]):
        return None
    return CanFrame(int(found[1], 16), bytes(int(byte, 16) for byte in found[3].split()))


def _frame(identifier: bytes, digits: bytes) -> CanFrame | None:
    number = int(identifier, 16)
    return CanFrame(number, bytes.fromhex(digits.decode())) if number <= _ID_MAX else None


SLCAN = TextFormat(re.compile(rb"[\r\n\x07]"), _slcan_line, _of_slcan_line, _of_slcan_line)
SOCKETCAND = TextFormat(re.compile(rb">"), _element, _of_element, _of_sent)


class TextReader:
    """Reads frames from the text of an adapter; on_other: called with any other text."""

    def __init__(
        self, form: TextFormat, on_other: Callable[[bytes], None] = lambda text: None
    ) -> None:
        self._form, self._on_other = form, on_other
        self.rest = b""
        """What may be the beginning of a text."""

    def feed(self, data: bytes) -> Iterator[CanFrame]:
        """Yield the frames that these bytes complete."""
        *texts, rest = self._form.end.split(self.rest + data)
        self.rest = rest if len(rest) <= _MAX_LENGTH else b""
        for text in texts:
            frame = self._form.decode(text)
            if frame is None:
                self._on_other(text)
            else:
                yield frame
