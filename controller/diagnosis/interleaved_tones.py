"""Interleaved tones: every ERA plays at the same time, each at a frequency of its own.

The range is cut into as many bands as ERAs play at once. In each step every band sounds at the same
place within it, so that the tones of a step are a band apart; from step to step the ERAs take turns
over the bands. One round plays every tone once; as many rounds as ERAs play it on each of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.time_response import plate_in_time

WINDOW = 0.2  # s; of a reading: 1 % of noise is enough, and shorter ones hear more of it
_TONES = 28  # over the range; theory in doubt asks for more, gains and springs for ten
_PER_BAND = 2  # at least
_AT_ONCE = 16  # tones of a reading
_MARGIN = 1.01  # of a window, for frequencies as amplifiers round them
# Of a vibration, where a plate counts as settled: readings tell the rest from their tones.
_LEFT = 0.02
_SETTLING = (0.2, 1.0)  # s, least and most

Step = tuple[tuple[int, float], ...]
"""Number of each ERA that plays, and its frequency [Hz]."""


@dataclass(frozen=True)
class ToneSchedule:
    """Steps of interleaved tones; settling, window [s]: of each step."""

    steps: tuple[Step, ...]
    settling: float
    window: float


def interleaved(
    rig: Rig, frequency_range: tuple[float, float], *, is_quick: bool = False
) -> ToneSchedule:
    """Tones over a range [Hz] for a rig; is_quick: one round only."""
    low, high = frequency_range
    steps: list[Step] = []
    closest = high
    numbers = range(len(rig.eras))
    for first in range(0, len(numbers), _AT_ONCE):
        group = numbers[first : first + _AT_ONCE]
        own, apart = _rounds(group, low, high, count=1 if is_quick else len(group))
        steps += own
        closest = min(closest, apart)
    window = max(WINDOW, _MARGIN / closest, _MARGIN / low)
    return ToneSchedule(tuple(steps), settling(rig, frequency_range), window)


def _rounds(
    eras: Sequence[int], low: float, high: float, *, count: int
) -> tuple[list[Step], float]:
    """Rounds of a group of ERAs, and how far apart [Hz] tones of a step are."""
    n = len(eras)
    length = max(_PER_BAND, _TONES // n)
    bands = np.linspace(low, high, n * length).reshape(n, length)
    steps = [
        tuple((era, float(bands[(j + place + number) % n, place])) for j, era in enumerate(eras))
        for number in range(count)
        for place in range(length)
    ]
    return steps, float(bands[-1, 0] - bands[-2, 0]) if n > 1 else high


def settling(rig: Rig, frequency_range: tuple[float, float]) -> float:
    """Time [s] until what rings within a range [Hz] has died away, on the rig as written."""
    low, high = frequency_range
    loads = list(rig.masses)
    points = footprints_of(rig.eras, loads)
    reduced = reduce_plate(rig.plate, rig.mesh, points, frequency_max=high)
    decay = plate_in_time(reduced, rig.eras, loads=loads).decay
    heard = decay[(decay.imag >= 2 * np.pi * low) & (decay.imag <= 2 * np.pi * high)]
    slowest = float(heard.real.max()) if len(heard) else -np.inf
    return float(np.clip(np.log(_LEFT) / slowest, *_SETTLING))
