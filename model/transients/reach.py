"""From which frequency a rig reaches a level over its plate, and where it falls short.

At each place, as the mean over a finger that rests there, all actuators are in phase at full level,
or at the share of it that the rig's limits and the excursion of the magnets allow answers.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.arrays import FloatArray, lattice
from model.finger import FIVE_POINTS, STRONG_DB_SL, decibels, detection_threshold, fingertips_on
from model.reduction.free_plate import FreePlate
from model.rig.rig import Rig
from model.transients.excursions import magnets_of

MARGIN = 0.02
"""Strip along the edges [m] that is left out."""

UP_TO, STEP = 300.0, 10.0
"""Up to where frequencies are compared, and their step [Hz]."""

_SPACING = 0.012  # m
_AT_ONCE = 40  # places


@dataclass(frozen=True, eq=False)
class Reach:
    """Least level [dB SL] over the plate (f,) at frequencies (f,) [Hz], and the share of places.

    shares (f,): of the places that reach `STRONG_DB_SL`.
    """

    frequencies: FloatArray
    least_db_sl: FloatArray
    shares: FloatArray

    @property
    def start(self) -> float | None:
        """The lowest frequency [Hz] at which all places reach the level; None where none does."""
        whole = self.frequencies[self.shares == 1]
        return float(whole[0]) if len(whole) else None

    @property
    def falls_short(self) -> dict[float, float]:
        """Share of the places that reach the level, by frequency above the start [Hz]."""
        pairs = zip(self.frequencies.tolist(), self.shares.tolist(), strict=True)
        start = -np.inf if self.start is None else self.start
        return {frequency: share for frequency, share in pairs if share < 1 and frequency > start}

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "level_db_sl": STRONG_DB_SL,
            "from_hz": self.start,
            "frequencies_hz": self.frequencies.tolist(),
            "least_level_db_sl": self.least_db_sl.round(2).tolist(),
            "share_of_places": self.shares.round(4).tolist(),
        }


def reach_of(rig: Rig, free: FreePlate) -> Reach:
    """Reach of a rig as its file has it up to UP_TO within its limits; free: its plate."""
    plate, limits = rig.plate, rig.limits
    low = limits.frequency_min
    frequencies = np.arange(low, min(limits.frequency_max, max(UP_TO, low)) + 1e-9, STEP)
    margins = [(side, min(MARGIN, side / 4)) for side in (plate.length, plate.width)]
    places = lattice(
        *(
            np.linspace(edge, side - edge, 1 + math.ceil((side - 2 * edge) / _SPACING))
            for side, edge in margins
        )
    )
    level = np.minimum(magnets_of(rig, free).shares(frequencies), limits.level)[:, None]
    threshold = detection_threshold(frequencies, rig.threshold)[:, None]
    found = []
    for few in np.array_split(places, math.ceil(len(places) / _AT_ONCE)):
        points, weights = fingertips_on(
            few, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        fields = free.acceleration(
            rig.eras, frequencies, points.reshape(-1, 2), loads=rig.masses
        ).reshape(len(frequencies), len(rig.eras), *weights.shape)
        phases = fields[..., 0].conj() / np.abs(fields[..., 0])
        together = np.abs((fields * phases[..., None]).sum(axis=1))
        felt = level * (together * weights).sum(axis=-1)
        found.append(felt / _held(rig, free, few, frequencies) / threshold)
    levels = decibels(np.concatenate(found, axis=1))
    return Reach(frequencies, levels.min(axis=1), (levels >= STRONG_DB_SL).mean(axis=1))


def _held(rig: Rig, free: FreePlate, places: FloatArray, frequencies: FloatArray) -> FloatArray:
    """By which factor a finger at a place lowers the motion there, 1 + D R of either, (f, p)."""
    if rig.fingertip is None:
        return np.ones((len(frequencies), len(places)))
    attached = (*rig.eras, *rig.masses)
    between, _ = free.receptances(places, places[:1], frequencies, loads=attached)
    stiffness = rig.fingertip.dynamic_stiffness(2 * np.pi * frequencies)
    own = np.diagonal(between, axis1=-2, axis2=-1)
    return np.abs(1 + stiffness[:, None] * own)
