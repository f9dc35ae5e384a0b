"""Summary of a rig: materials, rigidity, bending wavelengths, attachments and exciters.

`summary_line` is one line of text, `plate_summary` the JSON object of `era plate show`. Warnings
about a rig file are in `model.rig.rig_warnings`.
"""

import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from model.config.fields import quantities
from model.rig.actuator_keys import ExciterSection
from model.rig.plate_sections import PLAIN_KEYS
from model.rig.rig import Rig
from model.spectral.surrounding_air import heave_mass
from model.structure.attachments import PointLoad
from model.structure.exciter import EXCITER_TYPES, Exciter
from model.structure.laminate_bending import (
    bending,
    freely_sliding,
    perfectly_bonded,
    wavenumber_of,
)
from model.structure.plate import AirGap, Bond, Laminate, LaminateLayer, Plate, SurroundingAir
from model.structure.surface import Surface
from registry.limits import GuardLimits

_AIR_IN_WORDS = {
    SurroundingAir.BOTH: "air on both sides",
    SurroundingAir.FRONT: "air in front of it",
}

FURTHER = {
    field.name: PLAIN_KEYS[field.name]
    for field in fields(Plate)
    if field.name in PLAIN_KEYS and not field.metadata.get("has_own_row")
}
"""Dimensions of the plate keys that are grouped in a summary."""


def exciters_of(rig: Rig) -> list[Exciter]:
    """Return the exciters among the actuators."""
    return [era for era in rig.eras if isinstance(era, Exciter)]


def sections_of(rig: Rig) -> dict[str, ExciterSection]:
    """Return the keys of exciters by name, empty for a rig without keys."""
    keys: Any = rig.document.data["eras"] if rig.document else {}
    sections = {}
    for exciter in exciters_of(rig):
        if exciter.name in keys:
            sections[exciter.name] = ExciterSection.model_validate(keys[exciter.name])
    return sections


def attachment_keys(rig: Rig, kind: str) -> dict[str, Any]:
    """Return the keys of `masses` or `supports` in the rig file, by name."""
    keys: Any = rig.document.data.get(kind) if rig.document else None
    return dict(keys or {})


def summary_line(rig: Rig, *, verdict: str = "good") -> str:
    """Return one line about the plate and its ERAs; verdict: its first words."""
    plate = rig.plate
    parts = [plate_in_words(rig)]
    gap = plate.air_gap
    if plate.air is not None:
        parts.append(_AIR_IN_WORDS[plate.air])
    if gap is not None:
        edges = "sealed" if gap.closed else "open"
        parts.append(f"{1e3 * gap.depth:g} mm of air behind it, {edges} at the edges")
    if plate.surface is None:
        parts.append(f"mesh {rig.mesh}")
    else:
        parts.append(f"{rig.mesh} of {Path(plate.surface.file).name}, {plate.mass:.3g} kg")
    parts.append(f"ERAs {', '.join(era.name for era in rig.eras)}")
    passive_supports = [*attachment_keys(rig, "supports"), *rig.supports]
    if passive_supports:
        parts.append(f"supported passively by {', '.join(passive_supports)}")
    carried_mass = sum(load.mass for load in rig.masses)
    if carried_mass:
        parts.append(f"carries {1e3 * carried_mass:g} g")
    return f"{verdict}: {', '.join(parts)}"


def plate_in_words(rig: Rig) -> str:
    """Return the size and the material of a plate, or the size of a surface."""
    plate, laminate = rig.plate, rig.laminate
    area = f"{1e3 * plate.length:g} x {1e3 * plate.width:g}"
    if plate.surface is not None:
        return f"surface of {area} mm"
    if laminate is None:
        return f"{area} x {1e3 * plate.thickness:g} mm of {plate.material.name}"
    material = plate.material.name
    if len(laminate.layers) > 1:
        material = f"laminate ({', '.join(layer.material.name for layer in laminate.layers)})"
    return f"{area} x {1e3 * laminate.thickness:g} mm of {material}"


def plate_summary(rig: Rig) -> dict[str, Any]:
    """Return the solved plate, the laminate that it represents, and its attachments.

    Keys include their units. A laminate has both bounds of its rigidity, for perfectly bonded and
    freely sliding layers, and, if its layers are bonded, the rigidity in free bending waves at both
    ends of the rig's frequencies. A surface is represented by the homogeneous plate with the same
    number of modes and the same mass.
    """
    plate, limits, laminate = rig.plate, rig.limits, rig.laminate

    def bending_wavelength(frequency: float) -> float:
        if plate.laminate is None:
            return plate.bending_wavelength(frequency)
        return 2 * math.pi / wavenumber_of(plate.laminate, frequency).real

    return {
        "length_m": plate.length,
        "width_m": plate.width,
        "thickness_m": plate.thickness,
        "material": plate.material.name,
        "E_pa": plate.material.E,
        "rho_kg_m3": plate.material.rho,
        "nu": plate.material.nu,
        "orthotropic": _board_summary(plate),
        "loss_factor": plate.loss_factor,
        "further": {unit.key(name): getattr(plate, name) for name, unit in FURTHER.items()},
        "mass_kg": plate.mass,
        "surface_density_kg_m2": plate.surface_density,
        "flexural_rigidity_n_m": plate.flexural_rigidity,
        "bending_wavelength_m": _at_both_limits(limits, bending_wavelength),
        "air": "none" if plate.air is None else plate.air.value,
        "air_mass_kg": heave_mass(plate),
        "air_gap": None if plate.air_gap is None else _air_gap_summary(plate.air_gap, limits),
        "point_masses": [_mass_summary(load) for load in rig.masses if load.mass],
        "supports": [_support_summary(load) for load in rig.masses if load.stiffness],
        "laminate": None if laminate is None else _laminate_summary(laminate, limits),
        "surface": None if plate.surface is None else _surface_summary(plate.surface),
        "exciters": [_exciter_summary(exciter) for exciter in exciters_of(rig)],
        "exciter_types": _exciter_types(rig),
    }


