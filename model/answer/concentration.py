"""Concentration of a vibration near its targets, over the whole plate."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.answer.pattern import Concentration, Pattern
from model.answer.question import Question
from model.arrays import FloatArray, lattice
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import decibels, is_beyond
from model.structure.plate import Plate
from model.table.table import LocalizationTable

SPACING = 0.0025  # m; resolves the area of a circle of 50 mm to a percent
PERCENTILE = 95


def with_concentration(table: LocalizationTable, question: Question, pattern: Pattern) -> Pattern:
    """Add the concentration to a pattern without quiet fingers; takes some milliseconds."""
    if question.quiet:
        return pattern
    contacts, loads = question.targets, question.loads
    felt = []
    for target in contacts:
        disc = fingertip_points(*target, table.plate)
        _, tones = table.amplitudes(pattern.excitation, disc, contacts=contacts, loads=loads)
        felt.append(tones.sum(axis=0) @ fingertip_weights(*target, table.plate))
    points = cell_centres(table.plate)
    frequencies, amplitudes = table.amplitudes(
        pattern.excitation, points, contacts=contacts, loads=loads
    )
    near = ~is_beyond(points, question.targets)
    concentration = concentration_of(
        frequencies, amplitudes, near, felt=min(felt), plate=table.plate
    )
    return replace(pattern, concentration=concentration)


def cell_centres(plate: Plate) -> FloatArray:
    """Centres (p, 2) [m] of equal small cells that tile the plate."""
    count_x, count_y = (max(1, round(side / SPACING)) for side in (plate.length, plate.width))
    x = np.linspace(0, plate.length, 2 * count_x + 1)[1::2]
    y = np.linspace(0, plate.width, 2 * count_y + 1)[1::2]
    return lattice(x, y)


def concentration_of(
    frequencies: FloatArray,
    amplitudes: FloatArray,
    near: NDArray[np.bool_],
    *,
    felt: float,
    plate: Plate,
) -> Concentration:
    """Rate a vibration with amplitudes (f, p) [m/s²] at `cell_centres`, frequencies (f,) [Hz].

    near (p,): centres within 50 mm of a target; felt [m/s²]: mean amplitude at the least driven
    target. Energy is kinetic, of uniform mass. Where all centres are near, contrast is to all.
    """
    peak = amplitudes.sum(axis=0)
    around = peak if near.all() else peak[~near]
    energy = ((amplitudes.T / frequencies) ** 2).sum(axis=1)
    return Concentration(
        contrast_95_db=float(decibels(felt / np.percentile(around, PERCENTILE))),
        area_above_half=float((peak > felt / 2).mean()) * plate.length * plate.width,
        energy_share_near=float(energy[near].sum() / energy.sum()),
    )
