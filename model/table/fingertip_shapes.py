"""Mode shapes under fingertips, read from the raster of a table in C or in numpy."""

from array import array
from collections.abc import Sequence
from ctypes import c_void_p
from dataclasses import dataclass
from itertools import chain
from weakref import WeakKeyDictionary

import numpy as np

from model.arrays import Float32Array, Point
from model.compiled.kernels import GivenRaster, kernels, run_kernel
from model.finger import (
    FINE_POINTS,
    FINGERTIP_RADIUS,
    FIVE_AND_FINE,
    FIVE_POINTS,
    GAUSS_LEGENDRE,
    fingertips_on,
)
from model.table.record import TableRecord

_FEW, _FINE = len(FIVE_POINTS.points), len(FINE_POINTS.points)

_given_rasters: WeakKeyDictionary[TableRecord, GivenRaster] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class FingertipShapes:
    """Shapes (k, p, r) under k fingertips, and weights (k, p) of the points in a fingertip's mean.

    At few points for searches, and at fine ones for predictions; the center comes first.
    """

    few: Float32Array
    fine: Float32Array
    few_weights: Float32Array
    fine_weights: Float32Array
    touch_steps: Float32Array | None
    """Standard deviation (k, 3) of each finger's position along x and y, as a fraction of the
    distance between both ends of the fingertip, and 1 for a fingertip that no edge cuts, else 0.

    Multiplied by the difference of a field between the ends, a fraction is the field's change. None
    for exact positions.
    """


def read_fingertips(table: TableRecord, positions: Sequence[Point]) -> FingertipShapes:
    """Return shapes at fingertips centered at positions [m], with a C kernel if available."""
    compiled = kernels()
    if compiled is None:
        return fingertips_by_numpy(table, positions)
    raster = given_raster(table)
    count = len(positions)
    centers = array("d", chain.from_iterable(positions))
    sizes = (count, _FEW, raster.r), (count, _FINE, raster.r), (count, _FEW), (count, _FINE)
    results = [np.empty(size, dtype=np.float32) for size in sizes]
    pointers = [c_void_p(result.ctypes.data) for result in results]
    run_kernel(
        compiled.library.fingertips_stage,
        raster,
        c_void_p(centers.buffer_info()[0]),
        count,
        *pointers,
    )
    few, fine, few_weights, fine_weights = results
    steps = _touch_steps(table, positions)
    return FingertipShapes(few, fine, few_weights, fine_weights, steps)


def fingertips_by_numpy(table: TableRecord, positions: Sequence[Point]) -> FingertipShapes:
    """Return shapes at fingertips centered at positions [m], without the kernel."""
    raster = table.raster
    centers = np.array(positions)
    points, weights = fingertips_on(
        centers, length=raster.length, width=raster.width, rule=FIVE_AND_FINE
    )
    numbers, interpolation = raster.patches(centers, points)
    shapes = interpolation @ table.shapes.take(numbers, axis=0)
    few_weights, fine_weights = weights.astype(np.float32)
    return FingertipShapes(
        few=np.ascontiguousarray(shapes[:, :_FEW]),
        fine=np.ascontiguousarray(shapes[:, _FEW:]),
        few_weights=few_weights[:, :_FEW],
        fine_weights=fine_weights[:, _FEW:],
        touch_steps=_touch_steps(table, positions),
    )


def _touch_steps(table: TableRecord, positions: Sequence[Point]) -> Float32Array | None:
    """Return the `touch_steps` of fingertips centered at positions [m]."""
    offset = table.uncertainty.touch_offset
    if not offset:
        return None
    centers = np.array(positions)
    sides = np.array([table.raster.length, table.raster.width])
    low = np.maximum(centers - FINGERTIP_RADIUS, 0.0)
    high = np.minimum(centers + FINGERTIP_RADIUS, sides)
    steps = offset / (high - low)
    is_whole = (low > 0).all(axis=1) & (high < sides).all(axis=1)
    return np.column_stack([steps, is_whole]).astype(np.float32)


def given_raster(table: TableRecord) -> GivenRaster:
    """Return the raster of a table as kernels read it, made once for each table."""
    cached = _given_rasters.get(table)
    if cached is not None:
        return cached
    raster = table.raster
    given = GivenRaster(raster.nx, raster.ny, *raster.patch, table.shapes.shape[1], _FEW, _FINE)
    given.length = raster.length
    given.width = raster.width
    given.radius = FINGERTIP_RADIUS
    given.point(
        points=FIVE_AND_FINE.points,
        weights=FIVE_AND_FINE.weights,
        nodes=GAUSS_LEGENDRE,
        shapes=table.shapes,
    )
    return _given_rasters.setdefault(table, given)
