"""Violations of rules, each with the frames around it."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from sim.witness.capture import Direction

ReportViolation: TypeAlias = Callable[[str, float, str], None]
"""Called with the rule, the time [s] and a sentence."""

_FRAMES_BEFORE, _FRAMES_AFTER = 6, 3
_MAX_VIOLATIONS = 200


@dataclass(frozen=True)
class Violation:
    """A broken rule: its name, wire, time [s], a sentence, and the frames around it."""

    invariant: str
    wire: str
    time: float
    sentence: str
    frames: tuple[str, ...] = ()

    def __str__(self) -> str:
        """The violation as a paragraph."""
        head = f"{self.time:.6f} {self.wire}: {self.invariant}: {self.sentence}"
        return "\n".join((head, *(f"    {frame}" for frame in self.frames)))


def format_frame(time: float, direction: Direction, raw: bytes) -> str:
    """One frame as a line of a capture."""
    return f"{time:.6f} {'>' if direction == 'amplifier' else '<'} {raw.hex(' ').upper()}"


class Report:
    """Collects violations, at most 200; further ones are counted in `dropped`."""

    def __init__(self) -> None:
        self.dropped = 0
        self._found: list[Violation] = []
        self._frames: dict[str, deque[tuple[float, Direction, bytes]]] = {}
        self._incomplete: dict[int, int] = {}  # by index: frames still to be added

    def frame(self, wire: str, time: float, direction: Direction, raw: bytes) -> None:
        """Note a frame, and add it to the violations just before it."""
        self._frames.setdefault(wire, deque(maxlen=_FRAMES_BEFORE)).append((time, direction, raw))
        if not self._incomplete:
            return
        line = format_frame(time, direction, raw)
        for index in [index for index in self._incomplete if self._found[index].wire == wire]:
            violation = self._found[index]
            self._found[index] = replace(violation, frames=(*violation.frames, line))
            self._incomplete[index] -= 1
            if not self._incomplete[index]:
                del self._incomplete[index]

    def add(self, invariant: str, wire: str, time: float, sentence: str) -> None:
        """Add a violation of a rule."""
        if len(self._found) >= _MAX_VIOLATIONS:
            self.dropped += 1
            return
        frames = tuple(format_frame(*frame) for frame in self._frames.get(wire, ()))
        self._incomplete[len(self._found)] = _FRAMES_AFTER
        self._found.append(Violation(invariant, wire, time, sentence, frames))

    @property
    def found(self) -> list[Violation]:
        """The violations so far, in order."""
        return list(self._found)
