"""Area of a plate that is allowed for ERAs: its edge, the whole plate, or polygons from a file."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from model.arrays import FloatArray
from model.config.document import read_document
from model.config.fields import Section, Validation
from model.config.shapes import Polygon, PolygonSection
from model.errors import InputError
from model.rig.key_types import Identifier
from model.structure.plate import Plate

EDGE, ANYWHERE = "edge", "anywhere"
"""Names of areas without a file."""

_ON_EDGE = 1e-9  # m
_MAX_RASTER = 8000  # points of the finest raster over the plate
_MAX_REFINEMENTS = 6
_REFINEMENT = 0.7

PointTest = Callable[[FloatArray], NDArray[np.bool_]]
"""Returns whether points (n, 2) [m] satisfy a condition, (n,)."""


@dataclass(frozen=True)
class Area:
    """Part of a plate of a length and a width [m] in which a function of points (n, 2) is true.

    text: identifies it; its name, or the content of its file.
    """

    text: str
    length: float
    width: float
    contains: PointTest

    def candidates(self, spacing: float) -> FloatArray:
        """Return the points of a raster over the plate, edges included, that are in the area."""
        columns = max(1, round(self.length / spacing))
        rows = max(1, round(self.width / spacing))
        x = np.linspace(0, self.length, columns + 1)
        y = np.linspace(0, self.width, rows + 1)
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return points[self.contains(points)]

    def moved(self, position: FloatArray, step: float) -> FloatArray:
        """Return a position moved by +/- step in x and in y, clipped at the plate's edges."""
        steps = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        positions = np.clip(position + steps, 0, [self.length, self.width])
        has_moved = (np.abs(positions - position) > _ON_EDGE).any(axis=1)
        return positions[has_moved & self.contains(positions)]


def area_of(where: str, plate: Plate) -> Area:
    """Return a named area, or the area in a file of polygons.

    Raises InputError for another kind of file, or an unreadable file.
    """
    if where == EDGE:
        return _area_on(plate, where, partial(_on_edge, plate.length, plate.width))
    if where == ANYWHERE:
        return _area_on(plate, where, everywhere)
    path = Path(where)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(
            f"where must be {EDGE}, {ANYWHERE} or a .yaml file of polygons, got {where!r}"
        )
    document = read_document(
        path, if_empty="it must have polygons, each with a name and its corners"
    )
    section = Validation(document, _PolygonsSection).finish()
    polygons = [Polygon(tuple(corners)) for corners in section.polygons.values()]
    return _area_on(plate, document.text, partial(_in_any, polygons))


def _area_on(plate: Plate, text: str, is_allowed: PointTest) -> Area:
    """Return the allowed part of a plate, outside the cut-outs of a surface."""
    return Area(text, plate.length, plate.width, partial(_both, plate.covers, is_allowed))


def everywhere(points: FloatArray) -> NDArray[np.bool_]:
    """Return True for every point (n, 2), (n,)."""
    return np.ones(len(points), dtype=bool)


def _both(first: PointTest, second: PointTest, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether points (n, 2) satisfy two conditions."""
    return np.asarray(first(points) & second(points))


def _on_edge(length: float, width: float, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether points (n, 2) are on the edge of a plate."""
    gaps = np.minimum(np.abs(points), np.abs([length, width] - points))
    return np.asarray((gaps <= _ON_EDGE).any(axis=1))


def _in_any(polygons: Sequence[Polygon], points: FloatArray) -> NDArray[np.bool_]:
    """Return whether points (n, 2) are in any of the polygons, edges included."""
    is_inside = []
    for x, y in points.tolist():
        is_inside.append(any(polygon.contains(x, y) for polygon in polygons))
    return np.array(is_inside, dtype=bool)


class _PolygonsSection(Section):
    """Polygons allowed for ERAs, by name."""

    polygons: Annotated[dict[Identifier, PolygonSection], Field(min_length=1, max_length=256)]


def candidates_of(area: Area, *, count: int) -> tuple[FloatArray, float]:
    """Return about `count` candidate positions (c, 2) [m], and their spacing [m].

    Raises InputError if the area contains none.
    """
    plate_area = area.length * area.width
    spacing = math.sqrt(plate_area / count)
    if area.text == EDGE:
        spacing = 2 * (area.length + area.width) / count
    for _ in range(_MAX_REFINEMENTS):  # a small area needs a finer raster
        positions = area.candidates(spacing)
        if len(positions) >= count / 2:
            return positions, spacing
        if plate_area / spacing**2 > _MAX_RASTER:
            break
        spacing *= _REFINEMENT
    if len(positions) == 0:
        raise InputError(
            "where must leave room for ERAs on the plate, got none; check that its polygons are on "
            "the plate, in meters from its corner"
        )
    return positions, spacing
