"""Conflicts between sections of a rig file that are valid on their own.

Every section checks its own part (`model.rig.sections`). The checks here compare sections, such as
positions with the plate, or channels with each other. They add all problems to a `Validation`.
"""

import math
from collections.abc import Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from model.arrays import Point
from model.config.document import Document, KeyPath, key_name
from model.config.fields import Section, Validation, section_by_kind
from model.errors import InputError
from model.rig.actuator_keys import ACTUATOR_KINDS, stiff_mount_problems
from model.rig.plate_sections import ISOTROPIC, ORTHOTROPIC, PlateSection, SurfaceSection
from model.rig.rig import SAME_POINT
from model.rig.rig_mesh import mesh_of
from model.rig.sections import (
    LimitsSection,
    MassSection,
    RigSection,
    SupportSection,
    UncertaintySection,
)
from model.spectral.plate_mesh import SpectralMesh
from model.structure.plate import Plate
from model.structure.surface import LEAST_KNOWN
from registry.plugins import did_you_mean

RigValidation: TypeAlias = Validation[RigSection]

ActuatorKeys: TypeAlias = Mapping[str, Mapping[str, Any]]
"""Keys of actuators by name; see `_valid_keys`."""


class Alternative(NamedTuple):
    """One of two ways to describe a property: its required keys, and optional ones."""

    required: Set[str]
    optional: Set[str] = frozenset()


_SINGLE_LAYER = Alternative({"thickness", "material"}, {"grain"})

_LAYERED = Alternative({"layers"}, {"bond"})

_ISOTROPIC = Alternative(ISOTROPIC, {"by_frequency"})

_ORTHOTROPIC = Alternative(ORTHOTROPIC)


def check_across(validation: RigValidation, *, mesh_given: bool) -> None:
    """Add conflicts between sections that are valid on their own."""
    limits = validation.field(("limits", "frequency"), LimitsSection)
    frequency_max = (limits or LimitsSection().frequency)[1]
    plate = _check_plate(validation, frequency_max=frequency_max)
    if plate is not None and plate.surface is None:
        if not mesh_given:
            _check_mesh(validation, plate, frequency_max=frequency_max)
        path = "uncertainty", "mode_amplitude"
        if validation.field(path, UncertaintySection):
            validation.add(path, "must be given only with surface; remove it, or give surface")
    _check_actuators(validation, plate)
    for name in validation.mapping(("masses",)):
        _check_attached(validation, ("masses", name), MassSection, plate)
    for name in validation.mapping(("supports",)):
        keys = _check_attached(validation, ("supports", name), SupportSection, plate)
        for key, problem in stiff_mount_problems(keys):
            validation.add(("supports", name, key), problem)


def _check_actuators(validation: RigValidation, plate: Plate | None) -> None:
    """Check the keys, positions and channels of all actuators."""
    actuators = {}
    for name, data in validation.mapping(("eras",)).items():
        section = section_by_kind([*ACTUATOR_KINDS.values()], data)
        keys = _valid_keys(validation, ("eras", name), section)
        actuators[name] = keys
        if keys:
            for key, problem in section.problems(keys):
                validation.add(("eras", name, key), problem)
    _check_positions(validation, actuators, plate)
    _check_wiring(validation, actuators)


def _check_attached(
    validation: RigValidation,
    path: tuple[str, str],
    section: type[MassSection | SupportSection],
    plate: Plate | None,
) -> dict[str, Any]:
    """Check that a mass or support is on the plate, at a point or along the edges; return its
    keys."""
    keys = _valid_keys(validation, path, section)
    _check_on_plate(validation, path, keys.get("at"), plate)
    quantity = "mass" if section is MassSection else "stiffness"
    required = {"at"} if "kind" in keys else {"at", quantity}
    at_point = Alternative(required, {"foot", "kind"})
    along_edges = Alternative({"along", f"{quantity}_per_length"})
    if "along" in keys:
        _check_alternative(validation, path, along_edges, at_point)
    elif keys:
        _check_alternative(validation, path, at_point, along_edges)
    return keys


