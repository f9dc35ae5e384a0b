"""Promised contrast of each cell of a plate to another finger at random positions.

The target is at the center of the cell, the other finger at least 5 cm away. The contrast holds on
90 % of plates. A cell is *feasible* if the median other finger leaves 12 dB
at 20 dB SL: at 12 dB SL, which is clearly felt, the other finger is then at its threshold. It is
*weak* if the contrast is lower for more than 10 % of the other fingers.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point, nullable
from model.finger import FELT_DB_SL, STRONG_DB_SL, Grid
from model.structure.attachments import PointLoad
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.study.contact_sets import MIN_DISTANCE
from model.table.table import LocalizationTable

WANTED_CONTRAST_DB = FELT_DB_SL
"""Felt contrast from which a cell is feasible."""

WANTED_LEVEL_DB_SL = STRONG_DB_SL
"""Level of the target in maps."""

STRATA = (2, 2)
"""Strata of a quarter of the plate, with one random position of the other finger in each.

Mirror images in both axes are used, too. A symmetric plate therefore has a symmetric map, with less
variance than with independent positions.
"""

Contrasts: TypeAlias = tuple[float, float]
"""Promised felt contrast [dB], and contrast on the nominal plate."""

Ask: TypeAlias = Callable[[Placement], Contrasts | None]
"""Returns the contrasts of a finger to quiet ones, None if the level is not reached."""

Reflection: TypeAlias = tuple[bool, bool]
"""Whether positions are mirrored along x and along y."""

_PERCENTILES = (50, 10)
_DECIMALS = 9  # of positions [m]: smaller differences are rounding errors

# Weak areas are as large as a quarter of a wavelength.
MAX_GRID = Grid(8, 6)
"""Finest grid of a map."""

_REFLECTIONS: tuple[Reflection, ...] = ((False, False), (True, False), (False, True), (True, True))


@dataclass(frozen=True, eq=False)
class WeakCells:
    """Promised felt contrast from each cell of a plate to other fingers.

    -inf where the level is not reached; NaN off the plate, and on a plate too small for two
    fingers.
    """

    grid: Grid
    centers: FloatArray
    """Centers (cells, 2) of the cells [m]."""
    median_db: FloatArray
    """Median (cells,) over other fingers."""
    tenth_db: FloatArray
    """Tenth percentile (cells,) over other fingers."""
    errors_db: FloatArray
    """Standard deviation of both due to the choice of the other fingers, (2, cells)."""
    pairs_db: FloatArray
    """Promised and nominal felt contrast (2, pairs) of all pairs that reach the level."""

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Mask (cells,) of feasible cells."""
        return self.median_db >= WANTED_CONTRAST_DB

    @property
    def weak(self) -> NDArray[np.bool_]:
        """Mask (cells,) of weak cells."""
        return self.tenth_db < WANTED_CONTRAST_DB

    def as_json(self) -> dict[str, Any]:
        """Return the map for programs; null where a contrast is not finite."""
        return {
            "grid": str(self.grid),
            "centres_m": self.centers.tolist(),
            "median_contrast_db": nullable(self.median_db),
            "tenth_percentile_contrast_db": nullable(self.tenth_db),
            "median_contrast_error_db": nullable(self.errors_db[0]),
            "tenth_percentile_contrast_error_db": nullable(self.errors_db[1]),
            "is_weak": self.weak.tolist(),
            "is_feasible": self.feasible.tolist(),
        }


def map_grid(table: LocalizationTable) -> Grid:
    """Return the grid of the map: the table's, or a coarser one if the table's is fine."""
    return Grid(min(table.grid.nx, MAX_GRID.nx), min(table.grid.ny, MAX_GRID.ny))


