"""Conversion of the sections of a rig file to values of the model."""

import math
from dataclasses import fields, replace

from model.rig.key_types import place_on
from model.rig.sections import (
    FingertipSection,
    LimitsSection,
    MassSection,
    PlateSection,
)
from model.structure.attachments import Fingertip, PointLoad
from model.structure.laminate_section import equivalent_plate
from model.structure.plate import AirGap, Laminate, LaminateLayer, Material, Plate
from registry.limits import GuardLimits

_OF_PLATE = {each.name for each in fields(Plate)} - {"thickness", "material", "air_gap"}
"""Fields that have the values of the keys of their names."""


def plate_of(section: PlateSection, *, frequency_max: float) -> Plate:
    """The plate; what is like a homogeneous one of a laminate is so at the highest frequency."""
    gap, laminate = section.air_gap, laminate_of(section)
    stated = section.model_dump(include=_OF_PLATE) | {
        "mode_deviations": tuple((2 * math.log(f), math.log(loss)) for f, loss in section.modes),
        "air_gap": None if gap is None else AirGap(**gap.model_dump()),
    }
    if laminate is not None:
        plate = equivalent_plate(
            laminate, length=section.length, width=section.width, frequency=frequency_max
        )
        return replace(plate, **stated)
    assert section.thickness is not None  # noqa: S101  see model.rig.checks
    assert section.material is not None  # noqa: S101
    return Plate(
        thickness=section.thickness, material=Material(**section.material.model_dump()), **stated
    )


def laminate_of(section: PlateSection) -> Laminate | None:
    """The laminate of the plate; None without layers."""
    if section.layers is None:
        return None
    layers = (
        LaminateLayer(
            Material(**layer.material.model_dump()),
            layer.thickness,
            loss_factor=layer.loss_factor or 0.0,
            by_frequency=tuple(layer.by_frequency or ()),
        )
        for layer in section.layers
    )
    return Laminate(tuple(layers), bond=section.bond)


def mass_of(section: MassSection, plate: Plate) -> PointLoad:
    """A mass on the plate."""
    x, y = place_on(plate, section.at)
    return PointLoad(x, y, **section.model_dump(exclude={"at"}))


def limits_of(section: LimitsSection) -> GuardLimits:
    """The limits of commands; infinite where none is given."""
    low, high = section.frequency
    given = section.model_dump(exclude={"frequency"}, exclude_none=True)
    return GuardLimits(frequency_min=low, frequency_max=high, **given)


def fingertip_of(section: FingertipSection | str) -> Fingertip | None:
    """The load of a fingertip; None for weightless ones."""
    return None if isinstance(section, str) else Fingertip(**section.model_dump())