def _check_alternative(
    validation: RigValidation, path: KeyPath, chosen: Alternative, other: Alternative
) -> bool:
    """Check that a section has all keys of the chosen alternative and none of the other."""
    keys = _valid_keys(validation, path).keys()
    missing = chosen.required - keys
    excess = keys & (other.required | other.optional)
    for key in sorted(missing):
        instead = ", ".join(sorted(other.required))
        validation.add((*path, key), f"missing; add it, or {instead} instead")
    for key in sorted(excess):
        present = min(chosen.required & keys, default="the others")
        validation.add((*path, key), f"must not be given with {present}; remove it")
    return not (missing or excess)


def _check_plate(validation: RigValidation, *, frequency_max: float) -> Plate | None:
    """Return the plate if its section is valid: thickness and material, or layers."""
    keys = _valid_keys(validation, ("plate",))
    sections = validation.mapping(())
    if "surface" in sections:
        return _check_surface(validation, frequency_max=frequency_max)
    if "plate" not in sections:
        validation.add(("plate",), "missing; add it, or surface instead")
    if not keys:
        return None
    is_layered = "layers" in keys
    chosen, other = (_LAYERED, _SINGLE_LAYER) if is_layered else (_SINGLE_LAYER, _LAYERED)
    _check_alternative(validation, ("plate",), chosen, other)
    has_good_materials = _check_materials(validation)
    section = validation.part(("plate",), PlateSection)
    if section is None or not has_good_materials or not chosen.required <= keys.keys():
        return None
    if section.air == "both sides" and section.air_gap is not None:
        validation.add(
            ("plate", "air"),
            "must be front or none with air_gap, which is the air behind it, got both sides",
        )
        return None
    try:
        laminate = section.laminate
        plate = section.build(frequency_max=frequency_max)
    except InputError as error:
        key = "material"
        if is_layered:
            key = "bond" if "bond" in keys else "layers"
        validation.add(("plate", key), str(error))
        return None
    thickness = plate.thickness if laminate is None else laminate.thickness
    if thickness > min(plate.length, plate.width):
        validation.add(
            ("plate", "thickness" if laminate is None else "layers"),
            f"must be less than the plate's sides, got {thickness:g} m; if in mm, write "
            f"{thickness:g} mm",
        )
    return plate


def _check_materials(validation: RigValidation) -> bool:
    """Check that each material of a plate that is given by numbers is isotropic or has a grain."""
    layers = validation.mapping(("plate",)).get("layers")
    count = len(layers) if isinstance(layers, list) else 0
    paths: list[KeyPath] = [("plate", "material")]
    paths += [("plate", "layers", number, "material") for number in range(count)]
    is_good = True
    for path in paths:
        keys = _valid_keys(validation, path).keys()
        has_grain = len(keys & ORTHOTROPIC) > (1 if keys & ISOTROPIC else 0)
        chosen, other = (_ORTHOTROPIC, _ISOTROPIC) if has_grain else (_ISOTROPIC, _ORTHOTROPIC)
        if keys and not _check_alternative(validation, path, chosen, other):
            is_good = False
    return is_good


def modes_file(section: SurfaceSection, document: Document) -> Path:
    """Return the file of a surface's modes, relative to the rig file or the target of its link."""
    target = str(Path(document.source).resolve())
    return replace(document, source=target).beside(section.modes)


def _check_surface(validation: RigValidation, *, frequency_max: float) -> Plate | None:
    """Return the plate of a surface if its section is valid and has enough modes."""
    for key in validation.mapping(()).keys() & {"plate", "mesh"}:
        validation.add((key,), "must not be given with surface; remove it")
    section: SurfaceSection | None = validation.field(("surface",), RigSection)
    if section is None:
        return None
    try:
        plate = section.build(modes_file(section, validation.document))
    except InputError as error:
        validation.add(("surface",), str(error))
        return None
    modes = mesh_of("auto", plate, frequency_max=frequency_max)
    if frequency_max > modes.highest_frequency(plate):
        validation.add(
            ("surface",),
            f"modes must be known up to {LEAST_KNOWN:g} times the {frequency_max:g} Hz of "
            f"limits.frequency, got {modes}; export more, or lower the limit",
        )
        return None
    return plate


