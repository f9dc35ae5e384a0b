"""Contact sets for which a plate is designed: fingers with contents, and some quiet ones."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, Strict

from model.arrays import FloatArray, IntArray, best_of, least_gap
from model.config.document import read_document
from model.config.fields import (
    LENGTH,
    Point,
    PointSection,
    Quantity,
    Rectangle,
    Section,
    Shape,
    ShapedSection,
    Validation,
    box_of,
)
from model.errors import InputError
from model.finger import MAX_CONTACTS, MAX_CONTENTS
from model.rig.actuator_keys import Identifier
from model.structure.plate import Plate

DEFAULT_APART = 0.05
"""Distance [m] between the fingers of a set."""

DEFAULT_QUIET = {True: (1, 3), False: (0, 1)}
"""Fewest and most quiet fingers beside one content, and beside several."""

MIN_FINGERS = 2
"""Fingers of a set."""

_MAX_TRIES = 20_000
_DRAWN_FOR_EACH = 8  # drawn for each place of a pool, of which the loneliest is taken

Draw = Callable[[np.random.Generator, int], FloatArray]
"""Draws places [m] (n, 2)."""


@dataclass(frozen=True, eq=False)
class ContactRule:
    """Distribution of contact sets: anywhere, in regions, or those given.

    quiet: fewest and most quiet fingers; apart [m]: between fingers; draw: of places; given: sets
    of contacts (fingers, 2) [m], which replace all that; contents: how
    many fingers of a set, its first ones, feel a content of their own.
    """

    quiet: tuple[int, int]
    apart: float
    draw: Draw
    given: tuple[FloatArray, ...] = ()
    contents: int = 1

    def sets(self, count: int, *, seed: int) -> list[FloatArray]:
        """Draw about a count of sets, as many for each number of quiet fingers.

        Those given are taken in turn. Raises InputError where fingers find no room.
        """
        rng = np.random.default_rng(seed)
        if self.given:
            order = rng.permutation(len(self.given))
            return [self.given[number] for number in order[:count]]
        low, high = self.quiet
        kinds = high - low + 1
        return [self._one(rng, self.contents + low + number % kinds) for number in range(count)]

    def pooled_sets(self, fingers: int, *, seed: int) -> list[FloatArray]:
        """Sets of a number of fingers only, far apart, each the first once for each number.

        For what is computed once for each finger. Sets given are taken as they are, up to three for
        each finger.
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
        """Numbers of a finger and a count of others of a pool that are far enough apart."""
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
            f"contacts, got none in {_MAX_TRIES} draws; lower apart or quiet, or enlarge the "
            "regions"
        )


def anywhere(plate: Plate, contents: int = 1) -> ContactRule:
    """Fingers with contents and DEFAULT_QUIET ones anywhere on a plate."""
    draw = partial(_drawn, [Rectangle(0.0, 0.0, plate.length, plate.width)], plate)
    return ContactRule(DEFAULT_QUIET[contents == 1], DEFAULT_APART, draw, contents=contents)


def contact_rule(path: Path | None, plate: Plate, contents: int = 1) -> ContactRule:
    """The rule of a file, regions as those of a surface layout, or sets; `anywhere` for None.

    contents: at the same time, each for a finger of its own. Raises ConfigError for what is wrong
    in the file.
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
        f"sets[{number}] must have {contents} fingers with contents, target or own, and another "
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
    shapes: Sequence[Shape], plate: Plate, rng: np.random.Generator, count: int
) -> FloatArray:
    """Draw each finger in one of some shapes, each as likely as another."""
    chosen = rng.integers(len(shapes), size=count)
    return np.array([_place_in(shapes[number], plate, rng) for number in chosen])


def _place_in(shape: Shape, plate: Plate, rng: np.random.Generator) -> Point:
    """A place [m] of the plate in a shape; raises InputError where there is none."""
    box = box_of(shape)
    for _ in range(_MAX_TRIES):
        x, y = rng.uniform(*box).tolist()
        if plate.contains(x, y) and shape.contains(x, y):
            return x, y
    raise InputError("regions of contacts must have an area, got one that has none")


class _RegionSection(ShapedSection):
    """A region; what it plays, in a surface layout, does not matter here."""

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
    """Contacts of a design. Effects and the like of a surface layout are passed over."""

    quiet: Annotated[tuple[int, int], Strict(strict=False)] | None = None
    apart: Annotated[float, Quantity(LENGTH, at_least=0.026, at_most=10)] = DEFAULT_APART
    regions: Annotated[
        dict[Identifier, _RegionSection], Field(min_length=1, max_length=256, default_factory=dict)
    ]
    sets: Annotated[list[_SetSection], Field(min_length=1, max_length=1000, default_factory=list)]
    effects: Any = None
    elsewhere: Any = None