def _at_both_limits(limits: GuardLimits, value: Callable[[float], float]) -> dict[str, float]:
    """Return a value at the lowest and at the highest frequency of a rig, by frequency."""
    frequencies = (limits.frequency_min, limits.frequency_max)
    return {f"{frequency:g}_hz": value(frequency) for frequency in frequencies}


def _board_summary(plate: Plate) -> dict[str, float] | None:
    """Return numbers of a board along and across the plate's length; None for an isotropic
    plate."""
    material = plate.material
    if material.orthotropy is None:
        return None
    summary = {f"{key}_pa": modulus for key, modulus in material.moduli.items()}
    summary["nu12"] = material.nu
    summary["flexural_rigidity_along_n_m"] = float(plate.rigidity_towards(1.0))
    summary["flexural_rigidity_across_n_m"] = float(plate.rigidity_towards(0.0))
    return summary


def _air_gap_summary(gap: AirGap, limits: GuardLimits) -> dict[str, Any]:
    def inertia(frequency: float) -> float:
        return gap.inertia(frequency).real

    stiffness = 0.0
    if gap.closed:
        stiffness = gap.bulk_modulus(limits.frequency_max).real / gap.depth
    return {
        "depth_m": gap.depth,
        "closed": gap.closed,
        "inertia_kg_m3": _at_both_limits(limits, inertia),
        "stiffness_n_m3": stiffness,
    }


def _mass_summary(load: PointLoad) -> dict[str, Any]:
    return {"at_m": [load.x, load.y], "mass_kg": load.mass}


def _support_summary(load: PointLoad) -> dict[str, Any]:
    return {
        "at_m": [load.x, load.y],
        "stiffness_n_m": load.stiffness,
        "damping_n_s_m": load.damping,
        "loss_factor": load.loss_factor,
    }


def _laminate_summary(laminate: Laminate, limits: GuardLimits) -> dict[str, Any]:
    def rigidity(frequency: float) -> float:
        return bending(laminate, frequency).rigidity

    summary = {
        "layers": [_layer_summary(layer) for layer in laminate.layers],
        "thickness_m": laminate.thickness,
        "bond": laminate.bond.value,
        "rigidity_perfectly_bonded_n_m": perfectly_bonded(laminate.layers).rigidity,
        "rigidity_freely_sliding_n_m": freely_sliding(laminate.layers).rigidity,
    }
    if laminate.bond is Bond.FULL:
        summary["rigidity_by_frequency_n_m"] = _at_both_limits(limits, rigidity)
    return summary


def _layer_summary(layer: LaminateLayer) -> dict[str, Any]:
    material = layer.material
    return {
        "material": material.name,
        "thickness_m": layer.thickness,
        "E_pa": material.E,
        "rho_kg_m3": material.rho,
        "nu": material.nu,
        "loss_factor": layer.loss_factor,
        "by_frequency": [list(row) for row in layer.by_frequency],
    }


def _surface_summary(surface: Surface) -> dict[str, Any]:
    return {
        "modes_file": surface.file,
        "modes": surface.count,
        "rigid_modes": surface.rigid,
        "highest_frequency_hz": surface.frequency,
        "normal": surface.normal,
        "rings": len(surface.outline),
    }


def _exciter_summary(exciter: Exciter) -> dict[str, Any]:
    current_at_1_w = math.sqrt(2 / exciter.resistance)
    return {
        "name": exciter.name,
        "magnet": "held" if exciter.held else "free",
        "magnet_resonance_hz": exciter.magnet_frequency,
        "q": exciter.quality,
        "force_at_1_w_n": exciter.force_factor * current_at_1_w,
        "full_level_v": exciter.voltage * exciter.largest_gain,
        "full_level_force_n": exciter.largest_force,
        "excursion_max_m": exciter.excursion if math.isfinite(exciter.excursion) else None,
    }


def _exciter_types(rig: Rig) -> dict[str, dict[str, Any]]:
    """Return the types of a rig's exciters by name, with notes and values without a source.

    assumed: lowest and highest likely value by key, unless every exciter of the type states its
    own.
    """
    types: dict[str, dict[str, Any]] = {}
    for section in sections_of(rig).values():
        if section.type is None:
            continue
        exciter_type = EXCITER_TYPES[section.type]
        entry = types.setdefault(section.type, {"note": exciter_type.note, "assumed": {}})
        for key, typical_range in exciter_type.assumed.items():
            if getattr(section, key) is None:
                (quantity,) = quantities(ExciterSection.model_fields[key])
                entry["assumed"][quantity.dimension.key(key)] = list(typical_range)
    return types
