"""Random places of fingers that are apart from each other, as fingertips of two hands are.

Felt contrast that the cells of a plate have to other fingers.

For the centre of each cell as the target, the contrast that nine of ten plates give to another
finger at random places at least 5 cm away. A cell is *feasible* if the
median other finger leaves 12 dB at 20 dB SL: turned down to 12 dB SL, which is felt well, the other
finger is then at its threshold. It is *weak* if more than one other finger in ten leaves less.

Contrast from every place of the plate to given quiet fingers.
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
"""Distance of the fingers of a contact set at least [m], as fingertips of two hands."""


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
    """Draw places [m] of fingers on a plate, so far apart and from its edges [m].

    Raises InputError where no try finds any.
    """
    sides = np.array([plate.length, plate.width])
    for _ in range(tries):
        places = rng.uniform(margin, sides - margin, (count, 2))
        if least_gap(places) >= apart:
            return tuple((float(x), float(y)) for x, y in places)
    raise InputError(
        f"{count} fingers must be {1000 * apart:g} mm apart, got a plate of {plate.length:g} x "
        f"{plate.width:g} m on which {tries} random sets are not; "
        "use fewer fingers or a larger plate"
    )


WANTED_CONTRAST_DB = FELT_DB_SL
WANTED_LEVEL_DB_SL = STRONG_DB_SL

STRATA = (2, 2)
"""Strata of a quarter of the plate, one random place of the other finger in each.

Their mirror images in both axes are used too, so that a symmetric plate has a symmetric map, with
less variance than from places drawn freely.
"""

Contrasts: TypeAlias = tuple[float, float]
"""Felt contrast [dB] of nine of ten plates, and that of the nominal plate."""

Ask: TypeAlias = Callable[[Placement], Contrasts | None]
"""Answers a finger beside quiet ones, None where the level is not reached."""

_DECIMALS = 9  # of places [m]: below that is rounding

# Weak places are as large as a quarter of a wavelength.
_MAX_GRID = Grid(8, 6)


@dataclass(frozen=True, eq=False)
class WeakCells:
    """Median and tenth percentile of felt contrast [dB] from each cell to other fingers, (cells,).

    -inf where the level is not reached, NaN on a plate too small for two fingers. errors_db: one
    standard deviation of both by the choice of the other fingers, (2, cells). pairs_db: promised
    and nominal felt contrast [dB] of all pairs that reach it, (2, pairs).
    """

    grid: Grid
    centres: FloatArray
    median_db: FloatArray
    tenth_db: FloatArray
    errors_db: FloatArray
    pairs_db: FloatArray

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Mask of feasible cells."""
        return np.asarray(self.median_db >= WANTED_CONTRAST_DB)

    @property
    def weak(self) -> NDArray[np.bool_]:
        """Mask of weak cells."""
        return np.asarray(self.tenth_db < WANTED_CONTRAST_DB)

    def as_json(self) -> dict[str, Any]:
        """The map for programs; null where a contrast is not finite."""
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
    """One standard deviation of a percentile of a random sample (n,), NaN where it is not finite.

    Half the distance between the order statistics that are one standard deviation of the number of
    values below the percentile away from it, whatever the values' distribution. Equal values count
    once, as those of questions that mirror each other.
    """
    sample = np.asarray(values, dtype=float)
    share, count = percent / 100, len(np.unique(sample))
    if count == 0:
        return math.nan
    ranks = np.clip(share + np.array([-1, 1]) * math.sqrt(share * (1 - share) / count), 0, 1)
    low, high = np.quantile(sample, ranks, method="inverted_cdf")
    return float(high - low) / 2 if np.isfinite([low, high]).all() else math.nan


def map_grid(table: LocalizationTable) -> Grid:
    """Grid of the map: the table's, or a coarser one in place of a fine one."""
    return Grid(min(table.grid.nx, _MAX_GRID.nx), min(table.grid.ny, _MAX_GRID.ny))


def find_weak_cells(
    table: LocalizationTable, answered: Sequence[Sequence[Contrasts | None]]
) -> WeakCells:
    """The map, of what `pair_questions` have been answered, cell by cell."""
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
    """Promised and nominal felt contrast [dB] of answers that reach the level, (2, answers)."""
    return np.array([*filter(None, answered)], dtype=float).reshape(-1, 2).T