def find_weak_cells(
    table: LocalizationTable, answered: Sequence[Sequence[Contrasts | None]]
) -> WeakCells:
    """Compute the map from answers to `pair_questions`, cell by cell."""
    grid = map_grid(table)
    percentiles = np.full((2, len(answered)), np.nan)
    errors = np.full((2, len(answered)), np.nan)
    for cell, answers in enumerate(answered):
        promised = [-np.inf if answer is None else answer[0] for answer in answers]
        if promised:
            # A sample with -inf cannot be interpolated.
            percentiles[:, cell] = np.percentile(promised, _PERCENTILES, method="inverted_cdf")
            errors[:, cell] = [sampling_error(promised, percent) for percent in _PERCENTILES]
    pairs = contrasts_reached(chain.from_iterable(answered))
    median, tenth = percentiles
    return WeakCells(grid, grid.centers(table.plate), median, tenth, errors, pairs)


def sampling_error(values: ArrayLike, percent: float) -> float:
    """Return the standard error of a percentile of a random sample (n,), NaN if not finite.

    It is valid for any distribution: half the distance between two order statistics. Their ranks
    are those of the percentile plus and minus one standard deviation of the number of values below
    it. Equal values count once, since they come from mirrored queries.
    """
    sample = np.asarray(values, dtype=float)
    count = len(np.unique(sample))
    if count == 0:
        return math.nan
    share = percent / 100
    rank_std = math.sqrt(share * (1 - share) / count)
    ranks = np.clip([share - rank_std, share + rank_std], 0, 1)
    low, high = np.quantile(sample, ranks, method="inverted_cdf")
    return float(high - low) / 2 if np.isfinite([low, high]).all() else math.nan


def contrasts_reached(answered: Iterable[Contrasts | None]) -> FloatArray:
    """Return promised and nominal felt contrast (2, n) [dB] of n answers that reach the level."""
    reached = [contrasts for contrasts in answered if contrasts is not None]
    return np.array(reached, dtype=float).reshape(-1, 2).T


def pair_questions(table: LocalizationTable, grid: Grid | None = None) -> list[list[Placement]]:
    """Return questions for each cell of a grid as the target, with one other finger each.

    grid: `map_grid` by default. Positions of the other finger are drawn for each cell, at least
    MIN_DISTANCE away. They are the same for cells that mirror each other if the plate is symmetric.
    A cell whose center is not on the plate has no questions.
    """
    grid, plate = grid or map_grid(table), table.plate
    images = mirror_images(table)
    is_symmetric_along_x = (True, False) in images
    is_symmetric_along_y = (False, True) in images
    questions: list[list[Placement]] = []
    centers = grid.centers(plate)
    is_on_plate = plate.covers(centers)
    for number, center in enumerate(centers):
        if not is_on_plate[number]:
            questions.append([])
            continue
        row, column = divmod(number, grid.nx)
        if is_symmetric_along_x:
            column = min(column, grid.nx - 1 - column)
        if is_symmetric_along_y:
            row = min(row, grid.ny - 1 - row)
        others = _positions_over(plate, seed=[column, row])
        is_far = np.linalg.norm(others - center, axis=1) >= MIN_DISTANCE
        target = (float(center[0]), float(center[1]))
        questions.append([Placement((target,), ((x, y),)) for x, y in others[is_far].tolist()])
    return questions


def _positions_over(plate: Plate, *, seed: list[int]) -> FloatArray:
    """Draw random positions (n, 2) [m] over the whole plate, and their mirror images."""
    columns, rows = (np.arange(count) for count in STRATA)
    strata = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    offsets = np.random.default_rng(seed).uniform(0, 1, strata.shape)
    relative = (strata + offsets) / (2 * np.array(STRATA))
    mirrored = np.abs(relative - [[0, 0], [1, 0], [0, 1], [1, 1]])
    positions = np.asarray(np.array([plate.length, plate.width]) * mirrored.reshape(-1, 2))
    return positions[plate.covers(positions)]


