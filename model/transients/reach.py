"""Levels that a rig reaches over its whole plate, by frequency.

At each position (mean over a resting finger) all actuators add in phase, at full level, or at the
fraction that the rig's limits and the excursion of its magnets allow.
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

UP_TO, _STEP = 300.0, 10.0
"""Highest frequency of a reach, and the step of frequencies [Hz]."""

_MARGIN = 0.02
"""Width of the strip along the edges [m] that is left out."""

_SPACING = 0.012  # m
_BATCH = 40  # positions solved together


@dataclass(frozen=True, eq=False)
class Reach:
    """Levels that a rig reaches over its plate."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    least_db_sl: FloatArray
    """Least level over the plate (f,)."""
    shares: FloatArray
    """Share (f,) of the positions that reach STRONG_DB_SL."""

    @property
    def start(self) -> float | None:
        """Lowest frequency [Hz] above which all positions reach the level, None without one."""
        whole = self.frequencies[self.shares == 1]
        return float(whole[0]) if len(whole) else None

    def as_json(self) -> dict[str, Any]:
        """Return the reach for programs."""
        return {
            "level_db_sl": STRONG_DB_SL,
            "from_hz": self.start,
            "frequencies_hz": self.frequencies.tolist(),
            "least_level_db_sl": self.least_db_sl.round(2).tolist(),
            "share_of_places": self.shares.round(4).tolist(),
        }


def reach_of(rig: Rig, free: FreePlate) -> Reach:
    """Compute the reach of a rig within its limits, up to UP_TO; free: the rig's plate."""
    plate = rig.plate
    limits = rig.limits
    low = limits.frequency_min
    high = min(limits.frequency_max, max(UP_TO, low))
    frequencies = np.arange(low, high + 1e-9, _STEP)
    positions = lattice(_positions_along(plate.length), _positions_along(plate.width))
    shares = magnets_of(rig, free).shares(frequencies)
    levels = np.minimum.outer(shares, _highest_levels(rig))
    threshold = detection_threshold(frequencies, rig.threshold)[:, None]
    ratios = list[FloatArray]()
    for batch in np.array_split(positions, math.ceil(len(positions) / _BATCH)):
        points, weights = fingertips_on(
            batch, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        fields = free.acceleration(rig.eras, frequencies, points.reshape(-1, 2), loads=rig.masses)
        fields = fields.reshape(len(frequencies), len(rig.eras), *weights.shape)
        at_center = fields[..., 0]
        phases = at_center.conj() / np.abs(at_center)
        in_phase = fields * phases[..., None]
        driven = np.abs(np.einsum("fn,fnpw->fpw", levels, in_phase))
        felt = (driven * weights).sum(axis=-1)
        ratios.append(felt / _finger_reductions(rig, free, batch, frequencies) / threshold)
    levels_db_sl = decibels(np.concatenate(ratios, axis=1))
    return Reach(
        frequencies=frequencies,
        least_db_sl=levels_db_sl.min(axis=1),
        shares=(levels_db_sl >= STRONG_DB_SL).mean(axis=1),
    )


def _highest_levels(rig: Rig) -> FloatArray:
    """Return the levels (n,) that the limits allow each ERA if all play at the same time.

    The ERAs of an amplifier share its power equally.
    """
    amplifiers = [rig.wiring[era.name].amplifier for era in rig.eras]
    counts = np.array([amplifiers.count(amplifier) for amplifier in amplifiers])
    return np.minimum(rig.limits.level, np.sqrt(rig.limits.power / counts))


def _positions_along(side: float) -> FloatArray:
    """Return evenly spaced positions (n,) along a side, all in [m], without its ends."""
    margin = min(_MARGIN, side / 4)
    count = 1 + math.ceil((side - 2 * margin) / _SPACING)
    return np.linspace(margin, side - margin, count)


def _finger_reductions(
    rig: Rig, free: FreePlate, positions: FloatArray, frequencies: FloatArray
) -> FloatArray:
    """Return the factor (f, p) by which a finger reduces the motion at its position, 1 + D R."""
    if rig.fingertip is None:
        return np.ones((len(frequencies), len(positions)))
    attached = (*rig.eras, *rig.masses)
    between, _ = free.receptances(positions, positions[:1], frequencies, loads=attached)
    stiffness = rig.fingertip.dynamic_stiffness(2 * np.pi * frequencies)
    receptance = np.diagonal(between, axis1=-2, axis2=-1)
    return np.abs(1 + stiffness[:, None] * receptance)