def pair_questions(table: LocalizationTable) -> list[list[Placement]]:
    """For each cell of `map_grid` as the target, those with each other finger at a distance.

    Places of the other finger are drawn for each cell, the same for cells that mirror each other
    where the plate does.
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

    return [
        _questions(centres[x + y * grid.nx], _places(plate, seed(x, y)))
        for y in range(grid.ny)
        for x in range(grid.nx)
    ]


def ask_once(table: LocalizationTable) -> Ask:
    """Promised and nominal felt contrast [dB] of questions, None where the level is not reached.

    Questions that mirror each other, where plate, ERAs and masses do, have one answer, so that the
    noise of the drawn plates does not make several samples of one.
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
    """Promised and nominal felt contrast [dB], None where the level is not reached."""
    try:
        found = query(table, placed, level_db_sl, drive_mode=drive_mode)
    except InputError:
        return None
    promised, nominal = found.fingers[0].promised_contrast_db, found.fingers[0].contrast_db
    if promised is None or nominal is None or not found.is_reached:
        return None
    return promised, nominal


def mirror_images(table: LocalizationTable) -> list[tuple[bool, bool]]:
    """The reflections, along x, along y or both, under which a table's plate is the same.

    That along neither is always one of them.
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
    """The image of fingers that is the same for all their images."""
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
    """What is attached, without names, at its reflected places."""
    found: Counter[Actuator | PointLoad] = Counter()
    for each in attached:
        x, y = _reflected((each.x, each.y), table, along)
        nameless = each if isinstance(each, PointLoad) else replace(each, name="")
        found[replace(nameless, x=x, y=y)] += 1
    return found


def text_map(weak: WeakCells) -> Iterator[str]:
    """Median contrast as lines of text, the largest y first, with * for weak cells."""
    shape = (weak.grid.ny, weak.grid.nx)
    rows = zip(weak.median_db.reshape(shape), weak.weak.reshape(shape), strict=True)
    for median, marks in reversed(list(rows)):
        yield "".join(
            f"{'-' if not np.isfinite(value) else format(value, '.0f'):>4}{'*' if mark else ' '}"
            for value, mark in zip(median, marks, strict=True)
        ).rstrip()


def _places(plate: Plate, seed: list[int]) -> FloatArray:
    """Random places all over a plate, with all their mirror images, (n, 2) [m]."""
    corner = np.stack(np.meshgrid(*(np.arange(n) for n in STRATA)), axis=-1).reshape(-1, 1, 2)
    drawn = np.random.default_rng(seed).uniform(0, 1, corner.shape)
    drawn = (corner + drawn) / (2 * np.array(STRATA))
    mirrored = np.abs(drawn - [[0, 0], [1, 0], [0, 1], [1, 1]])
    size = np.array([plate.length, plate.width])
    return np.asarray(size * mirrored.reshape(-1, 2))


def _questions(target: FloatArray, places: FloatArray) -> list[Placement]:
    """A target [m], for each other finger at a distance."""
    far = np.linalg.norm(places - target, axis=1) >= MIN_DISTANCE
    at = (float(target[0]), float(target[1]))
    return [Placement((at,), ((float(x), float(y)),)) for x, y in places[far]]


@dataclass(frozen=True, eq=False)
class ContrastMap:
    """Contrast of a finger at every place to the same quiet fingers, by drive mode.

    x (nx,), y (ny,) [m]: of the places; quiet [m]; promised_db, nominal_db: felt contrast [dB] that
    nine of ten plates within the rig's uncertainty give, and of the nominal plate, each (ny,
    nx), NaN where the level is not reached and under a quiet finger.
    """

    x: FloatArray
    y: FloatArray
    quiet: tuple[Point, ...]
    promised_db: dict[str, FloatArray]
    nominal_db: dict[str, FloatArray]

    def __repr__(self) -> str:
        modes = ", ".join(self.promised_db)
        return f"<ContrastMap of {len(self.x)} x {len(self.y)} places, {modes}>"

    @property
    def columns(self) -> Columns:
        """Places and contrasts as columns of one row a place, x changing first."""
        x, y = np.meshgrid(self.x, self.y)
        return {
            "x_m": x.ravel(),
            "y_m": y.ravel(),
            **{f"{mode}_promised_db": of.ravel() for mode, of in self.promised_db.items()},
            **{f"{mode}_nominal_db": of.ravel() for mode, of in self.nominal_db.items()},
        }

    def to_frame(self) -> Any:
        """The columns of `era table map -o FILE.csv` as a pandas DataFrame; needs pandas."""
        return as_frame(self.columns)

    def as_json(self) -> dict[str, Any]:
        """The map for programs, one row per y; null where there is no answer."""
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
    """Ask a table for a finger at every place of a grid, by default its cells.

    quiet [m]: one finger or more that must not feel it; drive_modes: the table's own for none;
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
