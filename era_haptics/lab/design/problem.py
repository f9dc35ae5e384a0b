"""Design problem: number of ERAs, the area allowed for them, and the contact sets they serve.

The area is the edge, the whole plate, or polygons. Contact sets consist of fingers with contents
and quiet fingers. A layout supports the plate if the lowest rigid-body mode is high enough and
every ERA carries weight. Layouts to be ranked come from a file, or are the rig's own, named ones
and random ones.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, Strict

from model.arrays import FloatArray, IntArray, best_of, least_gap
from model.config.document import read_document
from model.config.fields import (
    PointSection,
    Polygon,
    PolygonSection,
    Quantity,
    Rectangle,
    RegionShape,
    Section,
    ShapedSection,
    Validation,
    _Point,
    box_of,
)
from model.config.units import LENGTH
from model.errors import InputError
from model.rig.era_layouts import named_layouts
from model.rig.key_types import Identifier
from model.rig.rig import Rig
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.structure.statics import rigid_body_frequencies, static_loads
from model.table.table import default_drive_frequencies
from registry.limits import MAX_CONTACTS, MAX_CONTENTS

EDGE, ANYWHERE = "edge", "anywhere"
"""Names of areas without a file."""

_ON_EDGE = 1e-9  # m
_MAX_CANDIDATES = 2000

DEFAULT_FINGER_GAP = 0.05
"""Minimum distance between the fingers of a set [m]."""

DEFAULT_QUIET = {True: (1, 3), False: (0, 1)}
"""Minimum and maximum number of quiet fingers, with one content and with several."""

MIN_FINGERS = 2
"""Fingers of a set."""

_MAX_TRIES = 20_000
_DRAWN_FOR_EACH = 8  # candidates per position of a pool; the most isolated one is used

Draw = Callable[[np.random.Generator, int], FloatArray]
"""Draws positions [m] (n, 2)."""

DEFAULT_LOWEST = 20.0
"""Minimum natural frequency of the plate on its ERAs [Hz]; it sags by 0.6 mm under its weight."""

MIN_SUPPORTING = 3
"""Minimum number of ERAs and other mounts that support a plate."""

_ROUNDING = (
    1e-9  # of the mean load; smaller negative loads count as zero, since an ERA can be unloaded
)

CANDIDATES = {True: 48, False: 80}
"""Number of candidates along the edge, and over an area."""

SEARCH_FINGERS, SEARCH_FREQUENCIES = 32, 16

JUDGED_SETS = 200
"""Number of contact sets for full evaluation, separate from the search's sets."""

DEFAULT_ERA_GAP = 0.03
"""Minimum distance between two ERAs [m]."""

_JUDGED_SEED = 0x5EED  # added to the seed of a search, so that the sets differ

_OWN = "own"
"""Name of the rig's own layout."""

_MAX_LAYOUTS = 1_000_000

_RANDOM_PREFIX = "random:"
_MAX_DIGITS = 9  # int() is slow for thousands of digits
_TRIES = 20  # draws per layout, since some repeat earlier ones

NamedLayouts = dict[str, FloatArray]
"""Positions of the ERAs [m] (n, 2) by layout name, kept ERAs first."""


@dataclass(frozen=True)
class Area:
    """Part of a plate of a length and a width [m] in which a function of points (n, 2) is true.

    text: identifies it; its name, or the content of its file.
    """

    text: str
    length: float
    width: float
    contains: Callable[[FloatArray], NDArray[np.bool_]]

    def candidates(self, spacing: float) -> FloatArray:
        """Return the points of a raster over the plate, edges included, that are in the area."""
        x, y = (
            np.linspace(0, side, max(1, round(side / spacing)) + 1)
            for side in (self.length, self.width)
        )
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return places[self.contains(places)]

    def moved(self, place: FloatArray, step: float) -> FloatArray:
        """Return a position moved by +/- step in x and in y, clipped at the plate's edges."""
        steps = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        places = np.clip(place + steps, 0, [self.length, self.width])
        is_other = (np.abs(places - place) > _ON_EDGE).any(axis=1)
        return places[is_other & self.contains(places)]


