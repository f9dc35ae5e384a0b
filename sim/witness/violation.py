"""Violations of rules, each with the frames around it."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from sim.witness.capture import Direction, capture_line

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

    def add(self, invariant: str, wire: str, time: float, sentence: str) -> None:
        """Add a violation of a rule."""
        if len(self.found) < _MAX_VIOLATIONS:
            frames = [*self._frames.get(wire, ())]
            self.found.append(Violation(invariant, wire, time, sentence, frames))
            self._followed.append((self.found[-1], len(frames) + _FRAMES_AFTER))
