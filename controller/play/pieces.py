"""Pieces of a course: what of it goes out at once, as an onset of knots, or as a plain ramp.

An amplifier plays a piece along straight lines between its knots, and holds one more that waits for
the end of the first: so pieces follow each other without a gap though the host is late, by half a
piece at most. The first is short, since a touch waits for it.
"""

import math
from dataclasses import dataclass

import numpy as np

from controller.play.intent import Pulse
from model.answer.stimulus import KNOT_STEP, Course

PLAIN_STEP = 0.050
"""Time [s] of ramps, where amplifiers have no knots, of which each is a set of its own."""

HELD = 0.1
"""How long [s] a layer lasts beyond its last piece: if no other comes by then it ends by itself."""

_AMID = 0.020  # s; between knots of a first piece that leads there from something else
_FIRST, _NEXT, _SHORTEST = 0.16, 0.32, 0.12  # s; of pieces, the last one where knots are few

MAX_STEP = _SHORTEST / 2
"""Time [s] between knots where an envelope has one."""

_ROUNDING = 1e-9  # s


@dataclass(frozen=True)
class Piece:
    """Shares of a course a step [s] apart, the first one a step after its start."""

    step: float
    shares: tuple[float, ...]

    @property
    def duration(self) -> float:
        """Time of its last share [s]."""
        return self.step * len(self.shares)

    @property
    def has_knots(self) -> bool:
        """Whether it is more than a ramp."""
        return len(self.shares) > 1


def piece_of(course: Course, pulse: Pulse, since: float, *, knots: int, is_first: bool) -> Piece:
    """Return the piece of a course that is played from a time [s] after the start of its pulse on.

    It begins anew until the pulse ends, at 0. knots: of an envelope, 0 for ramps; is_first: of its
    layer.
    """
    if not knots:
        step, count = PLAIN_STEP, 1
    else:
        least = _AMID if is_first and since > 0 else KNOT_STEP
        count = min(knots + 1, round((_FIRST if is_first else _NEXT) / least))
        step = max(least, _SHORTEST / count)
        left = min((pulse.duration - since) / step, count)
        count = max(math.ceil(left - _ROUNDING), 2)
    times = since + step * np.arange(1, count + 1)
    shares = np.asarray(course.at(np.mod(times, course.duration)))
    shares[times > pulse.duration - _ROUNDING] = 0.0
    return Piece(step, tuple(shares.tolist()))