def area_of(where: str, plate: Plate) -> Area:
    """Return a named area, or the area in a file of polygons.

    Raises InputError for another kind of file, or an unreadable file.
    """
    length, width = plate.length, plate.width
    if where in (EDGE, ANYWHERE):
        contains = everywhere if where == ANYWHERE else partial(_on_edge, length, width)
        return Area(where, length, width, partial(_both, plate.covers, contains))
    path = Path(where)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(
            f"where must be {EDGE}, {ANYWHERE} or a .yaml file of polygons, got {where!r}"
        )
    document = read_document(
        path, if_empty="it must have polygons, each with a name and its corners"
    )
    polygons = Validation(document, _PolygonsSection).finish().polygons
    shapes = [Polygon(tuple(corners)) for corners in polygons.values()]
    contains = partial(_in_any, shapes)
    return Area(document.text, length, width, partial(_both, plate.covers, contains))


def everywhere(points: FloatArray) -> NDArray[np.bool_]:
    """Return True for every point (n, 2), (n,)."""
    return np.ones(len(points), dtype=bool)


def candidates_of(area: Area, *, count: int) -> tuple[FloatArray, float]:
    """Return about `count` candidate positions (c, 2) [m], and their spacing [m].

    Raises InputError if the area contains none.
    """
    size = area.length * area.width
    spacing = math.sqrt(size / count)
    if area.text == EDGE:
        spacing = 2 * (area.length + area.width) / count
    for _ in range(6):  # refine the raster for a small area
        places = area.candidates(spacing)
        if len(places) >= count / 2:
            return places, spacing
        if size / spacing**2 > _MAX_CANDIDATES * 4:
            break
        spacing *= 0.7
    if len(places) == 0:
        raise InputError(
            "where must leave room for ERAs on the plate, got none; check that its polygons are on "
            "the plate, in meters from its corner"
        )
    return places, spacing


def _both(
    covers: Callable[[FloatArray], NDArray[np.bool_]],
    contains: Callable[[FloatArray], NDArray[np.bool_]],
    points: FloatArray,
) -> NDArray[np.bool_]:
    """Return whether points (n, 2) are on the plate, outside cut-outs of a surface, and in the
    area."""
    return np.asarray(covers(points) & contains(points))


