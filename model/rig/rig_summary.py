"""Summary of a rig, and warnings about its file.

The summary contains numbers of plate and exciters: materials, rigidity, bending wavelengths, types.
Warnings name unknown or neglected effects, and frequencies that exciters cannot follow. Warnings
that need solved plates or wires are in `controller.rig_file_check`.
"""

import cmath
import math
from collections.abc import Iterator
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

from model.config.fields import quantities
from model.rig.actuator_keys import STIFF_MOUNT, ExciterSection
from model.rig.rig import Rig
from model.rig.sections import PLAIN_KEYS, RigSection
from model.spectral.modes import KnownModes
from model.structure.attachments import (
    DEFAULT_POINTS,
    GRAVITY,
    Era,
    Source,
    least_points,
)
from model.structure.exciter import Exciter
from model.structure.material import EXCITER_TYPES
from model.structure.plate import (
    Bond,
    Laminate,
    Plate,
    bending,
    freely_sliding,
    perfectly_bonded,
    slide_frequency,
    wavenumber_of,
)
from model.structure.surface import WELL_KNOWN
from registry.limits import GuardLimits

_NEARLY = 1.001
_LAG = 0.01  # (omega L / R)² above which results in time and frequency domain differ visibly
_ABOVE = 1.3  # times a magnet's resonance; above it, the resonance matters little
_LIGHT, _HIGH = 0.3, 100.0  # coil mass relative to the magnet's; Hz


def exciters_of(rig: Rig) -> list[Exciter]:
    """Return the exciters among the actuators."""
    return [era for era in rig.eras if isinstance(era, Exciter)]


def sections_of(rig: Rig) -> dict[str, ExciterSection]:
    """Return the keys of exciters by name, empty for a rig without keys."""
    keys: Any = rig.document.data["eras"] if rig.document else {}
    names = [one.name for one in exciters_of(rig) if one.name in keys]
    return {name: ExciterSection.model_validate(keys[name]) for name in names}


