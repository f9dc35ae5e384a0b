"""CAN frames in the text protocols of adapters: socketcand over TCP, slcan over a serial port.

`< send ID LEN BYTES >` and `< frame ID TIME DATA >` with their `fd` variants, and LAWICEL's
`tIIILDD..` with `d` and `b` for CAN FD. Other text is ignored.
"""

import re
from abc import ABC, abstractmethod
from typing import NamedTuple

from sim.witness.capture import Direction

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data lengths of CAN FD frames, by length code."""

_MAX_LENGTH = 512
_SEND = re.compile(rb"< send ([0-9A-Fa-f]+) (\d+)((?: [0-9A-Fa-f]+)*) +>")
_FD_SEND = re.compile(rb"< fdsend ([0-9A-Fa-f]+) [0-9A-Fa-f]+ (\d+)((?: [0-9A-Fa-f]+)*) +>")
_FRAME = re.compile(rb"< frame ([0-9A-Fa-f]+) [0-9.]+ ([0-9A-Fa-f ]*?) ?>")
_FD_FRAME = re.compile(rb"< fdframe ([0-9A-Fa-f]+) [0-9A-Fa-f]+ [0-9.]+ ([0-9A-Fa-f ]*?) ?>")
_SLCAN = re.compile(rb"([tdb])([0-7][0-9A-Fa-f]{2})([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)")


class CanFrame(NamedTuple):
    """A frame with an identifier of 11 bits."""

    identifier: int
    data: bytes
    is_fd: bool


class Text(NamedTuple):
    """A line or element; frame: None where it is none; is_damaged: a malformed frame."""

    raw: bytes
    frame: CanFrame | None
    is_damaged: bool


class _AdapterText(ABC):
    """Splits the text of one direction at its delimiters."""

    delimiter: re.Pattern[bytes]

    def __init__(self, direction: Direction) -> None:
        self._direction: Direction = direction
        self._rest = b""

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes begin a frame."""
        return bool(self._rest)

    def feed(self, data: bytes) -> list[Text]:
        """Decode bytes; returns the complete frames."""
        *pieces, self._rest = self.delimiter.split(self._rest + data)
        self._rest = self._rest[-_MAX_LENGTH:]
        return [self._decode(piece) for piece in map(bytes.strip, pieces) if piece]

    @abstractmethod
    def _decode(self, piece: bytes) -> Text:
        """Decode one line or element."""


class SocketcandText(_AdapterText):
    """Elements `< ... >`."""

    delimiter = re.compile(rb"(?<=>)")

    def _decode(self, piece: bytes) -> Text:
        to_amplifier = self._direction == "amplifier"
        sent, fd_sent = (_SEND, _FD_SEND) if to_amplifier else (_FRAME, _FD_FRAME)
        found = sent.fullmatch(piece) or fd_sent.fullmatch(piece)
        if found is None:
            words = (b"send", b"fdsend", b"frame", b"fdframe")
            return Text(piece, None, piece[2:].split(b" ")[0] in words)
        is_fd = found.re is fd_sent
        if to_amplifier:
            data = bytes(int(byte, 16) for byte in found[3].split())
            good = len(data) == int(found[2])
        else:
            digits = found[2].replace(b" ", b"")
            good = len(digits) % 2 == 0
            data = bytes.fromhex(digits.decode()) if good else b""
        good = good and len(data) in (LENGTHS if is_fd else LENGTHS[:9])
        return Text(piece, CanFrame(int(found[1], 16), data, is_fd) if good else None, not good)


class SlcanText(_AdapterText):
    """Lines ended by CR, or BELL for refusals."""

    delimiter = re.compile(rb"[\r\a]")

    def _decode(self, piece: bytes) -> Text:
        found = _SLCAN.fullmatch(piece)
        if found is None:
            return Text(piece, None, piece[:1] in b"tdb")
        data = bytes.fromhex(found[4].decode())
        is_fd = found[1] != b"t"
        length = LENGTHS[int(found[3], 16)]
        if len(data) != length or (length > 8 and not is_fd):
            return Text(piece, None, True)
        return Text(piece, CanFrame(int(found[2], 16), data, is_fd), False)
