"""Faults on demand: what goes wrong with an amplifier and its wire, and when.

What happens to telegrams (drop, delay, duplicate, corrupt, truncate) is decided here for every
wire, whatever its telegrams are: whole frames going out, pieces of the stream as they come in.

Not modelled: noise between telegrams, collisions of two senders.
"""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

FaultKind: TypeAlias = Literal[
    # of telegrams
    "drop",
    "delay",
    "duplicate",
    "corrupt",
    "truncate",
    "incomplete_set",  # of a set in several frames some are lost, of one in one frame the end
    # of the wire
    "unplug",
    # of the amplifier
    "hang",  # nothing is answered, and nothing done
    "reboot",  # the supply is lost at once; it comes back at the end
    "nak_storm",  # everything is refused: busy
    "over_temperature",  # derated from the begin, a fault halfway, cool at the end
    "over_voltage",
    "arc",
    "channel",  # one channel has failed
]
Toward: TypeAlias = Literal["amplifier", "host"]


@dataclass(frozen=True)
class FaultWindow:
    """One fault from `at` [s after the begin] on, for `lasts` [s].

    amplifier: whose; None for all. Of telegrams: share, how many of them, 0..1; toward: in which
    direction, None for both; delay [s], at most, evenly spread.
    """

    fault: FaultKind
    at: float = 0.0
    lasts: float = math.inf
    amplifier: str | None = None
    share: float = 1.0
    toward: Toward | None = None
    delay: float = 0.1

    @property
    def end(self) -> float:
        """When it is over [s after the begin]."""
        return self.at + self.lasts


@dataclass
class Faults:
    """What goes wrong with one amplifier and its wire, by a clock that is handed in.

    begin [s] of that clock: from when the windows count. The same seed gives the same faults.
    """

    windows: Sequence[FaultWindow] = ()
    begin: float = 0.0
    seed: int = 0
    _random: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)  # noqa: S311  to be repeated, not to be secret

    def now(self, fault: FaultKind, time: float) -> bool:
        """Whether a fault is on at a time [s]."""
        return any(self._is_on(window, time) for window in self.windows if window.fault == fault)

    def pass_on(self, telegram: bytes, *, toward: Toward, time: float) -> list[tuple[float, bytes]]:
        """What arrives of a telegram that is sent at a time [s], and how much later [s]."""
        arriving = [(0.0, telegram)]
        for window in self.windows:
            hit = self._is_on(window, time) and window.toward in (None, toward)
            if hit and self._random.random() < window.share:
                arriving = self._apply(window, arriving, toward)
                arriving = [(delay, data) for delay, data in arriving if data]  # cut to nothing
        return arriving

    def _apply(
        self, window: FaultWindow, arriving: list[tuple[float, bytes]], toward: Toward
    ) -> list[tuple[float, bytes]]:
        match window.fault:
            case "drop":
                return []
            case "delay":
                return [(d + self._random.uniform(0, window.delay), data) for d, data in arriving]
            case "duplicate":
                return arriving * 2
            case "corrupt":
                return [(delay, self._corrupt(data)) for delay, data in arriving]
            case "truncate":
                return [(delay, self._cut(data)) for delay, data in arriving]
            case "incomplete_set" if toward == "amplifier":
                return [(delay, self._cut(data)) for delay, data in arriving]
            case _:
                return arriving

    def _corrupt(self, data: bytes) -> bytes:
        """One to three flipped bits."""
        damaged = bytearray(data)
        for _ in range(self._random.randint(1, 3)):
            bit = self._random.randrange(8 * len(damaged))
            damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    def _cut(self, data: bytes) -> bytes:
        return data[: self._random.randrange(len(data))]

    def _is_on(self, window: FaultWindow, time: float) -> bool:
        return window.at <= time - self.begin < window.end
