"""Felt contrast over the plate of a table: to random other fingers, and to given quiet ones.

`WeakCells`: for the centre of each cell as the target, the promised contrast (90 % of plates) to
another finger at random positions at least 5 cm away. A cell is *feasible* if the median other
finger leaves 12 dB at 20 dB SL: at 12 dB SL, which is clearly felt, the other finger is then at its
threshold. It is *weak* if more than one other finger in ten leaves less.

`ContrastMap`: the contrast of a finger at every position to the same quiet fingers.
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
from model.answer.stimulus import Placement, check_on_plate
from model.arrays import FloatArray, Point, least_gap, nullable
from model.drive_modes import checked_mode
from model.errors import InputError
from model.files.csv_file import Columns, as_frame
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, STRONG_DB_SL, Grid
from model.processes import Progress, unseen
from model.structure.attachments import PointLoad
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.table.table import LocalizationTable

MIN_DISTANCE = 0.05
"""Minimum distance between the fingers of a contact set [m], similar to fingertips of two hands."""


def are_apart(contacts: FloatArray) -> bool:
    """Whether all contacts (n, 2) [m] are MIN_DISTANCE apart."""
    return least_gap(contacts) >= MIN_DISTANCE


def random_contacts(
    rng: np.random.Generator,
    count: int,
    plate: Plate,
    *,
    margin: float = 0.0,
    apart: float = MIN_DISTANCE,
    tries: int = 10_000,
) -> tuple[Point, ...]:
    """Draw places [m] of fingers on a plate, with least distances apart and from its edges [m].

    Raises InputError if none are found in a number of tries.
    """
    sides = np.array([plate.length, plate.width])
    for _ in range(tries):
        places = rng.uniform(margin, sides - margin, (count, 2))
        if least_gap(places) >= apart and plate.covers(places).all():
            return tuple((float(x), float(y)) for x, y in places)
    raise InputError(
        f"{count} fingers must be {1000 * apart:g} mm apart, got a plate of {plate.length:g} x "
        f"{plate.width:g} m on which {tries} random sets are not; "
        "use fewer fingers or a larger plate"
    )


WANTED_CONTRAST_DB = FELT_DB_SL
"""Felt contrast from which a cell is feasible."""

WANTED_LEVEL_DB_SL = STRONG_DB_SL
"""Level of the target in maps."""

STRATA = (2, 2)
"""Strata of a quarter of the plate, with one random place of the other finger in each.

Their mirror images in both axes are used, too, so that a symmetric plate has a symmetric map, with
less variance than from places drawn freely.
"""

Contrasts: TypeAlias = tuple[float, float]
"""Promised felt contrast [dB], and contrast on the nominal plate."""

Ask: TypeAlias = Callable[[Placement], Contrasts | None]
"""Returns the contrasts of a finger to quiet ones, None if the level is not reached."""

_DECIMALS = 9  # of places [m]: below that is rounding

# Weak places are as large as a quarter of a wavelength.
_MAX_GRID = Grid(8, 6)


@dataclass(frozen=True, eq=False)
class WeakCells:
    """Promised felt contrast from each cell of a plate to other fingers.

    -inf where the level is not reached, NaN on a plate too small for two fingers.
    """

    grid: Grid
    centres: FloatArray
    """Centres (cells, 2) of the cells [m]."""
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
        return np.asarray(self.median_db >= WANTED_CONTRAST_DB)

    @property
    def weak(self) -> NDArray[np.bool_]:
        """Mask (cells,) of weak cells."""
        return np.asarray(self.tenth_db < WANTED_CONTRAST_DB)

    def as_json(self) -> dict[str, Any]:
        """Return the map for programs; null where a contrast is not finite."""
        return {
            "grid": str(self.grid),
            "centres_m": self.centres.tolist(),
            "median_contrast_db": nullable(self.median_db),
            "tenth_percentile_contrast_db": nullable(self.tenth_db),
            "median_contrast_error_db": nullable(self.errors_db[0]),
            "tenth_percentile_contrast_error_db": nullable(self.errors_db[1]),
            "is_weak": self.weak.tolist(),
            "is_feasible": self.feasible.tolist(),
        }


def sampling_error(values: ArrayLike, percent: float) -> float:
    """Return one standard deviation of a percentile of a random sample (n,), NaN if not finite.

    For any distribution of the values: half the distance between the order statistics that are one
    standard deviation of the number of values below the percentile away from it. Equal values count
    once, since they come from mirrored queries.
    """
    sample = np.asarray(values, dtype=float)
    share, count = percent / 100, len(np.unique(sample))
    if count == 0:
        return math.nan
    ranks = np.clip(share + np.array([-1, 1]) * math.sqrt(share * (1 - share) / count), 0, 1)
    low, high = np.quantile(sample, ranks, method="inverted_cdf")
    return float(high - low) / 2 if np.isfinite([low, high]).all() else math.nan


def map_grid(table: LocalizationTable) -> Grid:
    """Return the grid of the map: the table's, or a coarser one if that is fine."""
    return Grid(min(table.grid.nx, _MAX_GRID.nx), min(table.grid.ny, _MAX_GRID.ny))


