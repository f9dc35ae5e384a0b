"""How a vibration lies over the plate: how much of it is near its targets?

Where nobody is to be kept quiet, a pattern is chosen by how far its targets stand out of the root
mean square of the plate. That does not say whether the rest is a few loud places or a little
everywhere, nor how large the place is that vibrates: what is here does.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, lattice
from model.finger.contrast import is_beyond
from model.finger.fingertip import fingertip_points
from model.finger.perception import decibels
from model.structure.plate import Plate
from model.table.pattern import Pattern, Spread
from model.table.question import Question
from model.table.table import LocalizationTable

SPACING = 0.0025  # m; the edge of a circle of 50 mm is met to a percent of its area
PERCENTILE = 95


def with_spread(table: LocalizationTable, question: Question, pattern: Pattern) -> Pattern:
    """The pattern with its spread; not where fingers are to be kept quiet. Some milliseconds."""
    if question.quiet:
        return pattern
    discs = [fingertip_points(*target, table.plate) for target in question.targets]
    felt = [table.amplitudes(pattern.excitation, disc)[1].sum(axis=0).mean() for disc in discs]
    points = middles(table.plate)
    frequencies, amplitudes = table.amplitudes(pattern.excitation, points)
    near = ~is_beyond(points, question.targets)
    spread = spread_of(frequencies, amplitudes, near, felt=min(felt), plate=table.plate)
    return replace(pattern, spread=spread)


def middles(plate: Plate) -> FloatArray:
    """Middles [m] of small fields, all of one size, that fill the plate: (p, 2)."""
    count_x, count_y = (max(1, round(side / SPACING)) for side in (plate.length, plate.width))
    x = np.linspace(0, plate.length, 2 * count_x + 1)[1::2]
    y = np.linspace(0, plate.width, 2 * count_y + 1)[1::2]
    return lattice(x, y)


def spread_of(
    frequencies: FloatArray,
    amplitudes: FloatArray,
    near: NDArray[np.bool_],
    *,
    felt: float,
    plate: Plate,
) -> Spread:
    """The spread of a vibration: frequencies (f,) [Hz], amplitudes (f, p) [m/s²] at the middles.

    near (p,): which of these are near a target; felt [m/s²]: what the targets feel. Energy is
    kinetic, of a plate that weighs the same everywhere. On a plate that is near its targets all
    over, contrast is to all of it.
    """
    peak = amplitudes.sum(axis=0)
    around = peak if near.all() else peak[~near]
    energy = ((amplitudes.T / frequencies) ** 2).sum(axis=1)
    return Spread(
        contrast_95_db=float(decibels(felt / np.percentile(around, PERCENTILE))),
        area_above_half=float((peak > felt / 2).mean()) * plate.length * plate.width,
        energy_share_near=float(energy[near].sum() / energy.sum()),
    )
