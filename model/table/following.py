"""A table that follows what is learned of its plate, in a millisecond instead of a build.

Modulus and thickness scale the modes that the table holds, springs, dampers, gains, losses and mode
deviations are values of the rig, and masses and moved ERAs act where the raster gives their shapes.
For changes as a plate in service has them; a rig that is another is built anew.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig, differences
from model.structure.attachments import footprints_of
from model.structure.exciter import Actuator
from model.structure.modal_elasticity import check_scales
from model.structure.plate import Plate
from model.table.table import LocalizationTable

_Part = TypeVar("_Part", bound=Plate | Actuator)

_SAME_PLACE = 1e-9  # m
_MAX_SCALE, _MAX_SCALE_ON_AIR = 0.1, 0.01  # mass and stiffness of air do not follow the plate's


_FOLLOWED = ("masses", "uncertainty", "fingertip", "threshold")
_FOLLOWED_OF_PLATE = ("loss_factor", "loss_exponent", "mode_deviations")
"""Fields of a rig and its plate that may differ, beside `LEARNED` of its ERAs.

All others must be the table's.
"""


def table_following(table: LocalizationTable, rig: Rig) -> LocalizationTable:
    """The table for a rig whose parameters differ from those that it was built for.

    Raises InputError for a rig that differs in more than modulus and thickness, those of all layers
    alike, and what is followed; for frequencies or masses of modes that differ by more than 10 %,
    1 % before an air gap; and for a plate of which a part does not scale.
    """
    before, after = table.plate, rig.plate
    thicker = after.thickness / before.thickness
    stiffer = after.material.E / before.material.E
    others = {era.name: era for era in rig.eras}
    like = replace(
        table,
        plate=_taking(before.scaled(modulus=stiffer, thickness=thicker), after, _FOLLOWED_OF_PLATE),
        eras=tuple(_taking(era, others.get(era.name, era), era.LEARNED) for era in table.eras),
        **{name: getattr(rig, name) for name in _FOLLOWED},
    )
    if different := differences(like, rig):
        raise InputError(
            "a table can follow one factor on all moduli and one on all thicknesses; but for that "
            f"{'; '.join(different)}; build it again"
        )
    check_scales(before, thicker, stiffer, remedy="build the table again")
    faster = thicker * np.sqrt(stiffer)
    max_scale = _MAX_SCALE if before.air_gap is None else _MAX_SCALE_ON_AIR
    if max(abs(thicker - 1), abs(faster - 1)) > max_scale:
        raise InputError(
            f"thickness and frequencies must be within {100 * max_scale:g} % of the table's, got "
            f"factors of {thicker:.4g} and {faster:.4g}; build it again"
        )
    return replace(
        like,
        omega=faster * table.omega,
        losses=faster**2 * table.losses,
        dispersion=faster**2 * table.dispersion,
        attachment_shapes=_attachment_shapes(table, rig) / np.sqrt(thicker),
        shapes=(table.shapes / np.float32(np.sqrt(thicker))).astype(np.float32),
    )


def _taking(own: _Part, other: _Part, names: Sequence[str]) -> _Part:
    """A part of a rig with some fields of another, unless that is of another kind."""
    if type(other) is not type(own):
        return own
    return replace(own, **{name: getattr(other, name) for name in names})


def _attachment_shapes(table: LocalizationTable, rig: Rig) -> FloatArray:
    """Shapes (eras + masses, r) where the rig has them, as built where nothing has changed."""
    own, places = (footprints_of(each.eras, each.masses) for each in (table, rig))
    shapes = table.shapes_at(places)
    for number, place in enumerate(places):
        same = np.flatnonzero(np.abs(own - place).max(axis=1) < _SAME_PLACE)
        if len(same):
            shapes[number] = table.attachment_shapes[same[0]]
    return shapes
