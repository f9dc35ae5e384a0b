"""Fault injection: which fault is active on an amplifier or its wire, and when.

Fault files list fault windows:

    seed: 7                      # makes faults reproducible
    faults:
      - {fault: drop, at: 2, lasts: 10, share: 0.2}         # seconds
      - {fault: unplug, at: 15, lasts: 0.5, amplifier: main}

Faults of frames (drop, delay, duplicate, corrupt, truncate) apply to whole frames sent by the
amplifier, and to pieces of the stream received from the host. Not modeled: noise between frames,
collisions.
"""

import math
import random
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ValidationError

from model.config.document import read_document
from model.config.fields import Quantity, Section, Validation
from model.config.units import RATIO, TIME
from model.errors import InputError
from registry.wording import first_problem

FaultKind: TypeAlias = Literal[
    # of frames
    "drop",
    "delay",
    "duplicate",
    "corrupt",
    "truncate",
    "incomplete_set",  # frames of a set are lost, or the end of a single frame
    # of the wire
    "unplug",
    # of the amplifier
    "hang",  # neither replies nor acts
    "reboot",  # without supply until the end
    "nak_storm",  # rejects everything: BUSY
    "over_temperature",  # derated, from half of the time on a fault, cool at the end
    "over_voltage",
    "arc",
    "over_current",
    "channel",  # one channel fails
    "interlock",  # open until the end
]
Toward: TypeAlias = Literal["amplifier", "host"]
_DAMAGING = ("corrupt", "truncate", "incomplete_set")


class FaultWindow(Section):
    """A fault that is active from `at` for `lasts` [s], as a fault file has it.

    amplifier: None for all. For faults of frames: share: of affected frames, 0..1; toward: their
    direction, None for both; delay [s]: maximum, uniformly distributed.
    """

    fault: FaultKind
    at: Annotated[float, Quantity(TIME, at_least=0)] = 0.0
    lasts: Annotated[float, Quantity(TIME, above=0)] = math.inf
    amplifier: str | None = None
    share: Annotated[float, Quantity(RATIO, above=0, at_most=1)] = 1.0
    toward: Toward | None = None
    delay: Annotated[float, Quantity(TIME, above=0, at_most=10)] = 0.1

    @property
    def end(self) -> float:
        """Its end, on the scale of `at` [s]."""
        return self.at + self.lasts


@dataclass
class Faults:
    """Faults of an amplifier and its wire; begin: origin of the windows' time scale [s].

    The same seed gives the same faults.
    """

    windows: Sequence[FaultWindow] = ()
    begin: float = 0.0
    seed: int = 0
    _random: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)  # noqa: S311  reproducible, not secret

    def now(self, fault: FaultKind, time: float) -> bool:
        """Whether a fault is active at a time [s]."""
        return any(self._is_on(window, time) for window in self.windows if window.fault == fault)

    def pass_on(
        self, frame: bytes, *, toward: Toward, time: float, finds_damage: bool = False
    ) -> list[tuple[float, bytes]]:
        """Delivered pieces of a frame sent at a time [s], each with its delay [s].

        No fault changes an empty frame, which ends a connection. finds_damage: whether the wire
        itself discards damaged data, like TCP.
        """
        pieces = [(0.0, frame)]
        if not frame:
            return pieces
        for window in self.windows:
            is_active = self._is_on(window, time) and window.toward in (None, toward)
            if not is_active or self._random.random() >= window.share:
                continue
            if finds_damage and window.fault in _DAMAGING:
                return []
            pieces = self._apply(window, pieces, toward)
            pieces = [(delay, data) for delay, data in pieces if data]
        return pieces

    def _apply(
        self, window: FaultWindow, pieces: list[tuple[float, bytes]], toward: Toward
    ) -> list[tuple[float, bytes]]:
        """Apply a fault to the pieces of a frame, each with its delay [s]."""
        if window.fault == "drop":
            return []
        if window.fault == "duplicate":
            return pieces * 2
        is_cut = window.fault == "truncate"
        is_cut |= window.fault == "incomplete_set" and toward == "amplifier"
        changed = []
        for delay, data in pieces:
            if window.fault == "delay":
                delay += self._random.uniform(0, window.delay)
            elif window.fault == "corrupt":
                data = self._corrupt(data)
            elif is_cut:
                data = self._cut(data)
            changed.append((delay, data))
        return changed

    def _corrupt(self, data: bytes) -> bytes:
        """Flip one to three bits."""
        damaged = bytearray(data)
        for _ in range(self._random.randint(1, 3)):
            bit = self._random.randrange(8 * len(damaged))
            damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    def _cut(self, data: bytes) -> bytes:
        """Drop the end, at a random position."""
        return data[: self._random.randrange(len(data))]

    def _is_on(self, window: FaultWindow, time: float) -> bool:
        return window.at <= time - self.begin < window.end


class FaultFile(Section):
    """Fault windows for the amplifiers of a rig."""

    seed: int = 0
    faults: list[FaultWindow]

    def of(self, amplifier: str, *, begin: float) -> Faults:
        """Return the faults of an amplifier; begin: origin of their time scale [s]."""
        windows = [window for window in self.faults if window.amplifier in (None, amplifier)]
        return Faults(windows, begin=begin, seed=self.seed)


def load_faults(path: Path, *, amplifiers: Collection[str]) -> FaultFile:
    """Read a fault file; raises ConfigError with every problem, by file, line and key."""
    document = read_document(path)
    validation = Validation(document, FaultFile)
    entries = document.data.get("faults")
    if not isinstance(entries, list):
        return validation.finish()
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict):
            continue
        name = entry.get("amplifier")
        if isinstance(name, str) and name not in amplifiers:
            names = ", ".join(sorted(amplifiers))
            validation.add(("faults", number, "amplifier"), f"must be one of {names}, got {name!r}")
    return validation.finish()


def parse_fault(values: Mapping[str, Any]) -> FaultWindow:
    """Parse one fault, with the keys of a fault file; raises InputError."""
    try:
        return FaultWindow.model_validate(dict(values))
    except ValidationError as error:
        key, problem = first_problem(error)
        raise InputError(f"{key}: {problem}") from None
