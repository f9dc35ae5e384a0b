"""Mean square errors of the fields of a table's ERAs.

The errors of a field u of reduced coordinates, relative to the mean square u^H G u over the plate
with the mean products G of the shapes, are its discretization error and the rig's `field`. An
object of the rig's `foreign_mass` adds the mean square change of the field, averaged over possible
positions. A position error d of an ERA changes its shape by d times the slope of the shape, mostly
like an error of its stiffness (`model.ensemble.attached_plate.with_places`).
"""

from collections.abc import Iterator

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray
from model.ensemble.attached_plate import PlateOnEras, with_places
from model.ensemble.touched_plate import TouchedPlate
from model.finger import Grid
from model.structure.attachments import footprints_of
from model.structure.exciter import Exciter
from model.structure.fingertips import object_load
from model.table.record import TableRecord, mean_products

_OBJECT_POSITIONS = Grid(6, 5)
"""Cells whose centers are the positions of an object that the rig's uncertainty expects."""

OBJECT_FACTOR = 6.0
"""Factor on the mean square change of fields by an object, which is far larger near fingers and
ERAs.

Chosen so that about 80 % of the promises are kept (`benchmarks.promise everyday`).
"""

_EDGE = 0.05
"""Fraction of the plate's sides, at each end, where errors of exciters' fields do not count: there
shapes bend most, and few fingers rest."""


def mean_square_over_plate(record: TableRecord, fields: Complex64Array) -> FloatArray:
    """Return the mean square over the plate of fields (..., r) in its coordinates, (...)."""
    return np.asarray(np.vecdot(fields, fields @ record.mean_products).real, dtype=float)


def field_errors(record: TableRecord, on_eras: PlateOnEras) -> Float32Array:
    """Return mean square errors (f, eras) from discretization and the rig's uncertainty."""
    error = np.hypot(record.discretization_error, record.uncertainty.field)[:, None]
    power = error**2 * mean_square_over_plate(record, on_eras.fields)
    for change in _changes_by_object(record, on_eras):
        power += change
    return np.asarray(power, dtype=np.float32)


def _changes_by_object(record: TableRecord, on_eras: PlateOnEras) -> Iterator[FloatArray]:
    """Yield the part (f, eras) of each position of an object in the mean square change."""
    mass = record.uncertainty.foreign_mass
    if not mass:
        return
    by_frequency = object_load(mass).dynamic_stiffness(on_eras.plate.omega)
    stiffness = by_frequency.astype(np.complex64)[:, None]
    positions = record.shapes_at(_OBJECT_POSITIONS.centers(record.plate)).astype(np.float32)
    load_std = np.zeros(1, np.float32)
    for position in positions[:, None]:
        loaded = TouchedPlate(on_eras, position, stiffness, load_std)
        change = mean_square_over_plate(record, loaded.coordinates() - on_eras.fields)
        yield change * (OBJECT_FACTOR / len(positions))


def with_position_errors(
    record: TableRecord, on_eras: PlateOnEras
) -> tuple[PlateOnEras, FloatArray]:
    """Include position errors of the ERAs in a plate, as larger errors of their stiffness.

    Also return the mean square errors (f, eras) of exciters' fields that stiffness errors do not
    cover.
    """
    if not record.uncertainty.place:
        return on_eras, np.zeros(on_eras.plate.forces.shape)
    points = record.raster.points
    distance_to_center = np.abs(points / points[-1] - 0.5)
    is_inner = (distance_to_center < 0.5 - _EDGE).all(axis=1)
    inner_shapes = record.shapes[is_inner & record.plate.covers(points)]
    are_exciters = [isinstance(era, Exciter) for era in record.eras]
    shifts = _shape_shifts(record)
    return with_places(on_eras, shifts, mean_products(inner_shapes), are_exciters)


def _shape_shifts(record: TableRecord) -> FloatArray:
    """Change of the shapes at ERAs for a position error along x and along y, (n, 2, r).

    From the shapes at both ends of an error in either direction, which stay on the plate.
    """
    distance = record.uncertainty.place
    footprints = footprints_of(record.eras)
    ends = np.repeat(footprints[:, None, None], 4, axis=1).reshape(len(footprints), 2, 2, -1)
    for axis, side in enumerate((record.raster.length, record.raster.width)):
        ends[:, axis, :, axis] += [distance, -distance]
        ends[:, axis, :, axis].clip(0.0, side, out=ends[:, axis, :, axis])
    shapes = record.shapes_at(ends.reshape(-1, 3)).reshape(*ends.shape[:3], -1)
    apart = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1, keepdims=True)
    return np.asarray((shapes[:, :, 0] - shapes[:, :, 1]) * (distance / apart))
