"""What of an answer takes longer: its transients, and how concentrated it is over the plate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import IMPERCEPTIBLE_DB_SL, QUIET, Answer, Layer
from model.answer.fingers import Placement
from model.answer.timing import Timing
from model.arrays import FloatArray, lattice
from model.finger import decibels, fingertip_points, fingertip_weights, is_beyond
from model.structure.plate import Plate
from model.table.table import LocalizationTable

SPACING = 0.0025  # m; resolves the area of a circle of 50 mm to a percent
PERCENTILE = 95


@dataclass(frozen=True)
class Concentration:
    """How much of a vibration is near its targets.

    contrast_95_db: targets to the 95th percentile of the plate farther than 50 mm, by peak
    acceleration; area_above_half [m²]: of the plate, targets included, that vibrates more than
    half as strongly as they do; energy_share_near: share of kinetic energy within 50 mm of them.
    """

    contrast_95_db: float
    area_above_half: float
    energy_share_near: float


@dataclass(frozen=True)
class Measures:
    """What takes some ten milliseconds to say of the first layer of an answer.

    transient_contrast_db: over the first 100 ms, as accelerations; residual_db: residual vibration
    in the 100 ms after the end, relative to the steady one. transient_contrast_db is None without
    other fingers, concentration with them; is_imperceptible_to_quiet: whether every quiet finger
    stays 10 dB below all sets of thresholds by which promises hold, on nine of ten plates.
    """

    transient_contrast_db: float | None
    residual_db: float
    concentration: Concentration | None
    is_imperceptible_to_quiet: bool | None


def measures(table: LocalizationTable, answer: Answer, *, timing: Timing | None = None) -> Measures:
    """Return the measures in time and over the whole plate of the first layer of an answer."""
    layer, timing = answer.layers[0], timing or Timing(table)
    placement = answer.placement(layer)
    quiet = [each.foreign_level_db_sl for each in answer.fingers if each.verdict == QUIET]
    loudest = max([each for each in quiet if each is not None], default=None)
    return Measures(
        timing.transient_contrast_db(layer, placement),
        timing.residual_db(layer, placement),
        None if placement.quiet else concentration(table, layer, placement),
        None if loudest is None else loudest <= IMPERCEPTIBLE_DB_SL,
    )


def concentration(table: LocalizationTable, layer: Layer, placement: Placement) -> Concentration:
    """Return the concentration of a layer for fingers without others; takes some milliseconds."""
    contacts, loads, tones = placement.targets, placement.loads, layer.excitation
    felt = []
    for target in contacts:
        disc = fingertip_points(*target, table.plate)
        _, found = table.amplitudes(tones, disc, contacts=contacts, loads=loads)
        felt.append(found.sum(axis=0) @ fingertip_weights(*target, table.plate))
    points = cell_centres(table.plate)
    frequencies, amplitudes = table.amplitudes(tones, points, contacts=contacts, loads=loads)
    near = ~is_beyond(points, contacts)
    return concentration_of(frequencies, amplitudes, near, felt=min(felt), plate=table.plate)


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
