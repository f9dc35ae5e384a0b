"""Captures: the bytes of wires as text, one line per piece.

    TIME WIRE > HEX        toward the amplifier
    TIME WIRE < HEX        toward the host

TIME in seconds of any one clock; # begins a comment.
"""

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from model.errors import InputError
from model.files.regular_file import regular_file

Direction: TypeAlias = Literal["amplifier", "host"]
"""Direction of transfer: toward the amplifier or the host."""


class Piece(NamedTuple):
    """Bytes on a wire at a time [s]."""

    time: float
    wire: str
    direction: Direction
    data: bytes


def read_capture(path: Path, *, wires: Collection[str] = ()) -> Iterator[Piece]:
    """Read the pieces of a capture in order; wires: the names that are allowed, any if empty.

    Raises InputError with file and line.
    """
    last = -math.inf
    try:
        with open(path, encoding="utf-8", errors="backslashreplace", opener=regular_file) as lines:
            for number, line in enumerate(lines, start=1):
                text = line.partition("#")[0].strip()
                if not text:
                    continue
                where = f"{path}:{number}"
                piece = _piece(text, where)
                if piece.time < last:
                    raise InputError(
                        f"{where}: time must not decrease, got {piece.time:g} s after {last:g} s; "
                        "sort the lines, and use one clock for all wires"
                    )
                if wires and piece.wire not in wires:
                    raise InputError(
                        f"{where}: wire must be one of {', '.join(wires)} (by URL), "
                        f"got {piece.wire!r}; give a URL for each wire of the capture"
                    )
                last = piece.time
                yield piece
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check its name") from None
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from problem


def _piece(text: str, where: str) -> Piece:
    arrows: dict[str, Direction] = {">": "amplifier", "<": "host"}
    parts = text.split(maxsplit=3)
    try:
        time, wire, arrow, digits = parts
        piece = Piece(float(time), wire, arrows[arrow], bytes.fromhex(digits))
    except (ValueError, KeyError):
        raise InputError(
            f"{where}: must be TIME WIRE > HEX (or <), as in 0.0125 wire1 > 00 02 01, got "
            f"{text[:60]!r}"
        ) from None
    if not math.isfinite(piece.time):
        raise InputError(f"{where}: time must be finite seconds, got {parts[0]}")
    return piece
