"""Conversion of the sections of a rig file to values of the model."""

import math
from collections.abc import Iterable
from dataclasses import replace

from model.rig.key_types import place_on
from model.rig.sections import (
    ISOTROPIC,
    FingertipSection,
    LayerSection,
    LimitsSection,
    MassSection,
    MaterialSection,
    PlateSection,
    SupportSection,
    UncertaintySection,
)
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import Fingertip, PointLoad
from model.structure.feet_and_frames import EDGE_FOOT, FEET, FEET_DEVIATE, FOOT_LOSS, edge_points
from model.structure.laminate_section import equivalent_plate
from model.structure.materials import KnownMaterial
from model.structure.plate import AirGap, Laminate, LaminateLayer, Material, Orthotropy, Plate
from registry.limits import GuardLimits

_OF_PLATE = {"length", "width", "loss_exponent"}
"""Fields that have the values of the keys of their names."""


def plate_of(section: PlateSection, *, frequency_max: float) -> Plate:
    """The plate; what is like a homogeneous one of a laminate is so at the highest frequency."""
    gap, laminate = section.air_gap, laminate_of(section)
    stated = section.model_dump(include=_OF_PLATE) | {
        "loss_factor": _loss_factor(section),
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
    material = material_of(section.material, section.thickness)
    if section.grain == "width":
        material = material.turned()
    return Plate(thickness=section.thickness, material=material, **stated)


def _loss_factor(section: PlateSection) -> float:
    """That stated, or the greater one of a mounted panel's 1 % and of the material itself."""
    if section.loss_factor is not None:
        return section.loss_factor
    own = section.material.own_loss if isinstance(section.material, KnownMaterial) else 0.0
    return max(own, Plate.loss_factor)


def material_of(section: MaterialSection | KnownMaterial, thickness: float) -> Material:
    """The material of a board or layer of a thickness [m]; InputError for one of no solid."""
    if isinstance(section, KnownMaterial):
        return section.of_thickness(thickness)
    if section.E is not None and section.nu is not None:
        return Material(**section.model_dump(include={"name", "rho", *ISOTROPIC}))
    E1, E2, nu12 = section.E1, section.E2, section.nu12
    G12, G13, G23 = section.G12, section.G13, section.G23
    # see model.rig.checks
    assert E1 and E2 and G12 and G13 and G23 and nu12 is not None  # noqa: S101, PT018
    shares = Orthotropy(E2 / E1, G12 / E1, G13 / E1, G23 / E1)
    return Material(section.name, E1, section.rho, nu12, shares)


def laminate_of(section: PlateSection) -> Laminate | None:
    """The laminate of the plate; None without layers.

    A single layer stands for a material that depends on frequency.
    """
    if section.layers is None:
        known, thickness = section.material, section.thickness
        if known is None or not known.by_frequency or thickness is None:
            return None
        alone = material_of(known, thickness)
        return Laminate((LaminateLayer(alone, thickness, by_frequency=tuple(known.by_frequency)),))
    return Laminate(tuple(map(_layer_of, section.layers)), bond=section.bond)


def _layer_of(section: LayerSection) -> LaminateLayer:
    """A layer; its material's dependence on frequency holds unless it states losses of its own."""
    rows = section.by_frequency
    if rows is None and section.loss_factor is None:
        rows = [*(section.material.by_frequency or ())]
    return LaminateLayer(
        material_of(section.material, section.thickness),
        section.thickness,
        loss_factor=section.loss_factor or 0.0,
        by_frequency=tuple(rows or ()),
    )


def masses_of(section: MassSection, plate: Plate) -> tuple[PointLoad, ...]:
    """A mass on the plate, or those of a frame along its edges."""
    if section.at is not None:
        x, y = place_on(plate, section.at)
        return (PointLoad(x, y, mass=section.mass or 0.0, foot=section.foot),)
    per_length = section.mass_per_length or 0.0
    return tuple(
        PointLoad(x, y, mass=per_length * length, foot=EDGE_FOOT)
        for x, y, length in edge_points(plate, section.points)
    )


def supports_of(section: SupportSection, plate: Plate) -> tuple[PointLoad, ...]:
    """A foot under the plate, or springs along its edges."""
    damping, loss_factor = section.damping or 0.0, section.loss_factor
    if loss_factor is None:
        loss_factor = FOOT_LOSS if section.damping is None else 0.0
    spring = PointLoad(0.0, 0.0, damping=damping, loss_factor=loss_factor)
    if section.at is not None:
        stiffness = section.stiffness or FEET[section.kind or "foam"]
        x, y = place_on(plate, section.at)
        foot = replace(spring, x=x, y=y, foot=section.foot)
        return (replace(foot, stiffness=stiffness, is_foot=True),)
    edge, per_length = 2 * (plate.length + plate.width), section.stiffness_per_length or 0.0
    return tuple(
        replace(
            spring,
            x=x,
            y=y,
            stiffness=per_length * length,
            damping=damping * length / edge,
            foot=EDGE_FOOT,
        )
        for x, y, length in edge_points(plate, section.points)
    )


def uncertainty_of(section: UncertaintySection, feet: Iterable[SupportSection]) -> Uncertainty:
    """How well the rig is known; feet of which it says nothing as `FEET_DEVIATE`."""
    unknown = {"supports": FEET_DEVIATE} if any(foot.at is not None for foot in feet) else {}
    return Uncertainty(**(unknown | section.model_dump(exclude_none=True)))


def limits_of(section: LimitsSection) -> GuardLimits:
    """The limits of commands; infinite where none is given."""
    low, high = section.frequency
    given = section.model_dump(exclude={"frequency"}, exclude_none=True)
    return GuardLimits(frequency_min=low, frequency_max=high, **given)


def fingertip_of(section: FingertipSection | str) -> Fingertip | None:
    """The load of a fingertip; None for weightless ones."""
    return None if isinstance(section, str) else Fingertip(**section.model_dump())
