"""A table that follows what is learned of its plate, in a millisecond instead of a build.

Modulus and thickness scale the modes that the table holds, springs, dampers, gains, losses and mode
deviations are values of the rig, and masses and moved ERAs act where the raster gives their shapes.
For changes as a plate in service has them; a rig that is another is built anew.
"""

import math
from dataclasses import astuple, fields, replace

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.plate import Plate
from model.table.table import LocalizationTable

_SAME_PLACE = 1e-9  # m
_MAX_SCALE, _MAX_SCALE_ON_AIR = 0.1, 0.01  # mass and stiffness of air do not follow the plate's


def table_following(table: LocalizationTable, rig: Rig) -> LocalizationTable:
    """The table for a rig whose parameters differ from those that it was built for.

    Raises InputError for other ERAs, a plate that differs in more than modulus, thickness, losses
    and deviations of modes, those of all layers alike, and for frequencies or masses of modes that
    differ by more than 10 %, 1 % before an air gap.
    """
    before, after = table.plate, rig.plate
    names = [era.name for era in table.eras]
    if [era.name for era in rig.eras] != names:
        raise InputError(
            f"ERAs must be {', '.join(names)}, those of the table, got "
            f"{', '.join(era.name for era in rig.eras)}; build it again"
        )
    thicker = after.thickness / before.thickness
    stiffer = after.material.E / before.material.E
    like = replace(
        before.scaled(modulus=stiffer, thickness=thicker),
        loss_factor=after.loss_factor,
        loss_exponent=after.loss_exponent,
        mode_deviations=after.mode_deviations,
    )
    for field, own, other in zip(fields(Plate), astuple(like), astuple(after), strict=True):
        if not _is_same(own, other):
            raise InputError(
                f"plate.{field.name} must be that of the table, but for one factor on all moduli "
                f"and one on all thicknesses, {own}, got {other}; build it again"
            )
    faster = thicker * np.sqrt(stiffer)
    max_scale = _MAX_SCALE if before.air_gap is None else _MAX_SCALE_ON_AIR
    if max(abs(thicker - 1), abs(faster - 1)) > max_scale:
        raise InputError(
            f"thickness and frequencies must be within {100 * max_scale:g} % of the table's, got "
            f"factors of {thicker:.4g} and {faster:.4g}; build it again"
        )
    return replace(
        table,
        plate=after,
        eras=rig.eras,
        masses=rig.masses,
        uncertainty=rig.uncertainty,
        fingertip=rig.fingertip,
        threshold=rig.threshold,
        omega=faster * table.omega,
        losses=faster**2 * table.losses,
        dispersion=faster**2 * table.dispersion,
        attachment_shapes=_attachment_shapes(table, rig) / np.sqrt(thicker),
        shapes=(table.shapes / np.float32(np.sqrt(thicker))).astype(np.float32),
    )


def _is_same(one: object, other: object) -> bool:
    """Whether values, and those in them, are the same but for rounding."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_is_same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other)
    return one == other


def _attachment_shapes(table: LocalizationTable, rig: Rig) -> FloatArray:
    """Shapes (eras + masses, r) where the rig has them, as built where nothing has changed."""
    own, places = (footprints_of(each.eras, each.masses) for each in (table, rig))
    shapes = table.shapes_at(places)
    for number, place in enumerate(places):
        same = np.flatnonzero(np.abs(own - place).max(axis=1) < _SAME_PLACE)
        if len(same):
            shapes[number] = table.attachment_shapes[same[0]]
    return shapes
