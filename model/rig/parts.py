"""Conversion of the sections of a rig file to values of the model."""

import math
from dataclasses import fields, replace

from model.rig.sections import (
    EraSection,
    FingertipSection,
    LimitsSection,
    MassSection,
    PlateSection,
)
from model.structure.attachments import Era, Fingertip, PointLoad, damping_from_ratio
from model.structure.laminate_section import equivalent_plate
from model.structure.plate import AirGap, Laminate, LaminateLayer, Material, Plate
from registry.limits import GuardLimits

_OF_PLATE = {each.name for each in fields(Plate)} - {"thickness", "material", "air_gap"}
_OF_ERA = {each.name for each in fields(Era)} - {"damping", "gains"}
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


def era_of(name: str, section: EraSection, plate: Plate, *, era_count: int) -> Era:
    """An ERA; era_count: of the rig, for the damping from a ratio."""
    damping = section.damping
    if damping is None:
        damping = damping_from_ratio(
            section.damping_ratio,
            stiffness=section.stiffness,
            plate_mass=plate.mass,
            era_count=era_count,
        )
    x, y = _onto(plate, section.at)
    return Era(
        name=name,
        x=x,
        y=y,
        damping=damping,
        gains=tuple((f, size, math.radians(phase)) for f, size, phase in section.gains or ()),
        **section.model_dump(include=_OF_ERA),
    )


def mass_of(section: MassSection, plate: Plate) -> PointLoad:
    """A mass on the plate."""
    x, y = _onto(plate, section.at)
    return PointLoad(x, y, **section.model_dump(exclude={"at"}))


def limits_of(section: LimitsSection) -> GuardLimits:
    """The limits of commands; infinite where none is given."""
    low, high = section.frequency
    given = section.model_dump(exclude={"frequency"}, exclude_none=True)
    return GuardLimits(frequency_min=low, frequency_max=high, **given)


def fingertip_of(section: FingertipSection | str) -> Fingertip | None:
    """The load of a fingertip; None for weightless ones."""
    return None if isinstance(section, str) else Fingertip(**section.model_dump())


def _onto(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """A place clipped to the plate, off whose edge rounding may have put it."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)
