"""Layouts to be ranked: from a file, or the rig's own, named ones and random ones."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from era_haptics.lab.design.problem import MIN_SUPPORTING, DesignProblem
from model.arrays import FloatArray, Point
from model.config.document import read_document
from model.config.fields import Section, Validation
from model.config.shapes import PointSection
from model.errors import InputError
from model.rig.era_layouts import named_layouts

NamedLayouts = dict[str, FloatArray]
"""Positions of the ERAs [m] (n, 2) by layout name, kept ERAs first."""

_OWN = "own"
"""Name of the rig's own layout."""

_RANDOM_PREFIX = "random:"
_MAX_LAYOUTS = 1_000_000
_MAX_DIGITS = 9  # int() is slow for thousands of digits
_TRIES = 20  # draws per layout, since some repeat earlier ones
_DECIMALS = 9  # of positions [m] that are equal


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
    layouts_by_problem = {problem: layouts_of(text, problem) for problem in problems}
    for problem, layouts in layouts_by_problem.items():
        if any(problem.support_deficit(positions) == 0 for positions in layouts.values()):
            return layouts_by_problem
    raise InputError(
        f"at least one layout must support the plate with its lowest rigid-body frequency at "
        f"least {problems[0].lowest:g} Hz and weight on each ERA; add ERAs "
        "or stiffer ones, widen where, or reduce lowest"
    )


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
    layouts: NamedLayouts = {}
    keys: set[bytes] = set()
    for name, positions in _possible_layouts(problem, count):
        key = np.unique(positions.round(_DECIMALS), axis=0).tobytes()
        if key not in keys:
            keys.add(key)
            unique_name = name or f"{problem.count}-{len(layouts) + 1:06d}"
            layouts[unique_name] = positions
        if len(layouts) == count:
            break
    return layouts


def _possible_layouts(problem: DesignProblem, count: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield names (empty for random layouts) and positions, which can repeat."""
    if len(problem.rig.eras) == problem.count and not problem.kept:
        yield _OWN, problem.own_positions
    kept_positions = problem.kept_positions
    for layout in named_layouts(problem.count - len(kept_positions)):
        new_positions = layout.positions(problem.rig.plate)
        positions = np.vstack([kept_positions, new_positions])
        if problem.area.contains(new_positions).all() and problem.are_apart(positions):
            yield layout.name, positions
    rng = np.random.default_rng(problem.seed)
    for _ in range(_TRIES * count):
        yield "", problem.random_layout(rng)


def _layouts_of_file(path: Path, problem: DesignProblem) -> NamedLayouts:
    """Read the layouts of a file."""
    document = read_document(
        path, if_empty="it must have layouts, each with a name and its positions"
    )
    section = Validation(document, _LayoutsSection).finish()
    layouts: NamedLayouts = {}
    for name, points in section.layouts.items():
        positions = np.vstack([problem.kept_positions, np.array(points)])
        message = _layout_problem(points, positions, problem)
        if message is not None:
            raise InputError(f"{path}: layouts.{name} {message}")
        layouts[name] = positions
    return layouts


def _layout_problem(
    points: Sequence[Point], positions: FloatArray, problem: DesignProblem
) -> str | None:
    """Return the first problem of new points [m] and all positions (n, 2) [m]; None without one."""
    plate = problem.rig.plate
    for x, y in points:
        if not plate.contains(x, y):
            return (
                f"must be on the plate, from (0, 0) to ({plate.length:g}, {plate.width:g}) m, got "
                f"({x:g}, {y:g}) m"
            )
    mounts = len(positions) + problem.supports
    if mounts < MIN_SUPPORTING:
        return f"must have at least {MIN_SUPPORTING} mounts to support the plate, got {mounts}"
    if not problem.are_apart(positions):
        return (
            f"must have ERAs at least {1000 * problem.apart:g} mm apart; move them, or reduce apart"
        )
    return None
