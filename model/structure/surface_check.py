"""Checks of a surface's modes against physics, before any promise is computed.

In a mode phi of unit modal mass, the integral of phi² over the mass of the part is 1. Elastic modes
are orthogonal to rigid-body motion. A free part has that motion in its rigid-body modes, a held
part in its lowest elastic modes.

The mass distribution is unknown and assumed to be even. Ribs, frames and lumped masses change the
results, and so do few nodes that do not reach the edges. The limits leave room for both. The
comments state the ranges measured on plates with frames of up to three times and lumped masses of
1.7 times their own mass, free and held in ten ways, at 12 to 180 nodes.

Impossible modes raise InputError. Suspicious modes give a note, which is shown as a warning.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, lattice
from model.errors import InputError
from model.files.modal_file import ModeShapes
from model.quantities import counted
from model.structure.surface import (
    RIGID_FREQUENCY,
    SurfaceShapes,
    evenly_spaced,
    is_within,
    surface_shapes,
)

_UNITS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254}
_MIN_SIDE, _MAX_SIDE = 0.01, 10.0  # m, of the longer side
_MIN_EXPECTED_SIDE, _MAX_EXPECTED_SIDE = 0.03, 3.0
_MIN_DENSITY, _MAX_DENSITY = 0.02, 2000.0  # kg/m²; paper has 0.08, 25 cm of steel 2000
_MIN_EXPECTED_DENSITY, _MAX_EXPECTED_DENSITY = 0.1, 300.0

_EQUAL_FREQUENCY, _EQUAL_SHAPE = 1e-3, 0.999  # relative difference, and MAC
_CLOSE_FREQUENCY, _CLOSE_SHAPE = 0.01, 0.98
_SEEN = 1e-3  # size of a shape that is more than rounding, relative to the median
_MANY_IN_PAIRS = 0.4  # share of modes in close pairs, for example of two preloaded steps

_SCALE_LIMIT, _EXPECTED_SCALE = 10.0, 3.0
"""Limits for the factor between the median integral of phi² and 1; measured: 0.43 to 2.7."""

_RIGID_SCALE_LIMIT = 50.0
"""Limit for rigid-body modes; measured: 0.09 to 2.7 if the nodes cover a quarter of the part."""

_NORMALIZED_SCALE = 1.4
"""Limit for shapes that look normalized in another way; measured: 0.97 to 1.03 on even plates."""

_SAME_VALUE = 5e-4  # relative difference after rounding to four digits
_MIN_TIES, _TIES, _NEARLY_ALL = 3, 0.2, 0.9  # modes with the same value; shares of all modes

_MIN_CARRIED, _EXPECTED_CARRIED = 0.3, 0.45
"""Share of rigid-body translation in the modes. Measured: 0.61 to 1 on held panels; in the elastic
modes of free panels 0, and 0.26 with a rib of half the panel's mass."""

_EVEN_MASS = 0.15  # relative difference of the moments of inertia from an even distribution
_MAX_MIXED = 0.6
"""Share of rigid-body motion in elastic modes of a free part with even mass; 0 in theory."""

_MIN_NODES = 12
"""With six random nodes the median integral of phi² on even plates was 0.4 to 3.5."""
_NODES_FOR_ROTATIONS = 30
_NODES_PER_MODE = 3
_MAX_NODES, _LINES, _MIN_RASTER = 300, 28, 50
"""Interpolated nodes; lines of the raster a side, and its points within the surface."""


@lru_cache(maxsize=8)
def check_surface(file: str, digest: str, normal: str, mass: float | None) -> tuple[str, ...]:
    """Return notes on suspicious modes in a file; raises InputError for impossible modes.

    mass: stated mass [kg]; None to take the mass from the rigid-body modes.
    """
    shapes = surface_shapes(file, digest, normal)
    known_mass = shapes.mass if mass is None else mass
    try:
        notes = [*_check_sides(shapes), *_check_pairs(shapes.modes)]
        motion = _on_raster(shapes)
        notes += _check_density(motion, known_mass)
        notes += _check_scale(shapes, motion, known_mass)
        if len(shapes.points) >= _MIN_NODES:
            notes += _check_rigid_motion(shapes, motion)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    name = Path(file).name
    return tuple(f"surface: {name}: {note}" for note in notes)


