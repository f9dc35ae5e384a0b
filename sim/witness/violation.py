"""What was wrong, and the frames around it."""

from collections import deque
from dataclasses import dataclass, replace

from sim.witness.decoded import Direction

_BEFORE, _AFTER = 6, 3
_MOST = 200


@dataclass(frozen=True)
class Violation:
    """A broken rule: its name, on which wire, when [s], one sentence, and the frames around it."""

    invariant: str
    wire: str
    time: float
    sentence: str
    frames: tuple[str, ...] = ()

    def __str__(self) -> str:
        """A paragraph for people."""
        head = f"{self.time:.6f} {self.wire}: {self.invariant}: {self.sentence}"
        return "\n".join((head, *(f"    {frame}" for frame in self.frames)))


def shown(time: float, direction: Direction, raw: bytes) -> str:
    """One frame as a line of a capture."""
    return f"{time:.6f} {'>' if direction == 'amplifier' else '<'} {raw.hex(' ').upper()}"


class Report:
    """Collects violations, each with the frames before it and after; 200 at most."""

    def __init__(self) -> None:
        self.dropped = 0
        self._found: list[Violation] = []
        self._frames: dict[str, deque[tuple[float, Direction, bytes]]] = {}
        self._open: dict[int, int] = {}  # by number in the list: frames that are still wanted

    def frame(self, wire: str, time: float, direction: Direction, raw: bytes) -> None:
        """A frame has passed."""
        self._frames.setdefault(wire, deque(maxlen=_BEFORE)).append((time, direction, raw))
        if not self._open:
            return
        line = shown(time, direction, raw)
        for number in [number for number in self._open if self._found[number].wire == wire]:
            one = self._found[number]
            self._found[number] = replace(one, frames=(*one.frames, line))
            self._open[number] -= 1
            if not self._open[number]:
                del self._open[number]

    def add(self, invariant: str, wire: str, time: float, sentence: str) -> None:
        """A rule was broken."""
        if len(self._found) >= _MOST:
            self.dropped += 1
            return
        frames = tuple(shown(*frame) for frame in self._frames.get(wire, ()))
        self._open[len(self._found)] = _AFTER
        self._found.append(Violation(invariant, wire, time, sentence, frames))

    @property
    def found(self) -> list[Violation]:
        """All so far, in the order in which they were found."""
        return list(self._found)