def exciter_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of resonances that can be misread, and of hazards to exciters."""
    sections = sections_of(rig)
    misread: dict[str, list[str]] = {}
    for name, section in sections.items():
        if said := _misread_resonance(section):
            misread.setdefault(said, []).append(name)
    yield from (f"resonance_is of {', '.join(names)}: {said}" for said, names in misread.items())
    for one in exciters_of(rig):
        yield from (f"eras.{one.name}.{each}" for each in _hazards(one, sections[one.name], rig))


def resonance_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning if a rig plays near the resonance of its magnets.

    Resonances with a suspicious value are skipped.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    sections = sections_of(rig)
    doubted = {name for name, section in sections.items() if _misread_resonance(section)}
    free = [one for one in exciters_of(rig) if not one.held and one.name not in doubted]
    near = {one.name: f for one in free if low < _ABOVE * (f := one.magnet_frequency)}
    if near:
        highest = max(near.values())
        start = math.ceil(_ABOVE * highest)
        advice = f"start at {start} Hz, or identify the rig" if start < high else "identify the rig"
        yield (
            f"limits.frequency: starts at {low:g} Hz, below {_ABOVE:g} times the resonance of the "
            f"magnets of {', '.join(near)} at up to {highest:.1f} Hz, where "
            f"the field depends on suspension and weight as much as on the plate; {advice}"
        )


def _misread_resonance(section: ExciterSection) -> str | None:
    """Return a warning for a `mounted` resonance that is too high to be one."""
    values = section.values
    f, coil, weight = values["resonance"], values["coil_mass"], values["weight"]
    if section.stiffness or values["resonance_is"] != "mounted":
        return None
    if f <= _HIGH or coil >= _LIGHT * weight:
        return None
    return (
        f"{f:g} Hz is high for a magnet of {1e3 * weight:.3g} g, and probably refers to the coil "
        f"of {1e3 * coil:.3g} g, as on most data sheets; with resonance_is: free the glued magnet "
        f"resonates at {f * math.sqrt(coil / weight):.0f} Hz"
    )


def _hazards(one: Exciter, section: ExciterSection, rig: Rig) -> Iterator[str]:
    """Yield hazards to an exciter, and effects that the model then misses, by key."""
    volts, limits = rig.limits.level * one.largest_gain * one.voltage, rig.limits
    heat = (volts / one.loop_resistance) ** 2 * one.resistance / 2
    by_gains = f"gains: of up to {one.largest_gain:.3g}"
    rated = section.of_type.get("power", section.values["power"])
    if heat > _NEARLY * rated:
        yield (
            f"{by_gains} put {heat:.3g} W into the coil at full level, which is rated for "
            f"{rated:.3g} W; lower power, or limits.level"
        )
    if section.clip is not None and volts > _NEARLY * section.clip:
        yield (
            f"{by_gains} ask for {volts:.3g} V at full level, and the amplifier clips at "
            f"{section.clip:.3g} V; lower power, or limits.level"
        )
    if not math.isfinite(one.excursion):
        yield "excursion: missing, so the motion of its magnet is unlimited; add it"
    sag = 0.0 if one.held else GRAVITY * one.magnet_mass / one.stiffness
    if sag > one.excursion:
        yield (
            f"resonance: of {one.magnet_frequency:.3g} Hz when glued, at which the magnet sags "
            f"{1e3 * sag:.2g} mm from its center under its weight, with an excursion of "
            f"{1e3 * one.excursion:.2g} mm; check resonance, resonance_is and weight, or hold it"
        )
    highest = limits.frequency_max
    lag = (2 * math.pi * highest * one.inductance / one.loop_resistance) ** 2
    if lag > _LAG:
        yield (
            f"inductance: (omega L / R)² is {lag:.2g} at {highest:g} Hz, so onsets, "
            "endings and envelopes are computed too strong or too weak; check it, or end "
            f"limits.frequency at {math.floor(highest * math.sqrt(_LAG / lag))} Hz"
        )


FURTHER = {
    each.name: PLAIN_KEYS[each.name]
    for each in fields(Plate)
    if each.name in PLAIN_KEYS and not each.metadata.get("has_own_row")
}
"""Dimensions of the plate keys that are grouped in a summary."""


def plate_summary(rig: Rig) -> dict[str, Any]:
    """Return the solved plate, the laminate that it represents, and its attachments.

    Keys include their units. A laminate has both bounds of its rigidity, for perfectly bonded and
    freely sliding layers, and, if its layers are bonded, the rigidity in free bending waves at both
    ends of the rig's frequencies. A surface is represented by the homogeneous plate with the same
    number of modes and the same mass.
    """
    plate, limits, gap, surface = rig.plate, rig.limits, rig.plate.air_gap, rig.plate.surface
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
        "air_gap": None
        if gap is None
        else {
            "depth_m": gap.depth,
            "closed": gap.closed,
            "inertia_kg_m3": {
                f"{frequency:g}_hz": gap.inertia(frequency).real
                for frequency in (limits.frequency_min, limits.frequency_max)
            },
            "stiffness_n_m3": gap.bulk_modulus(limits.frequency_max).real / gap.depth
            if gap.closed
            else 0.0,
        },
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
        "surface": surface
        and {
            "modes_file": surface.file,
            "modes": surface.count,
            "rigid_modes": surface.rigid,
            "highest_frequency_hz": surface.frequency,
            "normal": surface.normal,
            "rings": len(surface.outline),
        },
        "exciters": [
            {
                "name": one.name,
                "magnet": "held" if one.held else "free",
                "magnet_resonance_hz": one.magnet_frequency,
                "q": one.quality,
                "force_at_1_w_n": one.force_factor * math.sqrt(2 / one.resistance),
                "full_level_v": one.voltage * one.largest_gain,
                "full_level_force_n": one.largest_force,
                "excursion_max_m": one.excursion if math.isfinite(one.excursion) else None,
            }
            for one in exciters_of(rig)
        ],
        "exciter_types": _types(rig),
    }


def _grain(plate: Plate) -> dict[str, float] | None:
    """Return numbers of a board along and across the plate's length; None for an isotropic
    plate."""
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


def _types(rig: Rig) -> dict[str, dict[str, Any]]:
    """Return the types of a rig's exciters by name, with notes and values without a source.

    assumed: lowest and highest likely value by key, unless every exciter of the type states its
    own.
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