def _check_sides(shapes: SurfaceShapes) -> Iterator[str]:
    """Check that the surface has a plausible size in meters."""
    longer = float(shapes.size.max())
    what = f"sides must be in meters, got {_sides(shapes.size)} m"
    units = [
        f"{_sides(shapes.size * factor)} m if they are in {unit}"
        for unit, factor in _UNITS.items()
        if _MIN_EXPECTED_SIDE <= longer * factor <= _MAX_EXPECTED_SIDE
    ]
    guess = f" ({', '.join(units)})" if units else ""
    remedy = (
        "convert nodes and places to meters, and shapes with them; a universal file states its "
        "units in dataset 164"
    )
    if not _MIN_SIDE <= longer <= _MAX_SIDE:
        raise InputError(f"{what}{guess}; {remedy}")
    if not _MIN_EXPECTED_SIDE <= longer <= _MAX_EXPECTED_SIDE:
        yield f"sides of {_sides(shapes.size)} m are unusual{guess}; {remedy}"


def _sides(size: FloatArray) -> str:
    return " x ".join(f"{side:.3g}" for side in size)


def _check_pairs(modes: ModeShapes) -> Iterator[str]:
    """Check that no mode is in the file twice."""
    apart, alike = _pairs(modes)
    is_equal = (apart < _EQUAL_FREQUENCY) & (alike > _EQUAL_SHAPE)
    is_close = (apart < _CLOSE_FREQUENCY) & (alike > _CLOSE_SHAPE)
    close = np.argwhere(is_close)
    if not len(close):
        return
    are_many = len(np.unique(close)) > _MANY_IN_PAIRS * len(modes.frequencies)
    has_nodes = len(modes.nodes) >= _MIN_NODES
    pairs = counted(len(close), "pair")
    if is_equal.any() or (are_many and has_nodes):
        first = np.argwhere(is_equal)[0] if is_equal.any() else close[0]
        raise InputError(
            f"modes must differ, got {_named(modes, first)} with the same frequency and shape, "
            f"{pairs} in all; keep one export, one *FREQUENCY step and one of the equal modes"
        )
    if has_nodes:
        yield (
            f"{_named(modes, close[0])} have nearly the same shape, {pairs} in all; if a pair is "
            "one mode that was identified twice, remove one of the two"
        )


def _pairs(modes: ModeShapes) -> tuple[FloatArray, FloatArray]:
    """Relative differences of frequency and MAC of pairs of modes, (r, r), above the diagonal."""
    shapes = modes.shapes.reshape(len(modes.frequencies), -1)
    products = shapes @ shapes.T
    squares = np.diag(products)
    sizes = np.outer(squares, squares)
    # Modes within the surface have rounding errors instead of a shape along the normal.
    is_seen = squares > _SEEN**2 * np.median(squares)
    pairs = np.outer(is_seen, is_seen) & (sizes > 0)
    alike = np.divide(products**2, sizes, out=np.zeros_like(sizes), where=pairs)
    # Rigid-body modes have the same frequency apart from rounding.
    frequencies = np.where(modes.frequencies < RIGID_FREQUENCY, 0.0, modes.frequencies)
    higher = np.maximum.outer(frequencies, frequencies)
    apart = np.abs(np.subtract.outer(frequencies, frequencies)) / np.maximum(higher, 1.0)
    return apart, np.triu(alike, 1)


def _named(modes: ModeShapes, pair: NDArray[np.int_]) -> str:
    """Two modes: their numbers in the file and their frequencies."""
    first, second = (int(number) for number in pair)
    return (
        f"modes {first + 1} and {second + 1} (at {modes.frequencies[first]:.5g} and "
        f"{modes.frequencies[second]:.5g} Hz)"
    )


@dataclass(frozen=True)
class _Motion:
    """Motion along the normal on an even raster of p points within the surface."""

    area: float
    """Area of the surface [m²], NaN if it is unknown."""

    rigid: FloatArray
    """Shapes of rigid-body modes (p, a) [1/sqrt(kg)]."""

    elastic: FloatArray
    """Shapes (p, r) of the lowest elastic modes, as many as the nodes resolve [1/sqrt(kg)]."""

    bodies: FloatArray
    """Translation and rotations (p, 3), orthogonal, with a mean square of 1."""


