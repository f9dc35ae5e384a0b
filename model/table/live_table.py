"""A table that follows what is learned of its plate, in a millisecond instead of a build.

Modulus and thickness scale the modes that the table holds, springs, dampers, gains, losses and mode
deviations are values of the rig, and masses and moved ERAs act where the raster gives their shapes.
For changes as a plate in service has them; a rig that is another is built anew.
"""

from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.table.table import LocalizationTable

_SAME_PLACE = 1e-9  # m
_MAX_SCALE = 0.1


def table_following(table: LocalizationTable, rig: Rig) -> LocalizationTable:
    """The table for a rig whose parameters differ from those that it was built for.

    Raises InputError for a plate of other sides, density or ratio, for other ERAs, and for
    frequencies or masses of modes that differ by more than 10 %.
    """
    before, after = table.plate, rig.plate
    names = [era.name for era in table.eras]
    if [era.name for era in rig.eras] != names:
        raise InputError(
            f"ERAs must be {', '.join(names)}, those of the table, got "
            f"{', '.join(era.name for era in rig.eras)}; build it again"
        )
    fixed = ("length", "width", "air_gap")
    material = ("rho", "nu")
    parts: list[tuple[object, object, str]] = [(before, after, key) for key in fixed]
    parts += [(before.material, after.material, key) for key in material]
    for own, other, key in parts:
        if getattr(own, key) != getattr(other, key):
            raise InputError(
                f"plate.{key} must be {getattr(own, key)}, that of the table, got "
                f"{getattr(other, key)}; build it again"
            )
    thicker = after.thickness / before.thickness
    faster = thicker * np.sqrt(after.material.E / before.material.E)
    if max(abs(thicker - 1), abs(faster - 1)) > _MAX_SCALE:
        raise InputError(
            f"thickness and frequencies must be within {100 * _MAX_SCALE:g} % of the table's, got "
            f"factors of {thicker:.3g} and {faster:.3g}; build it again"
        )
    return replace(
        table,
        plate=after,
        eras=rig.eras,
        masses=rig.masses,
        uncertainty=rig.uncertainty,
        fingertip=rig.fingertip,
        omega=faster * table.omega,
        losses=faster**2 * table.losses,
        dispersion=faster**2 * table.dispersion,
        attachment_shapes=_attachment_shapes(table, rig) / np.sqrt(thicker),
        shapes=(table.shapes / np.float32(np.sqrt(thicker))).astype(np.float32),
    )


def _attachment_shapes(table: LocalizationTable, rig: Rig) -> FloatArray:
    """Shapes (eras + masses, r) where the rig has them, as built where nothing has moved."""
    own = footprints_of(table.eras, table.masses)[:, :2]
    places = footprints_of(rig.eras, rig.masses)[:, :2]
    shapes = table.shapes_at([(float(x), float(y)) for x, y in places])
    for number, place in enumerate(places):
        same = np.flatnonzero(np.abs(own - place).max(axis=1) < _SAME_PLACE)
        if len(same):
            shapes[number] = table.attachment_shapes[same[0]]
    return shapes
