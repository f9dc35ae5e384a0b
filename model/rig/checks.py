"""Checks of a rig across its sections."""

import math
from typing import Any

from model.config.document import KeyPath, key_name
from model.config.sections import Validation, section_by_kind
from model.errors import InputError
from model.rig.actuator_section import ActuatorSection
from model.rig.actuators import KINDS, kind_of
from model.rig.era_section import stiff_mount_problems
from model.rig.meshes import mesh_of
from model.rig.parts import laminate_of, plate_of
from model.rig.rig import SAME_POINT
from model.rig.sections import (
    ISOTROPIC,
    ORTHOTROPIC,
    LimitsSection,
    MassSection,
    PlateSection,
    RigSection,
    SupportSection,
)
from model.spectral.mesh import SpectralMesh
from model.structure.plate import Plate
from registry.suggestions import did_you_mean


def check_across(validation: Validation[RigSection], *, mesh_given: bool) -> None:
    """Add problems between sections that are valid by themselves."""
    limits = validation.field(("limits", "frequency"), LimitsSection)
    high = (limits or LimitsSection().frequency)[1]
    plate = _check_plate(validation, frequency_max=high)
    if plate is not None and not mesh_given:
        _check_mesh(validation, plate, frequency_max=high)
    names = tuple(validation.mapping(("eras",)))
    for name in names:
        _check_era(validation, name)
    _check_places(validation, names, plate)
    _check_wiring(validation, names)
    for name in validation.mapping(("masses",)):
        _check_on_plate(validation, ("masses", name), MassSection, plate, what="mass")
        _check_point_or_edges(validation, ("masses", name), "mass", "mass_per_length")
    for name in validation.mapping(("supports",)):
        _check_support(validation, name, plate)


def _check_support(validation: Validation[RigSection], name: str, plate: Plate | None) -> None:
    """Check what keys of a support require of each other."""
    path = ("supports", name)
    _check_on_plate(validation, path, SupportSection, plate, what="support")
    given = _given(validation, path)
    stiffness = None if "kind" in given and "along" not in given else "stiffness"
    _check_point_or_edges(validation, path, stiffness, "stiffness_per_length")
    if {"along", "kind"} <= given:
        validation.add((*path, "kind"), "is of a foot; remove it, and give stiffness_per_length")
    stiffness = validation.field((*path, "stiffness"), SupportSection)
    for key, problem in stiff_mount_problems(_given(validation, path), stiffness):
        validation.add((*path, key), problem)


def _check_point_or_edges(
    validation: Validation[RigSection], path: tuple[str, ...], of_point: str | None, of_edges: str
) -> None:
    """Check that what is attached is at a point, or along the edges, each with its own key."""
    given = _given(validation, path)
    if not validation.mapping(path):
        return
    if "along" not in given and "at" not in given:
        validation.add((*path, "at"), "missing; add it, or along: edges")
        return
    edges = "along" in given
    needed, others = (of_edges, {"at", of_point, "foot"}) if edges else (of_point, {of_edges})
    if needed is not None and needed not in given:
        validation.add((*path, needed), "missing; add it")
    for key in sorted(each for each in others if each in given):
        word = "is not of what is along: edges" if edges else "is of what is along: edges"
        validation.add((*path, key), f"{word}; remove it")


def _check_era(validation: Validation[RigSection], name: str) -> None:
    """Check what keys of an ERA require of each other."""
    section, path = _section(validation, name), ("eras", name)

    def read(key: str) -> Any:
        return validation.field((*path, key), section)

    given = _given(validation, path)
    for key, problem in kind_of(section).problems(given, read) if given else ():
        validation.add((*path, key), problem)


def _section(validation: Validation[RigSection], name: str) -> type[ActuatorSection]:
    """The section of an ERA, or of another kind of actuator."""
    sections = [kind.section for kind in KINDS.values()]
    return section_by_kind(sections, validation.mapping(("eras", name)))


def _check_plate(validation: Validation[RigSection], *, frequency_max: float) -> Plate | None:
    """The plate if its section is valid: thickness and material, or layers."""
    given = _given(validation, ("plate",))
    if not given:
        return None
    if "layers" in given:
        for key in sorted({"thickness", "material"} & given):
            validation.add(("plate", key), "must not be given with layers; remove one of the two")
        if "grain" in given:
            validation.add(("plate", "grain"), "is for a plate without layers; remove it")
    else:
        for key in ("thickness", "material"):
            if key not in given:
                validation.add(("plate", key), "missing; add it, or layers for a laminate")
        if "bond" in given:
            validation.add(("plate", "bond"), "is for layers only; remove it")
    paths = [("plate", "material"), *_layer_materials(validation)]
    good = [_check_material(validation, path) for path in paths]
    if not all(good):
        return None
    section = validation.part(("plate",), PlateSection)
    if section is None or (section.layers is None and not {"thickness", "material"} <= given):
        return None
    try:
        laminate = laminate_of(section)
        plate = plate_of(section, frequency_max=frequency_max)
    except InputError as error:
        key = "material" if "layers" not in given else "bond" if "bond" in given else "layers"
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


