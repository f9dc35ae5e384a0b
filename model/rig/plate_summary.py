"""Numbers of a rig's plate and its exciters: materials, rigidity, bending wavelengths, types."""

import math
from typing import Any

from model.config.fields import Quantity, quantities
from model.rig.exciter_checks import exciters_of, sections_of
from model.rig.exciter_section import ExciterSection
from model.rig.rig import Rig
from model.rig.sections import PlateSection
from model.structure.exciter import Exciter
from model.structure.exciter_types import EXCITER_TYPES
from model.structure.laminate_section import (
    bending,
    freely_sliding,
    perfectly_bonded,
    wavenumber_of,
)
from model.structure.plate import AirGap, Bond, Laminate, Plate
from registry.limits import GuardLimits

FURTHER = {
    name: each.dimension
    for name, field in PlateSection.model_fields.items()
    for each in field.metadata
    if isinstance(each, Quantity) and name not in {"length", "width", "loss_factor"}
}
"""Keys of the plate that are plain quantities and have no line of their own in a summary."""


def plate_summary(rig: Rig) -> dict[str, Any]:
    """The plate that is solved, the laminate that it stands for, and what it carries.

    Keys carry their units. A laminate comes with both bounds of its rigidity, perfectly bonded and
    freely sliding layers, and, where its layers are bonded, the rigidity in free bending waves at
    both ends of the rig's frequencies.
    """
    plate, limits, gap = rig.plate, rig.limits, rig.plate.air_gap
    return {
        "length_m": plate.length,
        "width_m": plate.width,
        "thickness_m": plate.thickness,
        "material": plate.material.name,
        "E_pa": plate.material.E,
        "rho_kg_m3": plate.material.rho,
        "nu": plate.material.nu,
        "orthotropic": _grain(plate),
        "loss_factor": plate.loss_factor,
        "further": {each.key(name): getattr(plate, name) for name, each in FURTHER.items()},
        "mass_kg": plate.mass,
        "surface_density_kg_m2": plate.surface_density,
        "flexural_rigidity_n_m": plate.flexural_rigidity,
        "bending_wavelength_m": {
            f"{frequency:g}_hz": 2 * math.pi / wavenumber_of(plate.laminate, frequency).real
            if plate.laminate
            else plate.bending_wavelength(frequency)
            for frequency in (limits.frequency_min, limits.frequency_max)
        },
        "air_gap": None if gap is None else _air_gap(gap, limits),
        "point_masses": [
            {"at_m": [mass.x, mass.y], "mass_kg": mass.mass} for mass in rig.masses if mass.mass
        ],
        "supports": [
            {
                "at_m": [each.x, each.y],
                "stiffness_n_m": each.stiffness,
                "damping_n_s_m": each.damping,
                "loss_factor": each.loss_factor,
            }
            for each in rig.masses
            if each.stiffness
        ],
        "laminate": None if rig.laminate is None else _laminate(rig.laminate, limits),
        "exciters": [_exciter(one) for one in exciters_of(rig)],
        "exciter_types": _types(rig),
    }


def _grain(plate: Plate) -> dict[str, float] | None:
    """Numbers of a board along and across the plate's length; None of an isotropic plate."""
    material = plate.material
    if material.orthotropy is None:
        return None
    along, across = plate.rigidity_towards(1.0), plate.rigidity_towards(0.0)
    return {
        **{f"{key}_pa": each for key, each in material.moduli.items()},
        "nu12": material.nu,
        "flexural_rigidity_along_n_m": float(along),
        "flexural_rigidity_across_n_m": float(across),
    }


def _air_gap(gap: AirGap, limits: GuardLimits) -> dict[str, Any]:
    return {
        "depth_m": gap.depth,
        "closed": gap.closed,
        "inertia_kg_m3": {
            f"{frequency:g}_hz": gap.inertia(frequency).real
            for frequency in (limits.frequency_min, limits.frequency_max)
        },
        "stiffness_n_m3": gap.bulk_modulus(limits.frequency_max).real / gap.depth
        if gap.closed
        else 0.0,
    }


def _laminate(laminate: Laminate, limits: GuardLimits) -> dict[str, Any]:
    frequencies = limits.frequency_min, limits.frequency_max
    by_frequency = {f"{each:g}_hz": bending(laminate, each).rigidity for each in frequencies}
    return {
        "layers": [
            {
                "material": layer.material.name,
                "thickness_m": layer.thickness,
                "E_pa": layer.material.E,
                "rho_kg_m3": layer.material.rho,
                "nu": layer.material.nu,
                "loss_factor": layer.loss_factor,
                "by_frequency": [list(row) for row in layer.by_frequency],
            }
            for layer in laminate.layers
        ],
        "thickness_m": laminate.thickness,
        "bond": laminate.bond.value,
        "rigidity_perfectly_bonded_n_m": perfectly_bonded(laminate.layers).rigidity,
        "rigidity_freely_sliding_n_m": freely_sliding(laminate.layers).rigidity,
        **({"rigidity_by_frequency_n_m": by_frequency} if laminate.bond is Bond.FULL else {}),
    }


def _exciter(one: Exciter) -> dict[str, Any]:
    """An exciter by itself."""
    return {
        "name": one.name,
        "magnet": "held" if one.held else "free",
        "magnet_resonance_hz": one.magnet_frequency,
        "q": one.quality,
        "force_at_1_w_n": one.force_factor * math.sqrt(2 / one.resistance),
        "full_level_v": one.voltage * one.largest_gain,
        "full_level_force_n": one.largest_force,
        "excursion_max_m": one.excursion if math.isfinite(one.excursion) else None,
    }


def _types(rig: Rig) -> dict[str, dict[str, Any]]:
    """Types of a rig's exciters by name: what to know of each, and what no source gives of it.

    assumed: by key the lowest and the highest value that is likely, unless every exciter of the
    type states its own.
    """
    found: dict[str, dict[str, Any]] = {}
    for section in sections_of(rig).values():
        if section.type is not None:
            known = EXCITER_TYPES[section.type]
            entry = found.setdefault(section.type, {"note": known.note, "assumed": {}})
            for key, between in known.assumed.items():
                (quantity,) = quantities(ExciterSection.model_fields[key])
                if getattr(section, key) is None:
                    entry["assumed"][quantity.dimension.key(key)] = list(between)
    return found
