"""Captures, the bytes of wires as text, and violations of rules with the frames around them.

A line of a capture is a piece:

    TIME WIRE > HEX        toward the amplifier
    TIME WIRE < HEX        toward the host

TIME in seconds of any one clock; # begins a comment.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from drivers.errors import CommandError
from registry.files import regular_file

Direction: TypeAlias = Literal["amplifier", "host"]
"""Direction of transfer: toward the amplifier or the host."""
_MAX_LINE = 1 << 20  # characters
_ARROWS: dict[Direction, str] = {"amplifier": ">", "host": "<"}


class Piece(NamedTuple):
    """Bytes on a wire at a time [s]."""

    time: float
    wire: str
    direction: Direction
    data: bytes


def capture_line(time: float, wire: str, direction: Direction, data: bytes) -> str:
    """Return bytes as a line of a capture."""
    return f"{time:.6f} {wire} {_ARROWS[direction]} {data.hex(' ').upper()}"


def read_capture(path: Path, *, wires: Collection[str]) -> Iterator[Piece]:
    """Read the pieces of a capture in order; wires: the names that are allowed.

    Raises CommandError with file and line.
    """
    last = -math.inf
    try:
        with open(path, encoding="utf-8", errors="backslashreplace", opener=regular_file) as lines:
            # A line that is longer has no end, as in a sparse file, and no piece is as long.
            for number, line in enumerate(iter(partial(lines.readline, _MAX_LINE), ""), start=1):
                text = line.partition("#")[0].strip()
                if text:
                    piece = _piece(text, f"{path}:{number}", wires, last)
                    last = piece.time
                    yield piece
    except FileNotFoundError:
        raise CommandError(f"{path}: no such file; check its name") from None
    except OSError as problem:
        raise CommandError(f"{path}: cannot be read: {problem.strerror}") from problem


def _piece(text: str, where: str, wires: Collection[str], last: float) -> Piece:
    """Read a line behind one of a time [s]."""
    directions = {arrow: direction for direction, arrow in _ARROWS.items()}
    try:
        time, wire, arrow, digits = text.split(maxsplit=3)
        piece = Piece(float(time), wire, directions[arrow], bytes.fromhex(digits))
    except (ValueError, KeyError):
        raise CommandError(
            f"{where}: must be TIME WIRE > HEX (or <), as in 0.0125 wire1 > 00 02 01, got "
            f"{text[:60]!r}"
        ) from None
    if not last <= piece.time < math.inf:
        raise CommandError(
            f"{where}: time must be finite and not decrease, got {piece.time:g} s after {last:g} "
            "s; sort the lines, and use one clock for all wires"
        )
    if wire not in wires:
        raise CommandError(
            f"{where}: wire must be one of {', '.join(wires)} (by URL), got {wire!r}; give a URL "
            "for each wire of the capture"
        )
    return piece


ReportViolation: TypeAlias = Callable[[str, float, str], None]
"""Called with the rule, the time [s] and a sentence."""

_FRAMES_BEFORE, _FRAMES_AFTER = 6, 3
_MAX_VIOLATIONS = 200


@dataclass
class Violation:
    """A broken rule: its name, wire, time [s], a sentence, and the frames around it."""

    invariant: str
    wire: str
    time_s: float
    sentence: str
    frames: list[str]

    def __str__(self) -> str:
        """The violation as a paragraph."""
        head = f"{self.time_s:.6f} {self.wire}: {self.invariant}: {self.sentence}"
        return "\n".join((head, *(f"    {frame}" for frame in self.frames)))


class Report:
    """Collects violations, at most 200: those `found`."""

    def __init__(self) -> None:
        self.found: list[Violation] = []
        self._frames: dict[str, deque[str]] = {}  # by wire, the last
        self._followed: list[tuple[Violation, int]] = []  # and how many frames they will have

    def frame(self, wire: str, time: float, direction: Direction, raw: bytes) -> None:
        """Note a frame, and add it to the violations just before it."""
        line = capture_line(time, wire, direction, raw)
        self._frames.setdefault(wire, deque(maxlen=_FRAMES_BEFORE)).append(line)
        for violation, _ in self._followed:
            if violation.wire == wire:
                violation.frames.append(line)
        self._followed = [each for each in self._followed if len(each[0].frames) < each[1]]

    def add(self, wire: str, invariant: str, time: float, sentence: str) -> None:
        """Add a violation of a rule on a wire."""
        if len(self.found) < _MAX_VIOLATIONS:
            frames = [*self._frames.get(wire, ())]
            self.found.append(Violation(invariant, wire, time, sentence, frames))
            self._followed.append((self.found[-1], len(frames) + _FRAMES_AFTER))