def _on_edge(length: float, width: float, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether points (n, 2) are on the edge of a plate."""
    gaps = np.minimum(np.abs(points), np.abs([length, width] - points))
    return np.asarray((gaps <= _ON_EDGE).any(axis=1))


def _in_any(polygons: Sequence[Polygon], points: FloatArray) -> NDArray[np.bool_]:
    """Return whether points (n, 2) are in any of the polygons, edges included."""
    found = [any(each.contains(x, y) for each in polygons) for x, y in points.tolist()]
    return np.array(found, dtype=bool)


class _PolygonsSection(Section):
    """Polygons allowed for ERAs, by name."""

    polygons: Annotated[dict[Identifier, PolygonSection], Field(min_length=1, max_length=256)]


@dataclass(frozen=True, eq=False)
class ContactRule:
    """Distribution of contact sets: anywhere, in regions, or given.

    - quiet: minimum and maximum number of quiet fingers.
    - apart [m]: minimum distance between fingers.
    - draw: draws positions.
    - given: sets of contacts (fingers, 2) [m], which replace the random ones.
    - contents: number of fingers, first in a set, with a content of their own.
    """

    quiet: tuple[int, int]
    apart: float
    draw: Draw
    given: tuple[FloatArray, ...] = ()
    contents: int = 1

    def sets(self, count: int, *, seed: int) -> list[FloatArray]:
        """Draw about `count` sets, equally many for each number of quiet fingers.

        Given sets are used in turn. Raises InputError if fingers find no room.
        """
        rng = np.random.default_rng(seed)
        if self.given:
            order = rng.permutation(len(self.given))
            return [self.given[number] for number in order[:count]]
        low, high = self.quiet
        kinds = high - low + 1
        return [self._one(rng, self.contents + low + number % kinds) for number in range(count)]

    def pooled_sets(self, fingers: int, *, seed: int) -> list[FloatArray]:
        """Draw sets that use only `fingers` finger positions, far apart from each other.

        For quantities computed once per finger. For every number of quiet fingers, each finger is
        the first in exactly one set. Given sets are used unchanged, up to three per finger.
        """
        low, high = self.quiet
        if self.given:
            return self.sets(fingers * 3, seed=seed)
        rng = np.random.default_rng(seed)
        pool = self.draw(rng, 1)
        while len(pool) < fingers:
            drawn = self.draw(rng, _DRAWN_FOR_EACH)
            gaps = np.linalg.norm(drawn[:, None] - pool, axis=-1).min(axis=1)
            pool = np.vstack([pool, drawn[best_of(gaps)]])
        return [
            pool[self._others(rng, pool, first, self.contents - 1 + quiet)]
            for quiet in range(low, high + 1)
            for first in range(fingers)
        ]

    def _others(
        self, rng: np.random.Generator, pool: FloatArray, first: int, count: int
    ) -> IntArray:
        """Draw `count` other fingers of a pool that are far enough from one finger, and return
        their numbers."""
        for _ in range(_MAX_TRIES):
            others = rng.choice(len(pool), count, replace=False)
            numbers = np.concatenate([[first], others])
            if least_gap(pool[numbers]) > self.apart:
                return np.asarray(numbers)
        raise self._no_room(count + 1)

    def _one(self, rng: np.random.Generator, fingers: int) -> FloatArray:
        for _ in range(_MAX_TRIES):
            places = self.draw(rng, fingers)
            if least_gap(places) > self.apart:
                return places
        raise self._no_room(fingers)

    def _no_room(self, fingers: int) -> InputError:
        return InputError(
            f"{fingers} fingers {1000 * self.apart:g} mm apart must find room in the regions of "
            f"contacts, found none in {_MAX_TRIES} draws; lower apart or quiet, or enlarge the "
            "regions"
        )


def anywhere(plate: Plate, contents: int = 1) -> ContactRule:
    """Return the rule for fingers anywhere on a plate, with DEFAULT_QUIET quiet ones."""
    draw = partial(_drawn, [Rectangle(0.0, 0.0, plate.length, plate.width)], plate)
    return ContactRule(DEFAULT_QUIET[contents == 1], DEFAULT_FINGER_GAP, draw, contents=contents)


def contact_rule(path: Path | None, plate: Plate, contents: int = 1) -> ContactRule:
    """Read a rule from a file with sets, or regions like a surface layout; `anywhere` for None.

    contents: number of simultaneous contents, one finger each. Raises ConfigError for errors in the
    file.
    """
    if not 1 <= contents <= MAX_CONTENTS:
        raise InputError(f"contents must be 1 to {MAX_CONTENTS}, got {contents}")
    if path is None:
        return anywhere(plate, contents)
    document = read_document(path, if_empty="it must have regions or sets")
    validation = Validation(document, _ContactsSection)
    for name in validation.mapping(("regions",)):
        region = validation.part(("regions", name), _RegionSection)
        problem = region and region.shape_problem((plate.length, plate.width))
        if problem:
            validation.add(("regions", name, *problem[0]), problem[1])
    section = validation.finish()
    given = tuple(np.array([*each.first, *each.quiet]) for each in section.sets)
    problems = [
        f"sets[{number}] must have {contents} fingers with contents (target or own) and another "
        f"finger, got {len(each.first)} and {len(each.quiet)} quiet ones"
        for number, each in enumerate(section.sets)
        if len(each.first) != contents or len(each.first) + len(each.quiet) < MIN_FINGERS
    ]
    problems += [
        f"sets[{number}] must be on the plate, from (0, 0) to ({plate.length:g}, {plate.width:g}) "
        f"m, got ({x:g}, {y:g}) m"
        for number, contacts in enumerate(given)
        for x, y in contacts.tolist()
        if not plate.contains(x, y)
    ]
    if bool(section.sets) == bool(section.regions):
        problems.append(f"must have regions or sets, got {'both' if section.sets else 'neither'}")
    low, high = section.quiet or DEFAULT_QUIET[contents == 1]
    least = max(0, MIN_FINGERS - contents)
    if not least <= low <= high <= MAX_CONTACTS - contents:
        problems.append(
            f"quiet must be two numbers from {least} to {MAX_CONTACTS - contents}, ascending, got "
            f"{low}, {high}"
        )
    if problems:
        raise InputError(f"{document.source}: {problems[0]}")
    draw = partial(_drawn, [region.shape for region in section.regions.values()], plate)
    return ContactRule((low, high), section.apart, draw, given, contents)


def _drawn(
    shapes: Sequence[RegionShape], plate: Plate, rng: np.random.Generator, count: int
) -> FloatArray:
    """Draw each finger in one of the shapes, all equally likely."""
    chosen = rng.integers(len(shapes), size=count)
    return np.array([_place_in(shapes[number], plate, rng) for number in chosen])


def _place_in(shape: RegionShape, plate: Plate, rng: np.random.Generator) -> _Point:
    """Draw a position [m] of the plate in a shape; raises InputError if the shape is empty."""
    box = box_of(shape)
    for _ in range(_MAX_TRIES):
        x, y = rng.uniform(*box).tolist()
        if plate.contains(x, y) and shape.contains(x, y):
            return x, y
    raise InputError("regions of contacts must have an area, got one without")


class _RegionSection(ShapedSection):
    """Region of contacts; its effects in a surface layout are ignored."""

    model_config = ConfigDict(extra="ignore")


class _SetSection(Section):
    target: PointSection | None = None
    own: Annotated[list[PointSection], Field(max_length=MAX_CONTENTS, default_factory=list)]
    quiet: Annotated[
        list[PointSection],
        Field(max_length=MAX_CONTACTS - MAX_CONTENTS, default_factory=list),
    ]

    @property
    def first(self) -> list[PointSection]:
        """Fingers with contents."""
        return self.own if self.target is None else [self.target, *self.own]


class _ContactsSection(Section):
    """Contacts of a design. Effects and other keys of a surface layout are ignored."""

    quiet: Annotated[tuple[int, int], Strict(strict=False)] | None = None
    apart: Annotated[float, Quantity(LENGTH, at_least=0.026, at_most=10)] = DEFAULT_FINGER_GAP
    regions: Annotated[
        dict[Identifier, _RegionSection], Field(min_length=1, max_length=256, default_factory=dict)
    ]
    sets: Annotated[list[_SetSection], Field(min_length=1, max_length=1000, default_factory=list)]
    effects: Any = None
    elsewhere: Any = None


def shortfall(rig: Rig, eras: Sequence[Actuator], *, lowest: float) -> float:
    """Return how far ERAs are from supporting a rig's plate, 0 if they do.

    lowest [Hz]: minimum rigid-body frequency. The plate's weight must not pull any mount upwards,
    so that the center of mass is within them and the plate does not tip.
    """
    frequency = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    if frequency < 1e-3:
        return 2.0
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    pulled = -float(loads.min() / loads.mean())
    return max(0.0, 1 - frequency / lowest) + (pulled if pulled > _ROUNDING else 0.0)


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """Requested design.

    - kept: names of the rig's ERAs that keep their positions.
    - count: number of all ERAs.
    - apart [m]: minimum distance between ERAs.
    - lowest [Hz]: minimum rigid-body frequency.
    - stiffness [N/m]: stiffness of ERAs that are not kept; None: the rig's.

    Raises InputError for too few ERAs to support the plate.
    """

    rig: Rig
    count: int
    area: Area
    contacts: ContactRule
    kept: tuple[str, ...] = ()
    apart: float = DEFAULT_ERA_GAP
    lowest: float = DEFAULT_LOWEST
    seed: int = 0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        """Check the number of ERAs."""
        if self.count + self.supports < MIN_SUPPORTING:
            raise InputError(
                f"eras must be at least {MIN_SUPPORTING - self.supports} to support the plate, "
                f"got {self.count}"
            )

    @property
    def supports(self) -> int:
        """Number of mounts other than the ERAs."""
        return sum(load.stiffness > 0 for load in self.rig.masses)

    @property
    def kept_positions(self) -> FloatArray:
        """Positions of the kept ERAs [m], (k, 2)."""
        eras = [self.rig.era(name) for name in self.kept]
        return np.array([[era.x, era.y] for era in eras]).reshape(-1, 2)

    @property
    def own_positions(self) -> FloatArray:
        """Positions of the rig's own ERAs [m], (eras, 2)."""
        return np.array([[era.x, era.y] for era in self.rig.eras])

    @property
    def like(self) -> Actuator:
        """The rig's ERA that serves as the template for new ones."""
        return next((era for era in self.rig.eras if era.name not in self.kept), self.rig.eras[0])

    def eras(self, positions: FloatArray) -> tuple[Actuator, ...]:
        """Return ERAs at positions [m] (n, 2): the kept ones, then copies of the first that is not
        kept.

        Copies are named E1, E2, ..., skipping names of kept ERAs.
        """
        like = self.like
        if self.stiffness is not None:
            like = replace(like, stiffness=self.stiffness)
        names = (name for number in range(1, 999) if (name := f"E{number}") not in self.kept)
        return tuple(self.rig.era(name) for name in self.kept) + tuple(
            replace(like, name=next(names), x=float(x), y=float(y))
            for x, y in positions[len(self.kept) :]
        )

    def rig_with(self, positions: FloatArray) -> Rig:
        """The rig with ERAs at positions, without wiring."""
        return replace(self.rig, eras=self.eras(positions), wiring={}, amplifiers={})

    def shortfall(self, positions: FloatArray) -> float:
        """Return how far ERAs at positions are from supporting the plate, 0 if they do."""
        return shortfall(self.rig, self.eras(positions), lowest=self.lowest)

    @property
    def searched_frequencies(self) -> FloatArray:
        """Frequencies of the scores [Hz], a subset of the rig's table frequencies, (f,).

        Their number is proportional to the number of contents, since each content needs separate
        frequencies: for three contents, scores at all 47 frequencies correlate with answers by
        0.83, at 16 by 0.49 (16 layouts of four ERAs).
        """
        every = default_drive_frequencies(self.rig.limits)
        count = min(len(every), SEARCH_FREQUENCIES * self.contacts.contents)
        chosen = np.linspace(0, len(every) - 1, count).round()
        return np.asarray(every[chosen.astype(int)])

    def judged_sets(self) -> list[FloatArray]:
        """Contact sets that no search has used, (fingers, 2) [m] each."""
        return self.contacts.sets(JUDGED_SETS, seed=self.seed + _JUDGED_SEED)

    @property
    def candidates(self) -> FloatArray:
        """Start positions of a search [m], (c, 2); raises InputError for an empty set."""
        return self._raster[0]

    @property
    def spacing(self) -> float:
        """Distance [m] of candidates."""
        return self._raster[1]

    @cached_property
    def _raster(self) -> tuple[FloatArray, float]:
        return candidates_of(self.area, count=CANDIDATES[self.area.text == EDGE])

    def open_candidates(self, positions: FloatArray) -> IntArray:
        """Return the numbers of candidates far enough from positions (n, 2) [m].

        Raises InputError without any.
        """
        gaps = np.linalg.norm(self.candidates[:, None] - positions, axis=-1)
        found = np.flatnonzero(gaps.min(axis=1, initial=np.inf) >= self.apart)
        if not len(found):
            raise InputError(
                f"where must have room for {self.count} ERAs {1000 * self.apart:g} mm apart, found "
                f"room for {len(positions)}; enlarge it, or reduce eras or apart"
            )
        return found

    def are_apart(self, positions: FloatArray) -> bool:
        """Return whether positions (n, 2) [m] keep the minimum distance."""
        return least_gap(positions) >= self.apart

    def random_layout(self, rng: np.random.Generator) -> FloatArray:
        """Draw a layout at candidates far enough apart, kept ERAs first: (count, 2) [m].

        Raises InputError if there is no room for that many.
        """
        found = self.kept_positions
        while len(found) < self.count:
            place = self.candidates[rng.choice(self.open_candidates(found))]
            found = np.vstack([found, place])
        return found


class _LayoutsSection(Section):
    """Positions of the ERAs that are not kept, by layout name."""

    layouts: Annotated[
        dict[str, Annotated[list[PointSection], Field(min_length=1, max_length=32)]],
        Field(min_length=1),
    ]


def supported_layouts(
    text: str, problems: Sequence[DesignProblem]
) -> dict[DesignProblem, NamedLayouts]:
    """Return `layouts_of` each problem; raises InputError if none supports the plate."""
    given = {problem: layouts_of(text, problem) for problem in problems}
    if not any(
        problem.shortfall(each) == 0 for problem in given for each in given[problem].values()
    ):
        raise InputError(
            f"at least one layout must support the plate with its lowest rigid-body frequency at "
            f"least {problems[0].lowest:g} Hz and weight on each ERA; add ERAs "
            "or stiffer ones, widen where, or reduce lowest"
        )
    return given


def layouts_of(text: str, problem: DesignProblem) -> NamedLayouts:
    """Return the layouts of `random:N` or of a file; raises InputError for an invalid file."""
    if not text.startswith(_RANDOM_PREFIX):
        return _layouts_of_file(Path(text), problem)
    number = text.removeprefix(_RANDOM_PREFIX)
    is_number = number.isascii() and number.isdigit() and len(number) <= _MAX_DIGITS
    count = int(number) if is_number else 0
    if not 1 <= count <= _MAX_LAYOUTS:
        raise InputError(f"layouts must be random:1 to random:{_MAX_LAYOUTS}, got {text}")
    return random_layouts(problem, count)


def random_layouts(problem: DesignProblem, count: int) -> NamedLayouts:
    """Return `count` different layouts: the rig's own, named ones, then random ones at candidates.

    The first two only if they are in the area. Fewer if no more exist. A longer list starts with
    the shorter ones.
    """
    found: NamedLayouts = {}
    known: set[bytes] = set()
    for name, positions in _different_layouts(problem, count):
        key = np.unique(positions.round(9), axis=0).tobytes()
        if key not in known:
            known.add(key)
            found[name or f"{problem.count}-{len(found) + 1:06d}"] = positions
        if len(found) == count:
            break
    return found


def _different_layouts(problem: DesignProblem, count: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield names (empty for random layouts) and positions."""
    if len(problem.rig.eras) == problem.count and not problem.kept:
        yield _OWN, problem.own_positions
    kept = problem.kept_positions
    for layout in named_layouts(problem.count - len(kept)):
        others = layout.positions(problem.rig.plate)
        positions = np.vstack([kept, others])
        if problem.area.contains(others).all() and problem.are_apart(positions):
            yield layout.name, positions
    rng = np.random.default_rng(problem.seed)
    for _ in range(_TRIES * count):
        yield "", problem.random_layout(rng)


def _layouts_of_file(path: Path, problem: DesignProblem) -> NamedLayouts:
    document = read_document(
        path, if_empty="it must have layouts, each with a name and its positions"
    )
    validation = Validation(document, _LayoutsSection)
    plate, found = problem.rig.plate, {}
    for name, places in validation.finish().layouts.items():
        positions = np.vstack([problem.kept_positions, np.array(places)])
        where = f"{path}: layouts.{name}"
        for x, y in places:
            if not plate.contains(x, y):
                raise InputError(
                    f"{where} must be on the plate, from (0, 0) to ({plate.length:g}, "
                    f"{plate.width:g}) m, got ({x:g}, {y:g}) m"
                )
        if len(positions) + problem.supports < MIN_SUPPORTING:
            raise InputError(
                f"{where} must have at least {MIN_SUPPORTING} mounts to support the plate, got "
                f"{len(positions) + problem.supports}"
            )
        if not problem.are_apart(positions):
            raise InputError(
                f"{where} must have ERAs at least {1000 * problem.apart:g} mm apart; move them, or "
                "reduce apart"
            )
        found[name] = positions
    return found
