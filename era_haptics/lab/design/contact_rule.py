"""Contact sets that a layout must serve: fingers with contents, and quiet fingers.

Fingers are drawn anywhere on the plate or in the regions of a file, or a file lists the sets.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, Strict

from model.arrays import FloatArray, IntArray, Point, best_of, least_gap
from model.config.document import read_document
from model.config.fields import Quantity, Section, Validation
from model.config.shapes import PointSection, Rectangle, RegionShape, ShapedSection, box_of
from model.config.units import LENGTH
from model.errors import InputError
from model.rig.key_types import Identifier
from model.structure.plate import Plate
from registry.limits import MAX_CONTACTS, MAX_CONTENTS

MIN_FINGERS = 2
"""Fingers of a set."""

DEFAULT_FINGER_GAP = 0.05
"""Minimum distance between the fingers of a set [m]."""

_QUIET_WITH_ONE_CONTENT = 1, 3
_QUIET_WITH_SEVERAL = 0, 1
_MAX_TRIES = 20_000
_DRAWN_PER_POSITION = 8  # positions drawn for a pool; the most isolated one is used
_SETS_PER_FINGER = 3  # given sets of a pool

Draw = Callable[[np.random.Generator, int], FloatArray]
"""Draws a number of positions [m] (n, 2)."""


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

    @property
    def quiet_counts(self) -> range:
        """Numbers of quiet fingers, ascending."""
        lowest, highest = self.quiet
        return range(lowest, highest + 1)

    def sets(self, count: int, *, seed: int) -> list[FloatArray]:
        """Draw about `count` sets, equally many for each number of quiet fingers.

        Given sets are used in turn. Raises InputError if fingers find no room.
        """
        rng = np.random.default_rng(seed)
        if self.given:
            order = rng.permutation(len(self.given))
            return [self.given[number] for number in order[:count]]
        contact_sets = []
        for number in range(count):
            quiet = self.quiet_counts[number % len(self.quiet_counts)]
            contact_sets.append(self._random_set(rng, self.contents + quiet))
        return contact_sets

    def pooled_sets(self, fingers: int, *, seed: int) -> list[FloatArray]:
        """Draw sets that use only `fingers` finger positions, far apart from each other.

        For quantities computed once per finger. For every number of quiet fingers, each finger is
        the first in exactly one set. Given sets are used unchanged, up to three per finger.
        """
        if self.given:
            return self.sets(_SETS_PER_FINGER * fingers, seed=seed)
        rng = np.random.default_rng(seed)
        pool = self._pool(rng, fingers)
        contact_sets = []
        for quiet in self.quiet_counts:
            for first in range(fingers):
                numbers = self._pooled_fingers(rng, pool, first, self.contents + quiet)
                contact_sets.append(pool[numbers])
        return contact_sets

    def _pool(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw positions (count, 2) [m] far apart from each other."""
        pool = self.draw(rng, 1)
        while len(pool) < count:
            positions = self.draw(rng, _DRAWN_PER_POSITION)
            gaps = np.linalg.norm(positions[:, None] - pool, axis=-1).min(axis=1)
            pool = np.vstack([pool, positions[best_of(gaps)]])
        return pool

    def _pooled_fingers(
        self, rng: np.random.Generator, pool: FloatArray, first: int, count: int
    ) -> IntArray:
        """Return the numbers of a finger of a pool, and of random other ones far enough away."""
        for _ in range(_MAX_TRIES):
            others = rng.choice(len(pool), count - 1, replace=False)
            numbers = np.concatenate([[first], others])
            if least_gap(pool[numbers]) > self.apart:
                return np.asarray(numbers)
        raise self._no_room(count)

    def _random_set(self, rng: np.random.Generator, fingers: int) -> FloatArray:
        """Draw a set of fingers (fingers, 2) [m]."""
        for _ in range(_MAX_TRIES):
            positions = self.draw(rng, fingers)
            if least_gap(positions) > self.apart:
                return positions
        raise self._no_room(fingers)

    def _no_room(self, fingers: int) -> InputError:
        return InputError(
            f"{fingers} fingers {1000 * self.apart:g} mm apart must find room in the regions of "
            f"contacts, found none in {_MAX_TRIES} draws; lower apart or quiet, or enlarge the "
            "regions"
        )


def _default_quiet(contents: int) -> tuple[int, int]:
    """Return the minimum and maximum number of quiet fingers."""
    return _QUIET_WITH_ONE_CONTENT if contents == 1 else _QUIET_WITH_SEVERAL


def anywhere(plate: Plate, contents: int = 1) -> ContactRule:
    """Return the rule for fingers anywhere on a plate.

    With one content, 1 to 3 other fingers are quiet; with several, up to one.
    """
    whole_plate = Rectangle(0.0, 0.0, plate.length, plate.width)
    draw = partial(_drawn, [whole_plate], plate)
    return ContactRule(_default_quiet(contents), DEFAULT_FINGER_GAP, draw, contents=contents)


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
    given = tuple(np.array(contacts.positions) for contacts in section.sets)
    quiet = section.quiet or _default_quiet(contents)
    problems = _contact_problems(section, given, plate, contents=contents, quiet=quiet)
    message = next(problems, None)
    if message is not None:
        raise InputError(f"{document.source}: {message}")
    shapes = [region.shape for region in section.regions.values()]
    draw = partial(_drawn, shapes, plate)
    return ContactRule(quiet, section.apart, draw, given, contents)


def _contact_problems(
    section: "_ContactsSection",
    given: Sequence[FloatArray],
    plate: Plate,
    *,
    contents: int,
    quiet: tuple[int, int],
) -> Iterator[str]:
    """Yield the problems of a file's contacts; given: positions [m] of its sets."""
    for number, contacts in enumerate(section.sets):
        with_content = len(contacts.with_content)
        if with_content != contents or len(contacts.positions) < MIN_FINGERS:
            yield (
                f"sets[{number}] must have {contents} fingers with contents (target or own) and "
                f"another finger, got {with_content} and {len(contacts.quiet)} quiet ones"
            )
    for number, positions in enumerate(given):
        for x, y in positions.tolist():
            if not plate.contains(x, y):
                yield (
                    f"sets[{number}] must be on the plate, from (0, 0) to ({plate.length:g}, "
                    f"{plate.width:g}) m, got ({x:g}, {y:g}) m"
                )
    if bool(section.sets) == bool(section.regions):
        yield f"must have regions or sets, got {'both' if section.sets else 'neither'}"
    low, high = quiet
    minimum = max(0, MIN_FINGERS - contents)
    maximum = MAX_CONTACTS - contents
    if not minimum <= low <= high <= maximum:
        yield (
            f"quiet must be two numbers from {minimum} to {maximum}, ascending, got {low}, {high}"
        )


def _drawn(
    shapes: Sequence[RegionShape], plate: Plate, rng: np.random.Generator, count: int
) -> FloatArray:
    """Draw each finger in one of the shapes, all equally likely."""
    numbers = rng.integers(len(shapes), size=count)
    return np.array([_drawn_in(shapes[number], plate, rng) for number in numbers])


def _drawn_in(shape: RegionShape, plate: Plate, rng: np.random.Generator) -> Point:
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
    def with_content(self) -> list[PointSection]:
        """Fingers with contents."""
        return self.own if self.target is None else [self.target, *self.own]

    @property
    def positions(self) -> list[PointSection]:
        """All fingers, the ones with contents first."""
        return [*self.with_content, *self.quiet]


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
