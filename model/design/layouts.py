"""Lists of layouts to be ranked: of a file, or the rig's own, those with a name, random ones."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from model.arrays import FloatArray
from model.config.document import read_document
from model.config.sections import Section, Validation
from model.design.area import PointSection
from model.design.problem import MIN_SUPPORTING, DesignProblem
from model.errors import InputError
from model.rig.layouts import named_layouts

OWN = "own"
"""Name of the rig's own layout."""

MAX_LAYOUTS = 1_000_000

_RANDOM = re.compile(r"random:(\d{1,9})")
_TRIES = 20  # draws for each layout, of which some are there already

NamedLayouts = dict[str, FloatArray]
"""Positions [m] (n, 2) of the ERAs by the name of a layout, those kept first."""


class _LayoutsSection(Section):
    """Places of the ERAs that are not kept, by the name of the layout."""

    layouts: Annotated[
        dict[str, Annotated[list[PointSection], Field(min_length=1, max_length=32)]],
        Field(min_length=1),
    ]


def supported_layouts(
    text: str, problems: Sequence[DesignProblem]
) -> dict[DesignProblem, NamedLayouts]:
    """The `layouts_of` each problem; raises InputError where none supports the plate."""
    given = {problem: layouts_of(text, problem) for problem in problems}
    if not any(
        problem.shortfall(each) == 0 for problem in given for each in given[problem].values()
    ):
        raise InputError(
            f"a layout of --layouts must support the plate with its lowest rigid-body frequency at "
            f"least {problems[0].lowest:g} Hz and weight on each ERA, got none that does; add ERAs "
            "or stiffer ones, widen --where, or lower --lowest"
        )
    return given


def layouts_of(text: str, problem: DesignProblem) -> NamedLayouts:
    """The layouts of `random:N` or of a file; raises InputError for what is wrong in it."""
    found = _RANDOM.fullmatch(text)
    if found is None:
        return _layouts_of_file(Path(text), problem)
    count = int(found[1])
    if not 1 <= count <= MAX_LAYOUTS:
        raise InputError(f"--layouts must be random:1 to random:{MAX_LAYOUTS}, got {text}")
    return random_layouts(problem, count)


def random_layouts(problem: DesignProblem, count: int) -> NamedLayouts:
    """A number of different layouts: the rig's own, those with a name, others at candidates.

    The first two where they are in the area. Fewer where there are no more; a longer list starts
    with a shorter one.
    """
    found: NamedLayouts = {}
    known: set[bytes] = set()
    for name, positions in _drawn(problem, count):
        key = np.unique(positions.round(9), axis=0).tobytes()
        if key not in known:
            known.add(key)
            found[name or f"{problem.count}-{len(found) + 1:06d}"] = positions
        if len(found) == count:
            break
    return found


def _drawn(problem: DesignProblem, count: int) -> Iterator[tuple[str, FloatArray]]:
    """Names, empty for random ones, and positions."""
    if len(problem.rig.eras) == problem.count and not problem.kept:
        yield OWN, problem.own_positions
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
    document = read_document(path, if_empty="it must have layouts, each a name with places")
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
                "lower --apart"
            )
        found[name] = positions
    return found
