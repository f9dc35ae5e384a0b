"""Captures: the bytes of wires as text, a line a piece, to be witnessed later or elsewhere.

    TIME WIRE > HEX        toward the amplifier
    TIME WIRE < HEX        toward the host

TIME in seconds of any clock. What begins with # is for people. Serial sniffers with two ports, and
programs that read packets, are easily made to write this.
"""

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from model.errors import InputError
from sim.witness.decoded import Direction


class Piece(NamedTuple):
    """Some bytes on a wire at a time [s]."""

    time: float
    wire: str
    direction: Direction
    data: bytes


def read_capture(path: Path, *, wires: Collection[str] = ()) -> Iterator[Piece]:
    """The pieces of a capture in their order, on these wires only if any are named.

    InputError says in which line it is none.
    """
    last = -math.inf
    try:
        # What is no text is told of by its line, as everything that is no piece.
        with path.open(encoding="utf-8", errors="backslashreplace") as lines:
            for number, line in enumerate(lines, start=1):
                text = line.partition("#")[0].strip()
                if not text:
                    continue
                where = f"{path}, line {number}"
                piece = _piece(text, where)
                if piece.time < last:
                    raise InputError(
                        f"{where}: its time, {piece.time:g} s, is before the {last:g} s of the "
                        "line above; sort the lines by time, and let one clock tell all of them"
                    )
                if wires and piece.wire not in wires:
                    raise InputError(
                        f"{where}: {piece.wire!r} is none of the wires: the URLs given are "
                        f"{', '.join(wires)}, in their order; give a URL for each wire of the "
                        "capture, and name the wires in it so"
                    )
                last = piece.time
                yield piece
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check its name and folder") from None
    except OSError as problem:
        raise InputError(f"{path} cannot be read as a capture: {problem.strerror}") from problem


def _piece(text: str, where: str) -> Piece:
    arrows: dict[str, Direction] = {">": "amplifier", "<": "host"}
    parts = text.split(maxsplit=3)
    try:
        time, wire, arrow, digits = parts
        piece = Piece(float(time), wire, arrows[arrow], bytes.fromhex(digits))
    except (ValueError, KeyError):
        raise InputError(
            f"{where}: {text[:60]!r} is not TIME WIRE > HEX (or <), as in 0.0125 wire1 > 00 04 21"
        ) from None
    if not math.isfinite(piece.time):
        raise InputError(f"{where}: {parts[0]} is no time; write seconds, as in 0.0125")
    return piece
