"""Captures of TUIO: text files with the datagrams of a sender and their times, for replay.

    # era-haptics TUIO capture 1
    0.000000 2362756e646c6500...
    0.016667 2362756e646c6500...

Each line has the seconds from the start and the datagram in hexadecimal; other lines starting
with # are comments. Malformed datagrams are kept as received.
"""

import re
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import TextIO

from controller.sources.udp_source import MAX_DATAGRAM
from model.errors import InputError
from registry.files import LineTooLong, lines_of, open_regular

HEADER = "# era-haptics TUIO capture 1"
_LINE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ((?:[0-9a-f]{2})+)", re.ASCII | re.IGNORECASE)
_MAX_LINE = 1 << 18  # characters; a datagram has up to 64 KiB, two digits per byte
MAX_BYTES = 16 << 20  # 100 s of ten fingers at 100 Hz, or 15 min of one finger


@dataclass(frozen=True, slots=True)
class RecordedDatagram:
    """A datagram of a capture."""

    time: float
    """Time sent [s] from the start."""
    payload: bytes


def read_capture(path: Path | str) -> list[RecordedDatagram]:
    """Read a capture; raises InputError with file and line."""
    path = Path(path)
    try:
        with (
            open_regular(path, MAX_BYTES) as file,
            TextIOWrapper(file, "utf-8-sig", newline=None) as stream,
        ):
            return _datagrams_in(path, stream)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path, which is relative to the "
            "working directory, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be a TUIO capture, got a binary file") from error
    except LineTooLong as error:
        raise InputError(f"{path}, line {error.line}: {error} of a TUIO capture") from error


def _datagrams_in(path: Path, stream: TextIO) -> list[RecordedDatagram]:
    """Return the datagrams of an open capture; raises InputError."""
    lines = lines_of(stream, _MAX_LINE)
    if next(lines, "") != HEADER:
        raise InputError(f"{path}, line 1: must be {HEADER!r} for a TUIO capture")
    datagrams: list[RecordedDatagram] = []
    for number, line in enumerate(lines, start=2):
        if line.startswith("#") or not line.strip():
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(
                f"{path}, line {number}: must be seconds, a space and the datagram in "
                f"hexadecimal, got {line[:60]!r}"
            )
        seconds, digits = match.groups()
        datagram = RecordedDatagram(float(seconds), bytes.fromhex(digits))
        size = len(datagram.payload)
        if size > MAX_DATAGRAM:
            raise InputError(
                f"{path}, line {number}: datagram must have at most {MAX_DATAGRAM} bytes, got "
                f"{size}"
            )
        if datagrams and datagram.time < datagrams[-1].time:
            raise InputError(f"{path}, line {number}: times must not decrease")
        datagrams.append(datagram)
    if not datagrams:
        raise InputError(f"{path}: capture must contain datagrams")
    return datagrams
