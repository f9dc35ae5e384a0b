"""Captures: the bytes of wires as text, a line a piece, to be witnessed later or elsewhere.

    TIME WIRE > HEX        toward the amplifier
    TIME WIRE < HEX        toward the host

TIME in seconds of any clock. What begins with # is for people. Serial sniffers with two ports, and
programs that read packets, are easily made to write this.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from model.errors import InputError
from sim.witness.seen import Toward


class Piece(NamedTuple):
    """Some bytes on a wire at a time [s]."""

    time: float
    wire: str
    toward: Toward
    data: bytes


def read_capture(path: Path) -> Iterator[Piece]:
    """The pieces of a capture in their order; InputError says in which line it is none."""
    last = -math.inf
    try:
        with path.open(encoding="utf-8") as lines:
            for number, line in enumerate(lines, start=1):
                text = line.partition("#")[0].strip()
                if not text:
                    continue
                piece = _piece(text, f"{path}, line {number}")
                if piece.time < last:
                    raise InputError(f"{path}, line {number}: its time is before the line above")
                last = piece.time
                yield piece
    except (OSError, UnicodeDecodeError) as problem:
        raise InputError(f"{path} cannot be read as a capture: {problem}") from problem


def _piece(text: str, where: str) -> Piece:
    arrows: dict[str, Toward] = {">": "amplifier", "<": "host"}
    parts = text.split(maxsplit=3)
    try:
        time, wire, arrow, digits = parts
        piece = Piece(float(time), wire, arrows[arrow], bytes.fromhex(digits))
    except (ValueError, KeyError):
        raise InputError(
            f"{where}: {text[:60]!r} is not TIME WIRE > HEX (or <), as in 0.0125 line > 00 04 21"
        ) from None
    if not math.isfinite(piece.time):
        raise InputError(f"{where}: {parts[0]} is no time")
    return piece