# Modes are within 3 % of the direct solution up to half the frequency at which layers slide on
# their own, and off by a similar factor near it (0.5 mm aluminium faces on 50 mm of E 0.1 to 10
# MPa).
_FAR_FROM_SLIDING = 2.0


_NEEDED = ("required", "oneOf", "dependentRequired", "minProperties")


def rig_schema() -> dict[str, Any]:
    """Return the JSON schema of a complete rig, and of a fitted one with changes to its base."""
    whole = RigSection.model_json_schema()
    fitted = _partial(whole)
    errors = {"type": "object", "description": "standard errors of values, by key"}
    fitted["properties"] |= {"base": {"type": "string"}, "base_fingerprint": {"type": "string"}}
    fitted["properties"]["standard_errors"] = errors
    definitions = {**whole.pop("$defs"), "fitted": {"$defs": fitted.pop("$defs")}}
    choice = {"if": {"required": ["base"]}, "then": fitted, "else": whole}
    return {"$defs": definitions, "type": "object", **choice}


def _partial(schema: Any) -> Any:
    """Return a JSON schema without required keys, in which null removes a key of the base."""
    if isinstance(schema, list):
        return [_partial(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    found = {key: _partial(each) for key, each in schema.items() if key not in _NEEDED}
    for key, each in found.get("properties", {}).items():
        found["properties"][key] = {"anyOf": [each, {"type": "null"}]}
    if "$ref" in found:
        found["$ref"] = found["$ref"].replace("#/$defs", "#/$defs/fitted/$defs", 1)
    return found


_THICK = 0.02  # m, for a single material
_NEARLY_ALL = (
    0.9  # of the frequency up to which modes are needed; the highest mode can be this far below it
)


def plate_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of a plate in the wrong unit, and of neglected effects of air and soft
    layers."""
    plate, low, high = rig.plate, rig.limits.frequency_min, rig.limits.frequency_max
    yield from rig.surface_notes
    if isinstance(rig.mesh, KnownModes) and rig.mesh.frequency < _NEARLY_ALL * WELL_KNOWN * high:
        yield (
            f"surface: {rig.mesh} leave fields uncertain at {high:g} Hz (limits.frequency); export "
            f"modes up to {WELL_KNOWN * high:g} Hz, {WELL_KNOWN:g} times as high"
        )
    if rig.laminate is None and plate.thickness > _THICK:
        yield (
            f"plate.thickness: {1e3 * plate.thickness:g} mm is too thick to be felt; "
            "check its unit, mm or cm"
        )
    if plate.air_gap is not None and (error := plate.air_gap.coupling_error(low)):
        off = "50 % or more: do not use the result" if error > 0.1 else f"{100 * error:g} %"
        yield (
            f"plate.air_gap: air friction in {1e3 * plate.air_gap.depth:g} mm couples the "
            f"modes at {low:g} Hz, which is neglected: the response can be off by {off}"
        )
    slide = math.inf if plate.laminate is None else slide_frequency(plate.laminate, high)
    if high >= slide / _FAR_FROM_SLIDING:
        yield (
            f"plate.layers: at {slide:.3g} Hz they slide back and forth on their own, and change "
            "their thickness little above, which is neglected: do not use results above "
            f"{slide / _FAR_FROM_SLIDING:.3g} Hz"
        )


def mount_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of stiff mounts that are points, and edges with too few points for many
    waves."""
    decade = math.log(10) / (2 * math.pi * rig.plate.shear_rigidity)
    mounts = {era.name: era.support for era in rig.eras} | dict(
        zip(rig.supports, rig.masses[len(rig.masses) - len(rig.supports) :], strict=True)
    )
    for name, mount in mounts.items():
        if mount.stiffness >= STIFF_MOUNT and not mount.foot:
            yield (
                f"eras.{name}.foot: the dent under a point of {mount.stiffness:g} N/m has no "
                f"limit, a tenfold smaller one adds at least {100 * decade * mount.stiffness:.1f} "
                "% of the mount's own compliance; give its radius, and see `era plate convergence`"
            )
    high = rig.limits.frequency_max
    needed = least_points(rig.plate, high)
    for kind in ("masses", "supports"):
        for name, keys in _attached(rig, kind).items():
            if "along" in keys and (count := keys.get("points", DEFAULT_POINTS)) < needed:
                yield (
                    f"{kind}.{name}.points: {count} on each edge are few at {high:g} Hz; give "
                    f"{needed}"
                )


def summary_line(rig: Rig, *, verdict: str = "good") -> str:
    """Return one line about the plate and its ERAs; verdict: its first words."""
    plate, laminate = rig.plate, rig.laminate
    thickness = plate.thickness if laminate is None else laminate.thickness
    sizes = " x ".join(f"{1e3 * size:g}" for size in (plate.length, plate.width, thickness))
    made_of = plate.material.name
    if laminate is not None and len(laminate.layers) > 1:
        made_of = f"laminate ({', '.join(layer.material.name for layer in laminate.layers)})"
    whole, solved = f"{sizes} mm of {made_of}", f"mesh {rig.mesh}"
    if plate.surface is not None:
        whole = f"surface of {1e3 * plate.length:g} x {1e3 * plate.width:g} mm"
        solved = f"{rig.mesh} of {Path(plate.surface.file).name}, {plate.mass:.3g} kg"
    parts = [
        whole,
        solved,
        f"ERAs {', '.join(era.name for era in rig.eras)}",
    ]
    gap = plate.air_gap
    if gap is not None:
        edges = "sealed" if gap.closed else "open"
        parts.insert(1, f"{1e3 * gap.depth:g} mm of air behind it, {edges} at the edges")
    if feet := [*_attached(rig, "supports"), *rig.supports]:
        parts.append(f"supported passively by {', '.join(feet)}")
    if carried := sum(mass.mass for mass in rig.masses):
        parts.append(f"carries {1e3 * carried:g} g")
    return f"{verdict}: {', '.join(parts)}"


def _attached(rig: Rig, kind: str) -> dict[str, Any]:
    """Return masses or supports of the rig file."""
    keys: Any = {} if rig.document is None else rig.document.data.get(kind)
    return dict(keys or {})


_MAX_ANGLE = math.radians(20.5)  # between two rows


def gain_notes(rig: Rig) -> list[str]:
    """Return warnings of missing gains behind an output, and of gains with rows too far apart.

    Other actuators than ERAs need no gains behind an output.
    """
    behind = [era for era in rig.eras if rig.wiring[era.name].amplifier in rig.outputs]
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    names = [era.name for era in behind if isinstance(era, Era) and not era.gains]
    notes = []
    if names:
        notes.append(
            f"gains of {', '.join(names)}: missing behind an output, so their motion is "
            "assumed to be the stroke at full level at every frequency; measure the plate and "
            "calibrate the rig"
        )
    return [*notes, *(text for era in behind for text in _notes(era, low, high))]


def _notes(era: Source, low: float, high: float) -> list[str]:
    played = [each for each in pairwise(era.gains) if each[0][0] < high and each[1][0] > low]
    turns = {
        abs(cmath.phase(cmath.rect(1, other[2] - one[2]))): (one[0], other[0])
        for one, other in played
    }
    angle = max(turns, default=0.0)
    if angle <= _MAX_ANGLE:
        return []
    first, last = turns[angle]
    return [
        f"eras.{era.name}.gains: phases differ by {math.degrees(angle):.0f} degrees between "
        f"{first:g} and {last:g} Hz, at most 20 are interpolated well; measure between them"
    ]
