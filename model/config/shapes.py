"""Shapes: regions of the plate, and the sections of files that describe them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, TypeAlias

from pydantic import Field, Strict

from model.arrays import Point
from model.config.fields import Quantity, Section
from model.config.units import LENGTH

_CIRCLE_CORNERS = 60  # a multiple of 4
_TOLERANCE = 1e-9  # m; a point this close to a side is on it


@dataclass(frozen=True)
class Rectangle:
    """A rectangle from its south-west corner (x, y), width along x and height along y."""

    x: float
    y: float
    width: float
    height: float

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the rectangle."""
        return self.x <= x <= self.x + self.width and self.y <= y <= self.y + self.height

    @property
    def center(self) -> Point:
        """The center of area."""
        return (self.x + self.width / 2, self.y + self.height / 2)

    def corners(self) -> Sequence[Point]:
        """Return the four corners."""
        east, north = self.x + self.width, self.y + self.height
        return ((self.x, self.y), (east, self.y), (east, north), (self.x, north))

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "shape": "rectangle",
            "x_m": self.x,
            "y_m": self.y,
            "width_m": self.width,
            "height_m": self.height,
        }


@dataclass(frozen=True)
class Circle:
    """A circle around (x, y)."""

    x: float
    y: float
    radius: float

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the circle."""
        return math.dist((x, y), (self.x, self.y)) <= self.radius

    @property
    def center(self) -> Point:
        """The center of the circle."""
        return (self.x, self.y)

    def corners(self) -> Sequence[Point]:
        """Return points around it, among them those farthest along x and y."""
        angles = [2 * math.pi * number / _CIRCLE_CORNERS for number in range(_CIRCLE_CORNERS)]
        return [
            (self.x + self.radius * math.cos(angle), self.y + self.radius * math.sin(angle))
            for angle in angles
        ]

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {"shape": "circle", "x_m": self.x, "y_m": self.y, "radius_m": self.radius}


@dataclass(frozen=True)
class Polygon:
    """Polygon defined by corners; crossing sides follow the even-odd rule."""

    points: tuple[Point, ...]

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is within the polygon: a ray to the east crosses its sides an odd
        number of times."""
        if not self._box.contains(x, y):
            return False
        is_within = False
        for (x0, y0), (x1, y1) in zip(self.points, (*self.points[1:], self.points[0]), strict=True):
            if _is_on_side(x, y, (x0, y0), (x1, y1)):
                return True
            if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                is_within = not is_within
        return is_within

    @cached_property
    def _box(self) -> Rectangle:
        """The bounding box: a fast test that most points fail."""
        xs, ys = zip(*self.points, strict=True)
        return Rectangle(
            min(xs) - _TOLERANCE,
            min(ys) - _TOLERANCE,
            max(xs) - min(xs) + 2 * _TOLERANCE,
            max(ys) - min(ys) + 2 * _TOLERANCE,
        )

    @property
    def center(self) -> Point:
        """Centroid, or the mean of the corners if crossing sides leave no area."""
        following = (*self.points[1:], self.points[0])
        cross = [
            x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(self.points, following, strict=True)
        ]
        area = sum(cross) / 2
        if abs(area) < _TOLERANCE:
            xs, ys = zip(*self.points, strict=True)
            return (sum(xs) / len(xs), sum(ys) / len(ys))
        x = y = 0.0
        for (x0, y0), (x1, y1), product in zip(self.points, following, cross, strict=True):
            x += (x0 + x1) * product
            y += (y0 + y1) * product
        return (x / (6 * area), y / (6 * area))

    def corners(self) -> Sequence[Point]:
        """Return all corners."""
        return self.points

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {"shape": "polygon", "points_m": [list(point) for point in self.points]}


RegionShape: TypeAlias = Rectangle | Circle | Polygon
"""A part of the plate; lengths in meters, from the plate's south-west corner."""


def _is_on_side(x: float, y: float, start: Point, end: Point) -> bool:
    """Return whether a point is on a side, within a nanometer."""
    length = math.dist(start, end)
    if length == 0:
        return (x, y) == start
    along = ((x - start[0]) * (end[0] - start[0]) + (y - start[1]) * (end[1] - start[1])) / length
    across = ((x - start[0]) * (end[1] - start[1]) - (y - start[1]) * (end[0] - start[0])) / length
    return abs(across) <= _TOLERANCE and -_TOLERANCE <= along <= length + _TOLERANCE


_Length = Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)]
PointSection = Annotated[tuple[_Length, _Length], Strict(strict=False)]  # a list in the file
PolygonSection = Annotated[list[PointSection], Field(min_length=3, max_length=64)]


class RectangleSection(Section):
    """Two opposite corners."""

    start: PointSection
    end: PointSection


class CircleSection(Section):
    """A center and a radius."""

    at: PointSection
    radius: Annotated[float, Quantity(LENGTH, above=0, at_most=10)]


class ShapedSection(Section):
    """Section with exactly one shape."""

    rectangle: RectangleSection | None = None
    circle: CircleSection | None = None
    polygon: PolygonSection | None = None

    @property
    def shape(self) -> RegionShape:
        """The shape of the section."""
        if self.rectangle is not None:
            (x0, y0), (x1, y1) = self.rectangle.start, self.rectangle.end
            return Rectangle(min(x0, x1), min(y0, y1), abs(x1 - x0), abs(y1 - y0))
        if self.circle is not None:
            return Circle(*self.circle.at, self.circle.radius)
        return Polygon(tuple(self.polygon or ()))

    def shape_problem(self, sides: Point | None) -> tuple[tuple[str, ...], str] | None:
        """Return the key and the problem of a section without a single shape on the plate, else
        None.

        sides [m]: length and width of the plate, None for any plate.
        """
        keys = [name for name in ShapedSection.model_fields if getattr(self, name) is not None]
        if len(keys) != 1:
            known_keys = ", ".join(ShapedSection.model_fields)
            return (), f"must have one of {known_keys}, got {' and '.join(keys) or 'none'}"
        (x0, y0), (x1, y1) = box_of(self.shape)
        length, width = sides or (x1, y1)
        d = _TOLERANCE
        if sides is None or (min(x0, y0) >= -d and x1 <= length + d and y1 <= width + d):
            return None
        return (keys[0],), (
            f"must lie on the plate of {length:g} m by {width:g} m, got ({x0:g}, {y0:g}) to "
            f"({x1:g}, {y1:g}) m; coordinates start at its south-west corner"
        )


def box_of(shape: RegionShape) -> tuple[Point, Point]:
    """South-west and north-east corner of the box around a shape."""
    xs, ys = zip(*shape.corners(), strict=True)
    return (min(xs), min(ys)), (max(xs), max(ys))
