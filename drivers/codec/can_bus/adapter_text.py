"""CAN frames as text: slcan lines of serial adapters, and elements of socketcand; no I/O.

Readers take bytes and yield complete frames; invalid text is skipped.
"""

import re
from collections.abc import Iterator

from drivers.codec.can_bus.canopen import CanFrame

_MAX_LENGTH = 512  # characters without a terminator; twice a CAN FD frame
_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_CLASSIC_MAX = 8
_ELEMENT = re.compile(
    rb"< (frame|fdframe) ([0-9A-Fa-f]{3}) (?:[0-9A-Fa-f]{2} )?[0-9]+\.[0-9]+ "
    rb"((?:[0-9A-Fa-f]{2} ?)*) ?"
)
_LINE = re.compile(rb"([tdb])([0-9A-Fa-f]{3})([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)")
_LINE_END = re.compile(rb"[\r\x07]")
_STAMP = 4  # digits of a timestamp, if the adapter is configured to send it


def slcan_line(frame: CanFrame) -> bytes:
    """Encode the command with which a serial adapter sends a frame."""
    kind = "b" if frame.fd else "t"
    length = _FD_LENGTHS.index(len(frame.data))
    return f"{kind}{frame.id:03X}{length:X}{frame.data.hex().upper()}\r".encode()


def socketcand_element(frame: CanFrame) -> bytes:
    """Encode the element with which socketcand sends a frame; not every version supports CAN FD."""
    data = frame.data.hex(" ")
    if frame.fd:
        return f"< fdsend {frame.id:03X} 00 {len(frame.data)} {data} >".encode()
    return f"< send {frame.id:03X} {len(frame.data):X} {data} >".encode()


class SlcanReader:
    """Reads frames from a serial adapter."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> Iterator[CanFrame]:
        """Yield complete frames; 29-bit identifiers and remote frames are skipped."""
        *lines, rest = _LINE_END.split(self._rest + data)
        self._rest = rest if len(rest) <= _MAX_LENGTH else b""
        for line in lines:
            found = _LINE.fullmatch(line)
            if found:
                kind, identifier, length, text = found.groups()
                digits = 2 * _FD_LENGTHS[int(length, 16)]
                if len(text) == digits + _STAMP:
                    text = text[:digits]
                frame = _frame(identifier, text, is_fd=kind != b"t")
                if frame is not None and len(text) == digits:
                    yield frame


class SocketcandReader:
    """Reads frames from socketcand in raw mode."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> Iterator[CanFrame]:
        """Yield complete frames; other elements and 29-bit identifiers are skipped."""
        *elements, rest = (self._rest + data).split(b">")
        self._rest = rest if len(rest) <= _MAX_LENGTH else b""
        for element in elements:
            found = _ELEMENT.fullmatch(element, element.rfind(b"<") if b"<" in element else 0)
            if found:
                kind, identifier, text = found.groups()
                frame = _frame(identifier, text, is_fd=kind == b"fdframe")
                if frame is not None:
                    yield frame


def _frame(identifier: bytes, text: bytes, *, is_fd: bool) -> CanFrame | None:
    """Decode a frame from hexadecimal text; None if it is invalid."""
    number, data = int(identifier, 16), bytes.fromhex(text.decode())
    lengths = _FD_LENGTHS if is_fd else _FD_LENGTHS[: _CLASSIC_MAX + 1]
    if number > 0x7FF or len(data) not in lengths:
        return None
    return CanFrame(number, data, fd=is_fd)