def _layer_materials(validation: Validation[RigSection]) -> list[KeyPath]:
    """Where the materials of layers stand."""
    layers = validation.mapping(("plate",)).get("layers")
    count = len(layers) if isinstance(layers, list) else 0
    return [("plate", "layers", number, "material") for number in range(count)]


def _check_material(validation: Validation[RigSection], path: KeyPath) -> bool:
    """Check that a material by numbers has those of one of both kinds, and only these."""
    given = _given(validation, path)
    if not given:
        return True
    if "by_frequency" in given and given & ORTHOTROPIC:
        validation.add((*path, "by_frequency"), "is of an isotropic material only; remove it")
    kind, other = ISOTROPIC, ORTHOTROPIC
    if len(given & ORTHOTROPIC) > (1 if given & ISOTROPIC else 0):
        kind, other = other, kind
    for key in sorted(kind - given):
        others = "E1, E2, G12, G13, G23, nu12" if kind is ISOTROPIC else "E and nu"
        validation.add((*path, key), f"missing; add it, or {others} instead")
    for key in sorted(other & given):
        validation.add((*path, key), f"must not be given with {min(kind & given)}; remove it")
    return not (kind - given or other & given)


def _check_mesh(validation: Validation[RigSection], plate: Plate, *, frequency_max: float) -> None:
    text = validation.mapping(()).get("mesh", "auto")
    if not isinstance(text, str):
        return
    try:
        mesh = mesh_of(text, plate, frequency_max=frequency_max)
    except InputError as error:
        validation.add(("mesh",), str(error))
        return
    if plate.is_layered and not isinstance(mesh, SpectralMesh):
        what = "layers" if plate.laminate is not None else "an air gap"
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


def _check_places(
    validation: Validation[RigSection], names: tuple[str, ...], plate: Plate | None
) -> None:
    placed: dict[str, tuple[float, float]] = {}
    for name in names:
        place = _check_on_plate(
            validation, ("eras", name), _section(validation, name), plate, what="ERA"
        )
        if place is None:
            continue
        for other, taken in placed.items():
            if math.dist(taken, place) < SAME_POINT:
                validation.add(
                    ("eras", name, "at"),
                    f"must be unique, got the place of ERA {other}; move one",
                )
        placed[name] = place


def _check_on_plate(
    validation: Validation[RigSection],
    path: tuple[str, ...],
    section: type[ActuatorSection | MassSection | SupportSection],
    plate: Plate | None,
    *,
    what: str,
) -> tuple[float, float] | None:
    """Check the place of an ERA or a mass; the place, None if it is invalid by itself."""
    place: tuple[float, float] | None = validation.field((*path, "at"), section)
    if place is None or plate is None:
        return place
    x, y = place
    if not (
        -SAME_POINT <= x <= plate.length + SAME_POINT
        and -SAME_POINT <= y <= plate.width + SAME_POINT
    ):
        validation.add(
            (*path, "at"),
            f"must be on the plate, from (0, 0) to ({plate.length:g}, {plate.width:g}) m, got "
            f"({x:g}, {y:g}) m; move the {what}",
        )
    return place


def _check_wiring(validation: Validation[RigSection], names: tuple[str, ...]) -> None:
    amplifiers = validation.mapping(("amplifiers",))
    wired: dict[tuple[str, int], str] = {}
    if names and not any("amplifier" in _given(validation, ("eras", name)) for name in names):
        validation.add(("eras",), "must have at least one ERA with an amplifier; add its amplifier")
    for name in names:
        section = _section(validation, name)
        amplifier, channel = (
            validation.field(("eras", name, key), section) for key in ("amplifier", "channel")
        )
        if amplifier is not None and amplifier not in amplifiers:
            known = ", ".join(key_name((key,)) for key in amplifiers) or "none"
            validation.add(
                ("eras", name, "amplifier"),
                f"unknown amplifier {amplifier}; {did_you_mean(amplifier, amplifiers)}"
                f"known are {known}",
            )
        if amplifier is None or channel is None:
            continue
        other = wired.setdefault((amplifier, channel), name)
        if other != name:
            validation.add(
                ("eras", name, "channel"),
                f"must be unique, got {channel} of amplifier {amplifier} as ERA {other}; give each "
                "ERA its own channel",
            )


def _given(validation: Validation[RigSection], path: KeyPath) -> set[str]:
    """Keys of a section that are not empty."""
    return {key for key, value in validation.mapping(path).items() if value is not None}