def find_weak_cells(
    table: LocalizationTable, answered: Sequence[Sequence[Contrasts | None]]
) -> WeakCells:
    """Make the map from answers to `pair_questions`, cell by cell."""
    grid = map_grid(table)
    found, errors = np.full((2, 2, len(answered)), np.nan)
    for cell, answers in enumerate(answered):
        # -inf where the level is not reached.
        contrasts = [-np.inf if each is None else each[0] for each in answers]
        if contrasts:
            # A sample with -inf cannot be interpolated.
            found[:, cell] = np.percentile(contrasts, [50, 10], method="inverted_cdf")
            errors[:, cell] = [sampling_error(contrasts, percent) for percent in (50, 10)]
    pairs = contrasts_reached(chain.from_iterable(answered))
    median, tenth = found
    return WeakCells(grid, grid.centres(table.plate), median, tenth, errors, pairs)


def contrasts_reached(answered: Iterable[Contrasts | None]) -> FloatArray:
    """Return promised and nominal felt contrast (2, n) [dB] of n answers that reach the level."""
    return np.array([*filter(None, answered)], dtype=float).reshape(-1, 2).T


def pair_questions(table: LocalizationTable) -> list[list[Placement]]:
    """Return questions for each cell of `map_grid` as the target, with one other finger each.

    Places of the other finger are drawn for each cell, at least MIN_DISTANCE away. They are the
    same for cells that mirror each other if the plate is symmetric.
    """
    grid, plate = map_grid(table), table.plate
    centres = grid.centres(plate)
    images = mirror_images(table)
    along_x, along_y = (True, False) in images, (False, True) in images

    def seed(x: int, y: int) -> list[int]:
        return [
            min(x, grid.nx - 1 - x) if along_x else x,
            min(y, grid.ny - 1 - y) if along_y else y,
        ]

    found = []
    for number, target in enumerate(centres):
        places = _places(plate, seed(number % grid.nx, number // grid.nx))
        far = places[np.linalg.norm(places - target, axis=1) >= MIN_DISTANCE].tolist()
        at = (float(target[0]), float(target[1]))
        found.append([Placement((at,), ((x, y),)) for x, y in far])
    return found


def ask_once(table: LocalizationTable) -> Ask:
    """Return a function that answers questions with their contrasts, each only once.

    Questions that mirror each other have one answer if plate, ERAs and masses are symmetric, so
    that noise of the drawn plates does not turn one sample into several.
    """
    images, known = mirror_images(table), dict[Placement, Contrasts | None]()

    def ask(placed: Placement) -> Contrasts | None:
        first = _first_image(placed, table, images)
        if first not in known:
            known[first] = contrasts_of(table, first)
        return known[first]

    return ask


def contrasts_of(
    table: LocalizationTable,
    placed: Placement,
    level_db_sl: float = WANTED_LEVEL_DB_SL,
    drive_mode: str | None = None,
) -> Contrasts | None:
    """Return the promised and nominal felt contrast [dB], None if the level is not reached."""
    try:
        found = query(table, placed, level_db_sl, drive_mode=drive_mode)
    except InputError:
        return None
    promised, nominal = found.fingers[0].promised_contrast_db, found.fingers[0].contrast_db
    if promised is None or nominal is None or not found.is_reached:
        return None
    return promised, nominal


def mirror_images(table: LocalizationTable) -> list[tuple[bool, bool]]:
    """Return the reflections, along x, y or both, under which a table's plate is the same.

    The one along neither is always included.
    """
    every = [(False, False), (True, False), (False, True), (True, True)]
    return [
        along
        for along in every
        if all(
            _placed(attached, table, along) == _placed(attached, table, every[0])
            for attached in (table.eras, table.masses)
        )
    ]


def _first_image(
    placed: Placement, table: LocalizationTable, images: Sequence[tuple[bool, bool]]
) -> Placement:
    """Return the image of fingers that is the same for all their images."""
    if len(images) == 1:
        return placed
    count = len(placed.targets)
    contacts = min(
        tuple(_reflected(at, table, along) for at in placed.contacts) for along in images
    )
    return Placement(contacts[:count], contacts[count:])


def _reflected(at: Point, table: LocalizationTable, along: tuple[bool, bool]) -> Point:
    (x, y), plate = at, table.plate
    return (
        round(plate.length - x if along[0] else x, _DECIMALS),
        round(plate.width - y if along[1] else y, _DECIMALS),
    )


def _placed(
    attached: Iterable[Actuator | PointLoad], table: LocalizationTable, along: tuple[bool, bool]
) -> Counter[Actuator | PointLoad]:
    """Count attachments without names, at their reflected places."""
    found: Counter[Actuator | PointLoad] = Counter()
    for each in attached:
        x, y = _reflected((each.x, each.y), table, along)
        nameless = each if isinstance(each, PointLoad) else replace(each, name="")
        found[replace(nameless, x=x, y=y)] += 1
    return found


def text_map(weak: WeakCells) -> Iterator[str]:
    """Yield the median contrast as lines of text, the largest y first, with * for weak cells."""
    shape = (weak.grid.ny, weak.grid.nx)
    rows = zip(weak.median_db.reshape(shape), weak.weak.reshape(shape), strict=True)
    for median, marks in reversed(list(rows)):
        yield "".join(
            f"{'-' if not np.isfinite(value) else format(value, '.0f'):>4}{'*' if mark else ' '}"
            for value, mark in zip(median, marks, strict=True)
        ).rstrip()


def _places(plate: Plate, seed: list[int]) -> FloatArray:
    """Draw random places (n, 2) [m] all over a plate, with all their mirror images."""
    corner = np.stack(np.meshgrid(*(np.arange(n) for n in STRATA)), axis=-1).reshape(-1, 1, 2)
    drawn = np.random.default_rng(seed).uniform(0, 1, corner.shape)
    drawn = (corner + drawn) / (2 * np.array(STRATA))
    mirrored = np.abs(drawn - [[0, 0], [1, 0], [0, 1], [1, 1]])
    size = np.array([plate.length, plate.width])
    return np.asarray(size * mirrored.reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class ContrastMap:
    """Contrast between a finger at each position and the same quiet fingers, by drive mode."""

    x: FloatArray
    """Positions (nx,) along x [m]."""
    y: FloatArray
    """Positions (ny,) along y [m]."""
    quiet: tuple[Point, ...]
    """Positions of the quiet fingers [m]."""
    promised_db: dict[str, FloatArray]
    """Promised felt contrast (ny, nx), on 90 % of plates, by drive mode.

    NaN where the level is not reached, and under a quiet finger.
    """
    nominal_db: dict[str, FloatArray]
    """The same on the nominal plate."""

    def __repr__(self) -> str:
        modes = ", ".join(self.promised_db)
        return f"<ContrastMap of {len(self.x)} x {len(self.y)} places, {modes}>"

    @property
    def columns(self) -> Columns:
        """Places and contrasts as columns with one row per place, x changing first."""
        x, y = np.meshgrid(self.x, self.y)
        return {
            "x_m": x.ravel(),
            "y_m": y.ravel(),
            **{f"{mode}_promised_db": of.ravel() for mode, of in self.promised_db.items()},
            **{f"{mode}_nominal_db": of.ravel() for mode, of in self.nominal_db.items()},
        }

    def to_frame(self) -> Any:
        """Return the columns of `era table map -o FILE.csv` as a pandas DataFrame; needs pandas."""
        return as_frame(self.columns)

    def as_json(self) -> dict[str, Any]:
        """Return the map as JSON, one row per y; null if there is no answer."""
        return {
            "x_m": self.x.tolist(),
            "y_m": self.y.tolist(),
            "quiet_m": [list(at) for at in self.quiet],
            "promised_contrast_db": {mode: nullable(of) for mode, of in self.promised_db.items()},
            "nominal_contrast_db": {mode: nullable(of) for mode, of in self.nominal_db.items()},
        }


def map_contrast(
    table: LocalizationTable,
    quiet: Sequence[Point],
    *,
    drive_modes: Sequence[str] = (),
    level_db_sl: float = STRONG_DB_SL,
    grid: Grid | None = None,
    progress: Progress = unseen,
) -> ContrastMap:
    """Query a table for a finger at every place of a grid, by default its own cells.

    quiet [m]: one finger or more that must not feel it; drive_modes: empty for the table's own;
    progress: called with the number of finished places, and the total. Raises InputError for quiet
    fingers that no question may have, and for an unknown drive mode.
    """
    if not quiet:
        raise InputError("a map of contrast must have at least one quiet finger, got none")
    fingers = tuple(quiet)
    grid, modes = grid or table.grid, tuple(map(checked_mode, drive_modes)) or (table.drive_mode,)
    centres = grid.centres(table.plate)
    questions = {
        (row, cell): Placement((at,), fingers)
        for cell, at in enumerate((float(x), float(y)) for x, y in centres)
        if min(math.dist(at, finger) for finger in fingers) >= FINGERTIP_RADIUS
        and table.plate.contains(*at)
        for row in range(len(modes))
    }
    check_on_plate("quiet finger", fingers, table.plate)
    found = np.full((len(modes), 2, grid.cell_count), np.nan)
    for done, ((row, cell), placed) in enumerate(questions.items(), start=1):
        found[row, :, cell] = contrasts_of(table, placed, level_db_sl, modes[row]) or np.nan
        progress(done, len(questions))
    fields = found.reshape(len(modes), 2, grid.ny, grid.nx)
    return ContrastMap(
        centres[: grid.nx, 0],
        centres[:: grid.nx, 1],
        fingers,
        {mode: fields[row, 0] for row, mode in enumerate(modes)},
        {mode: fields[row, 1] for row, mode in enumerate(modes)},
    )
