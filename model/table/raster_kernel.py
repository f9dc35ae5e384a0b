"""Shapes under fingertips, by a kernel in C or else by `model.table.raster`."""

from array import array
from collections.abc import Sequence
from ctypes import c_void_p
from itertools import chain
from weakref import WeakKeyDictionary

import numpy as np

from model.arrays import Point
from model.compiled.kernels import kernels, run
from model.compiled.structures import GivenRaster
from model.finger.fingertip import (
    FINE_POINTS,
    FINGERTIP_RADIUS,
    FIVE_AND_FINE,
    FIVE_POINTS,
    GAUSS_LEGENDRE,
)
from model.table.raster import FingertipShapes
from model.table.table import LocalizationTable

_FEW, _FINE = len(FIVE_POINTS.points), len(FINE_POINTS.points)


def read_fingertips(table: LocalizationTable, places: Sequence[Point]) -> FingertipShapes:
    """Shapes at fingertips centred at places [m] of a table's plate."""
    by = kernels()
    if by is None:
        return table.raster.fingertips(np.array(places), table.shapes)
    on, k = given_raster(table), len(places)
    at = array("d", chain.from_iterable(places))
    sizes = (k, _FEW, on.r), (k, _FINE, on.r), (k, _FEW), (k, _FINE)
    found = [np.empty(size, dtype=np.float32) for size in sizes]
    to = [c_void_p(each.ctypes.data) for each in found]
    run(by.library.fingertips_stage, on, c_void_p(at.buffer_info()[0]), k, *to)
    return FingertipShapes(*found)


def given_raster(table: LocalizationTable) -> GivenRaster:
    """The raster of a table as kernels read it, kept with it."""
    kept = _kept.get(table)
    if kept is not None:
        return kept
    raster = table.raster
    found = GivenRaster(raster.nx, raster.ny, *raster.patch, table.shapes.shape[1], _FEW, _FINE)
    found.length, found.width, found.radius = raster.length, raster.width, FINGERTIP_RADIUS
    found.point(
        points=FIVE_AND_FINE.points,
        weights=FIVE_AND_FINE.weights,
        nodes=GAUSS_LEGENDRE,
        shapes=table.shapes,
    )
    return _kept.setdefault(table, found)


_kept: WeakKeyDictionary[LocalizationTable, GivenRaster] = WeakKeyDictionary()
