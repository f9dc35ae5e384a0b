"""Where ERAs may stand: along the edge, anywhere, in polygons, on the white of a picture."""

import io
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from model.arrays import FloatArray
from model.config.document import read_bytes, read_document
from model.config.fields import Polygon, PolygonSection, Section, Validation
from model.errors import InputError
from model.rig.actuator_keys import Identifier
from model.structure.plate import Plate

EDGE, ANYWHERE = "edge", "anywhere"
"""Names of the areas that need no file."""

PICTURES = (".png", ".jpg", ".jpeg")

PROPORTION_TOLERANCE = 0.02
"""By how much the height of a picture may differ from the plate's proportions, relative."""

_PICTURE_SIDE = 1000  # pixels of the longer side of the picture proposed
_MAX_BYTES = 16 << 20
_ON_EDGE = 1e-9  # m
_MAX_CANDIDATES = 2000


@dataclass(frozen=True)
class Area:
    """A part of a plate of a length and a width [m], where a function of points (n, 2) is true.

    text: what identifies it: its name, or the content of its file.
    """

    text: str
    length: float
    width: float
    contains: Callable[[FloatArray], NDArray[np.bool_]]

    def candidates(self, spacing: float) -> FloatArray:
        """Places on a raster over the plate, edges included."""
        x, y = (
            np.linspace(0, side, max(1, round(side / spacing)) + 1)
            for side in (self.length, self.width)
        )
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return places[self.contains(places)]

    def moved(self, place: FloatArray, step: float) -> FloatArray:
        """A step along x and y, to and fro, no further than the plate's edges."""
        steps = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        places = np.clip(place + steps, 0, [self.length, self.width])
        is_other = (np.abs(places - place) > _ON_EDGE).any(axis=1)
        return places[is_other & self.contains(places)]


def area_of(where: str, plate: Plate) -> Area:
    """The area of a name, a picture or a file of polygons.

    Raises InputError for a picture that cannot be read or has other proportions than the plate, and
    for another kind of file.
    """
    length, width = plate.length, plate.width
    if where in (EDGE, ANYWHERE):
        contains = everywhere if where == ANYWHERE else partial(_on_edge, length, width)
        return Area(where, length, width, contains)
    path = Path(where)
    if path.suffix.lower() in PICTURES:
        content = read_bytes(path, _MAX_BYTES, is_for="draw it smaller", give="a picture")
        contains = partial(_is_white, _white(path, content, plate), length, width)
        return Area(content.hex(), length, width, contains)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(
            f"where must be {EDGE}, {ANYWHERE}, a picture ({', '.join(PICTURES)}) or a .yaml "
            f"file of polygons, got {where!r}"
        )
    document = read_document(path, if_empty="it must have polygons, each a name with its corners")
    polygons = Validation(document, _PolygonsSection).finish().polygons
    shapes = [Polygon(tuple(each)) for each in polygons.values()]
    return Area(document.text, length, width, partial(_in_any, shapes))


def everywhere(points: FloatArray) -> NDArray[np.bool_]:
    """True for every point (n, 2), (n,)."""
    return np.ones(len(points), dtype=bool)


def candidates_of(area: Area, *, count: int) -> tuple[FloatArray, float]:
    """About a count of candidate places, (c, 2) [m], and how far apart they are [m].

    Raises InputError for an area without any.
    """
    size = area.length * area.width
    spacing = math.sqrt(size / count)
    if area.text == EDGE:
        spacing = 2 * (area.length + area.width) / count
    for _ in range(6):  # of a small area the raster is finer
        places = area.candidates(spacing)
        if len(places) >= count / 2:
            return places, spacing
        if size / spacing**2 > _MAX_CANDIDATES * 4:
            break
        spacing *= 0.7
    if len(places) == 0:
        raise InputError(
            "where must leave room for ERAs on the plate, got none; check that it is in metres, "
            "from the plate's corner, and white where ERAs may stand"
        )
    return places, spacing


def _on_edge(length: float, width: float, points: FloatArray) -> NDArray[np.bool_]:
    """Whether points (n, 2) are on the edge of a plate."""
    gaps = np.minimum(np.abs(points), np.abs([length, width] - points))
    return np.asarray((gaps <= _ON_EDGE).any(axis=1))


def _in_any(polygons: Sequence[Polygon], points: FloatArray) -> NDArray[np.bool_]:
    """Whether points (n, 2) are in any of some polygons, their edges included."""
    found = [any(each.contains(x, y) for each in polygons) for x, y in points.tolist()]
    return np.array(found, dtype=bool)


def _is_white(
    white: NDArray[np.bool_], length: float, width: float, points: FloatArray
) -> NDArray[np.bool_]:
    """Whether points are in the white: rows from the top, y = width, down; columns from x = 0."""
    rows, columns = white.shape
    column = np.minimum((points[:, 0] / length * columns).astype(int), columns - 1)
    row = np.minimum(((1 - points[:, 1] / width) * rows).astype(int), rows - 1)
    return np.asarray(white[row, column])


class _PolygonsSection(Section):
    """Polygons in which ERAs may stand, by name."""

    polygons: Annotated[dict[Identifier, PolygonSection], Field(min_length=1, max_length=256)]


def _white(path: Path, content: bytes, plate: Plate) -> NDArray[np.bool_]:
    """Pixels brighter than half, (rows, columns), of a picture with the plate's proportions.

    To PROPORTION_TOLERANCE, or half a pixel.
    """
    from matplotlib.image import imread

    try:
        with warnings.catch_warnings(action="error"):  # of one that takes more memory than it may
            pixels = np.asarray(imread(io.BytesIO(content), path.suffix[1:].lower()), dtype=float)
    except Exception as error:  # of a damaged file anything
        raise InputError(
            f"{path}: cannot be read as a picture; save it as PNG or JPEG, of {_PICTURE_SIDE} "
            "pixels a side or less"
        ) from error
    rows, columns = pixels.shape[:2]
    expected = columns * plate.width / plate.length
    if abs(rows - expected) > max(PROPORTION_TOLERANCE * expected, 0.5):
        scale = _PICTURE_SIDE / max(plate.length, plate.width)
        across, up = (max(1, round(side * scale)) for side in (plate.length, plate.width))
        raise InputError(
            f"{path}: must have the proportions of the plate of {plate.length:g} m by "
            f"{plate.width:g} m, got {columns} by {rows} pixels; draw the whole plate, without a "
            f"margin, for example on {across} by {up} pixels"
        )
    grey = pixels if pixels.ndim == 2 else pixels[..., :3].mean(axis=-1)
    return np.asarray(grey > (127.5 if grey.max() > 1 else 0.5))