def _on_raster(shapes: SurfaceShapes) -> _Motion:
    """Interpolate shapes with the spline that tables use; raises InputError for too few rows."""
    from scipy.interpolate import RBFInterpolator  # slow to import
    from scipy.spatial import Delaunay

    chosen = evenly_spaced(shapes.points, _MAX_NODES)
    nodes = shapes.points[chosen]
    x, y = (nodes / shapes.size).T
    if np.linalg.matrix_rank(np.column_stack([x**0, x, y, x * x, x * y, y * y]), tol=1e-6) < 6:
        raise InputError(
            "nodes must be in three rows or more along both sides of the surface, got fewer; "
            "export more nodes of the touch face"
        )
    middles = (np.arange(_LINES) + 0.5) / _LINES
    raster = lattice(middles * shapes.size[0], middles * shapes.size[1])
    is_inside = Delaunay(nodes).find_simplex(raster) >= 0
    if shapes.outline:
        is_inside &= is_within(shapes.outline, raster)
    area = float(np.prod(shapes.size)) * is_inside.mean()
    raster = raster[is_inside]
    if len(raster) < _MIN_RASTER:  # a surface that is narrower than the raster
        area, raster = math.nan, nodes
    resolved = shapes.rigid + max(_NODES_PER_MODE, len(nodes) // _NODES_PER_MODE)
    values = np.hstack([shapes.shapes[chosen, :resolved], shapes.motions[chosen]])
    spline = RBFInterpolator(nodes, values, kernel="cubic", degree=2)
    interpolated = spline(raster)
    bodies, _ = np.linalg.qr(interpolated[:, -3:])
    return _Motion(
        area,
        interpolated[:, : shapes.rigid],
        interpolated[:, shapes.rigid : -3],
        bodies * math.sqrt(len(raster)),
    )


def _check_density(motion: _Motion, mass: float) -> Iterator[str]:
    """Check that a mass [kg] is plausible for the area; NaN for an unknown mass."""
    density = mass / motion.area
    what = f"{mass:.3g} kg on {motion.area:.3g} m², {density:.3g} kg/m²"
    remedy = "check surface.mass, and the units of modal masses and shapes (kg, not t or g)"
    if density < _MIN_DENSITY or density > _MAX_DENSITY:
        raise InputError(f"mass must be plausible, got {what}; {remedy}")
    if density < _MIN_EXPECTED_DENSITY or density > _MAX_EXPECTED_DENSITY:
        yield f"unusual mass: {what}; {remedy}"


def _check_scale(shapes: SurfaceShapes, motion: _Motion, mass: float) -> Iterator[str]:
    """Check that shapes are of unit modal mass; mass [kg]: NaN for an unknown mass."""
    if math.isnan(mass):
        return
    typical = float(np.median(mass * (motion.elastic**2).mean(axis=0)))
    of_rigid = _squares_of(motion.rigid, mass)
    integral = (
        f"the integral of shape² over {mass:.3g} kg is {typical:.2g} in most elastic modes "
        "instead of 1"
    )
    remedy = (
        "export shapes of unit modal mass, or modal masses with them, and check surface.mass and "
        "all units"
    )
    normalization = _normalization(shapes.modes)
    is_scaled = _is_near_one([typical, *of_rigid], _NORMALIZED_SCALE)
    if normalization and not is_scaled:
        raise InputError(
            f"shapes must be of unit modal mass, got shapes that look {normalization}: {integral}; "
            f"{remedy}"
        )
    if not _is_near_one([typical], _SCALE_LIMIT):
        raise InputError(f"shapes must be of unit modal mass: {integral}; {remedy}")
    if not _is_near_one(of_rigid, _RIGID_SCALE_LIMIT):
        raise InputError(
            "rigid-body modes must be of unit modal mass: the integral of shape² over "
            f"{mass:.3g} kg is {', '.join(f'{value:.2g}' for value in of_rigid)} instead of 1; "
            f"{remedy}"
        )
    if len(shapes.points) < _MIN_NODES:
        yield (
            f"{len(shapes.points)} nodes are too few to check scale and rigid-body motion of the "
            f"modes; export or measure {_MIN_NODES} or more"
        )
    elif not _is_near_one([typical], _EXPECTED_SCALE):
        yield f"shapes may not be of unit modal mass: {integral}; {remedy}"


def _squares_of(shapes: FloatArray, mass: float) -> list[float]:
    """Integrals of squared orthogonal mixtures of shapes (p, r) over a mass [kg]."""
    products = mass * shapes.T @ shapes / len(shapes)
    return [float(square) for square in np.linalg.eigvalsh(products)]


def _is_near_one(values: Sequence[float], factor: float) -> bool:
    """Whether all values differ from 1 by a factor at most."""
    return all(1 / factor <= value <= factor for value in values)


def _normalization(modes: ModeShapes) -> str:
    """Describe a normalization other than to unit modal mass; empty if there is no sign of another.

    The common value of all modes is a power of ten, or its root if units of mass were converted.
    """
    shapes = modes.shapes.reshape(len(modes.frequencies), len(modes.nodes), -1)
    lengths = [np.linalg.norm(shape, axis=1) for shape in shapes]
    largest_values = np.array([np.abs(shape).max() for shape in shapes])
    largest_lengths = np.array([length.max() for length in lengths])
    sizes = np.array([np.linalg.norm(length) for length in lengths])
    count = len(shapes)
    for largest in (largest_values, largest_lengths):
        # The largest value of some modes may be at nodes that were not exported.
        ties = int(_is_same(largest, largest.max()).sum())
        if ties >= max(_MIN_TIES, _TIES * count) and _is_round(float(largest.max())):
            return f"normalized to their largest value ({ties} of {count} modes have the same)"
    for what, values in (
        ("to unit length", sizes),
        ("to their mean square", sizes / math.sqrt(len(modes.nodes))),
    ):
        middle = float(np.median(values))
        ties = int(_is_same(values, middle).sum())
        if ties >= _NEARLY_ALL * count and _is_round(middle):
            return f"normalized {what} ({ties} of {count} modes)"
    of_last, of_next = np.abs(shapes[-1]), np.abs(shapes[-2])
    is_candidate = _is_same(of_next, of_last)
    same = _is_same(np.abs(shapes[:, is_candidate]), of_last[is_candidate])
    ties = int(same.sum(axis=0).max(initial=0))
    if ties >= _NEARLY_ALL * count:
        return f"normalized to one node ({ties} of {count} modes have the same value there)"
    return ""


def _is_same(values: FloatArray, value: FloatArray | float) -> NDArray[np.bool_]:
    """Whether positive values are the same apart from rounding."""
    return (np.abs(values - value) <= _SAME_VALUE * value) & (values > 0)


def _is_round(value: float) -> bool:
    """Whether a value is a power of ten or its square root, apart from rounding."""
    if value <= 0:
        return False
    half_decades = 2 * math.log10(value)
    return abs(half_decades - round(half_decades)) < 2 * _SAME_VALUE / math.log(10)


def _check_rigid_motion(shapes: SurfaceShapes, motion: _Motion) -> Iterator[str]:
    """Check that the modes express rigid-body motion, and the elastic modes of a free part none."""
    bodies, elastic = motion.bodies, motion.elastic
    count = len(bodies)
    # Cosines between bodies and modes.
    in_elastic = bodies.T @ elastic / count / np.sqrt((elastic**2).mean(axis=0))
    basis, _ = np.linalg.qr(motion.rigid)
    in_rigid = bodies.T @ basis / math.sqrt(count)
    shares = in_rigid @ in_rigid.T + in_elastic @ in_elastic.T
    carried = float(shares[0, 0])
    if 0 < shapes.rigid < 3 and len(shapes.points) >= _NODES_FOR_ROTATIONS:
        carried = min(carried, float(np.linalg.eigvalsh(shares)[0]))
    missing = (
        f"modes must include rigid-body motion, got {100 * carried:.0f} %: {shapes.rigid} "
        f"modes below {RIGID_FREQUENCY:g} Hz move along the normal, and in the others the surface "
        "does not move as a whole, as in elastic modes of a free part"
    )
    remedy = (
        "export all rigid-body modes with them, or the modes of the part as it is held, from the "
        "lowest on"
    )
    if carried < _MIN_CARRIED:
        raise InputError(f"{missing}; {remedy}")
    if carried < _EXPECTED_CARRIED:
        yield (
            f"modes express little rigid-body motion, {100 * carried:.0f} %; if the part is free, "
            f"{remedy}"
        )
    if shapes.rigid < 3 or math.isnan(shapes.mass):
        return
    has_even_mass = _is_near_one(_squares_of(motion.rigid, shapes.mass), 1 + _EVEN_MASS)
    mixed = float(np.linalg.eigvalsh(in_elastic @ in_elastic.T)[-1])
    if has_even_mass and mixed > _MAX_MIXED:
        raise InputError(
            "elastic modes of a free part must be orthogonal to rigid-body motion, got modes that "
            f"move as a whole ({100 * mixed:.0f} % of a rigid-body motion); export the modes "
            "of the free part or of the held part, not both"
        )