def ask_once(table: LocalizationTable) -> Ask:
    """Return a function that returns the contrasts of questions, and computes each only once.

    If plate, ERAs and masses are symmetric, questions that mirror each other share an answer.
    Otherwise, noise of the drawn plates would turn a single sample into several.
    """
    images = mirror_images(table)
    answers: dict[Placement, Contrasts | None] = {}

    def ask(placed: Placement) -> Contrasts | None:
        image = _canonical_image(placed, table, images)
        if image not in answers:
            answers[image] = contrasts_of(table, image)
        return answers[image]

    return ask


def contrasts_of(
    table: LocalizationTable,
    placed: Placement,
    level_db_sl: float = WANTED_LEVEL_DB_SL,
    drive_mode: str | None = None,
) -> Contrasts | None:
    """Return the promised and nominal felt contrast [dB], None if the level is not reached.

    Raises the errors of `query`.
    """
    answer = query(table, placed, level_db_sl, drive_mode=drive_mode)
    target = answer.fingers[0]
    promised, nominal = target.promised_contrast_db, target.contrast_db
    if promised is None or nominal is None or not answer.is_reached:
        return None
    return promised, nominal


def mirror_images(table: LocalizationTable) -> list[Reflection]:
    """Return the reflections, along x, y or both, under which a table's plate is the same.

    The reflection along neither is always included. It is the only one for a surface, whose modes
    can be asymmetric.
    """
    if table.plate.surface is not None:
        return [_REFLECTIONS[0]]
    as_it_is = _attachments(table, _REFLECTIONS[0])
    return [
        reflection for reflection in _REFLECTIONS if _attachments(table, reflection) == as_it_is
    ]


def _attachments(
    table: LocalizationTable, reflection: Reflection
) -> tuple[Counter[Actuator | PointLoad], Counter[Actuator | PointLoad]]:
    """Return ERAs and masses at their reflected positions."""
    eras = _reflected_attachments(table.eras, table, reflection)
    masses = _reflected_attachments(table.masses, table, reflection)
    return eras, masses


def _reflected_attachments(
    attachments: Iterable[Actuator | PointLoad], table: LocalizationTable, reflection: Reflection
) -> Counter[Actuator | PointLoad]:
    """Count attachments without names, at their reflected positions."""
    counts: Counter[Actuator | PointLoad] = Counter()
    for attachment in attachments:
        x, y = _reflected((attachment.x, attachment.y), table, reflection)
        nameless = attachment
        if not isinstance(attachment, PointLoad):
            nameless = replace(attachment, name="")
        counts[replace(nameless, x=x, y=y)] += 1
    return counts


def _canonical_image(
    placed: Placement, table: LocalizationTable, images: Sequence[Reflection]
) -> Placement:
    """Return the image of fingers that is the same for all their images."""
    if len(images) == 1:
        return placed
    contacts = min(
        tuple(_reflected(contact, table, reflection) for contact in placed.contacts)
        for reflection in images
    )
    target_count = len(placed.targets)
    return Placement(contacts[:target_count], contacts[target_count:])


def _reflected(position: Point, table: LocalizationTable, reflection: Reflection) -> Point:
    x, y = position
    along_x, along_y = reflection
    if along_x:
        x = table.plate.length - x
    if along_y:
        y = table.plate.width - y
    return round(x, _DECIMALS), round(y, _DECIMALS)


def text_map(weak: WeakCells) -> Iterator[str]:
    """Yield the median contrast as lines of text, the largest y first, with * for weak cells."""
    shape = (weak.grid.ny, weak.grid.nx)
    medians, marks = weak.median_db.reshape(shape), weak.weak.reshape(shape)
    for row in reversed(range(weak.grid.ny)):
        line = ""
        for median, is_weak in zip(medians[row], marks[row], strict=True):
            number = f"{median:.0f}" if np.isfinite(median) else "-"
            line += f"{number:>4}{'*' if is_weak else ' '}"
        yield line.rstrip()