def _check_mesh(validation: RigValidation, plate: Plate, *, frequency_max: float) -> None:
    text = validation.field(("mesh",), RigSection)
    try:
        mesh = mesh_of(text or "auto", plate, frequency_max=frequency_max)
    except InputError as error:
        validation.add(("mesh",), str(error))
        return
    if plate.needs_polynomials and not isinstance(mesh, SpectralMesh):
        what = "layers" if plate.laminate is not None else "air"
        validation.add(
            ("mesh",),
            f"must be of polynomials for a plate with {what}, got {mesh}; use auto, or degrees "
            "such as 12x9 Legendre",
        )
        return
    if frequency_max > mesh.highest_frequency(plate):
        validation.add(
            ("mesh",),
            f"{mesh} is too coarse for bending waves at {frequency_max:g} Hz (limits.frequency): "
            f"at least {mesh.resolving(plate, frequency_max)} is needed; auto chooses an accurate "
            "mesh",
        )


def _check_positions(
    validation: RigValidation, actuators: ActuatorKeys, plate: Plate | None
) -> None:
    """Check that actuators are on the plate, each at a position of its own."""
    positions: dict[str, Point] = {}
    for name, keys in actuators.items():
        position = keys.get("at")
        _check_on_plate(validation, ("eras", name), position, plate)
        if position is None:
            continue
        for earlier_name, earlier in positions.items():
            if math.dist(earlier, position) < SAME_POINT:
                validation.add(
                    ("eras", name, "at"),
                    f"must be unique, got the place of ERA {earlier_name}; move one",
                )
        positions[name] = position


def _check_on_plate(
    validation: RigValidation, path: tuple[str, str], position: Point | None, plate: Plate | None
) -> None:
    """Check that an attachment is on the plate, if both positions and plate are valid."""
    if position is None or plate is None:
        return
    x, y = position
    length, width = plate.length, plate.width
    margin = SAME_POINT
    if not (-margin <= x <= length + margin and -margin <= y <= width + margin):
        validation.add(
            (*path, "at"),
            f"must be on the plate, from (0, 0) to ({length:g}, {width:g}) m, got ({x:g}, {y:g}) "
            "m; move it",
        )
    elif not plate.contains(min(max(x, 0.0), length), min(max(y, 0.0), width)):
        validation.add((*path, "at"), f"must be within the outline, got ({x:g}, {y:g}) m; move it")


def _check_wiring(validation: RigValidation, actuators: ActuatorKeys) -> None:
    """Check that amplifiers exist, and that no two actuators have the same channel."""
    amplifiers = validation.mapping(("amplifiers",))
    owners: dict[tuple[str, int], str] = {}
    if actuators and not any("amplifier" in keys for keys in actuators.values()):
        validation.add(("eras",), "must have at least one ERA with an amplifier; add its amplifier")
    for name, keys in actuators.items():
        amplifier, channel = keys.get("amplifier"), keys.get("channel")
        if amplifier is not None and amplifier not in amplifiers:
            names = ", ".join(key_name((key,)) for key in amplifiers) or "none"
            validation.add(
                ("eras", name, "amplifier"),
                f"unknown amplifier {amplifier}; {did_you_mean(amplifier, amplifiers)}"
                f"known: {names}",
            )
        if amplifier is None or channel is None:
            continue
        owner = owners.setdefault((amplifier, channel), name)
        if owner != name:
            validation.add(
                ("eras", name, "channel"),
                f"must be unique, got {channel} of amplifier {amplifier} as ERA {owner}; give each "
                "ERA its own channel",
            )


def _valid_keys(
    validation: RigValidation, path: KeyPath, section: type[Section] = Section
) -> dict[str, Any]:
    """Return the non-empty keys of a section: valid ones with their values, others None."""
    keys = {}
    for key, value in validation.mapping(path).items():
        if value is not None:
            keys[key] = validation.field((*path, key), section)
    return keys
