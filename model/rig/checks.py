"""Checks of a rig across its sections."""

import math
from collections.abc import Mapping, Set
from typing import Any, NamedTuple

from model.config.document import KeyPath, key_name
from model.config.fields import Section, Validation, section_by_kind
from model.errors import InputError
from model.rig.actuators import KINDS
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
from registry.plugins import did_you_mean


class Way(NamedTuple):
    """One of two ways to state something: keys that it needs, and further ones of it alone."""

    needed: Set[str]
    further: Set[str] = frozenset()


_WHOLE, _LAYERED = Way({"thickness", "material"}, {"grain"}), Way({"layers"}, {"bond"})
_ISOTROPIC, _ORTHOTROPIC = Way(ISOTROPIC, {"by_frequency"}), Way(ORTHOTROPIC)


def check_across(validation: Validation[RigSection], *, mesh_given: bool) -> None:
    """Add problems between sections that are valid by themselves."""
    limits = validation.field(("limits", "frequency"), LimitsSection)
    high = (limits or LimitsSection().frequency)[1]
    plate = _check_plate(validation, frequency_max=high)
    if plate is not None and not mesh_given:
        _check_mesh(validation, plate, frequency_max=high)
    eras = {}
    for name, keys in validation.mapping(("eras",)).items():
        section = section_by_kind([*KINDS.values()], keys)
        eras[name] = given = _given(validation, ("eras", name), section)
        for key, problem in section.problems(given) if given else ():
            validation.add(("eras", name, key), problem)
    _check_places(validation, eras, plate)
    _check_wiring(validation, eras)
    for name in validation.mapping(("masses",)):
        _check_attached(validation, ("masses", name), MassSection, plate)
    for name in validation.mapping(("supports",)):
        given = _check_attached(validation, ("supports", name), SupportSection, plate)
        for key, problem in stiff_mount_problems(given):
            validation.add(("supports", name, key), problem)


def _check_attached(
    validation: Validation[RigSection],
    path: tuple[str, str],
    section: type[MassSection | SupportSection],
    plate: Plate | None,
) -> dict[str, Any]:
    """Check that a mass or support is on the plate, at a point or along the edges; its keys."""
    given = _given(validation, path, section)
    _check_on_plate(validation, path, given.get("at"), plate)
    per_length = "mass_per_length" if section is MassSection else "stiffness_per_length"
    own = set() if "kind" in given else {per_length.removesuffix("_per_length")}
    at_point, at_edges = Way({"at", *own}, {"foot", "kind"}), Way({"along", per_length})
    if given:
        ways = (at_edges, at_point) if "along" in given else (at_point, at_edges)
        _check_way(validation, path, *ways)
    return given


def _check_way(validation: Validation[RigSection], path: KeyPath, this: Way, other: Way) -> bool:
    """Check that a section has all keys of the way that it takes, and none of the other."""
    given = _given(validation, path).keys()
    missing, too_many = this.needed - given, given & (other.needed | other.further)
    for key in sorted(missing):
        instead = ", ".join(sorted(other.needed))
        validation.add((*path, key), f"missing; add it, or {instead} instead")
    for key in sorted(too_many):
        beside = min(this.needed & given, default="the others")
        validation.add((*path, key), f"must not be given with {beside}; remove it")
    return not (missing or too_many)


def _check_plate(validation: Validation[RigSection], *, frequency_max: float) -> Plate | None:
    """The plate if its section is valid: thickness and material, or layers."""
    given = _given(validation, ("plate",))
    if not given:
        return None
    is_layered = "layers" in given
    ways = (_LAYERED, _WHOLE) if is_layered else (_WHOLE, _LAYERED)
    _check_way(validation, ("plate",), *ways)
    layers = validation.mapping(("plate",)).get("layers")
    count = len(layers) if isinstance(layers, list) else 0
    paths = [("plate", "layers", number, "material") for number in range(count)]
    good = [_check_material(validation, path) for path in (("plate", "material"), *paths)]
    section = validation.part(("plate",), PlateSection)
    if section is None or not (all(good) and ways[0].needed <= given.keys()):
        return None
    try:
        laminate = laminate_of(section)
        plate = plate_of(section, frequency_max=frequency_max)
    except InputError as error:
        key = "material" if not is_layered else "bond" if "bond" in given else "layers"
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


def _check_material(validation: Validation[RigSection], path: KeyPath) -> bool:
    """Check that a material by numbers has those of one of both kinds, and only these."""
    given = _given(validation, path).keys()
    has_grain = len(given & ORTHOTROPIC) > (1 if given & ISOTROPIC else 0)
    ways = (_ORTHOTROPIC, _ISOTROPIC) if has_grain else (_ISOTROPIC, _ORTHOTROPIC)
    return not given or _check_way(validation, path, *ways)


def _check_mesh(validation: Validation[RigSection], plate: Plate, *, frequency_max: float) -> None:
    text = validation.field(("mesh",), RigSection)
    try:
        mesh = mesh_of(text or "auto", plate, frequency_max=frequency_max)
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
    validation: Validation[RigSection], eras: Mapping[str, Mapping[str, Any]], plate: Plate | None
) -> None:
    placed: dict[str, tuple[float, float]] = {}
    for name, given in eras.items():
        place = given.get("at")
        _check_on_plate(validation, ("eras", name), place, plate)
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
    path: tuple[str, str],
    place: tuple[float, float] | None,
    plate: Plate | None,
) -> None:
    """Check the place of what is attached to a plate, where both are known."""
    if place is None or plate is None:
        return
    (x, y), length, width = place, plate.length, plate.width
    d = SAME_POINT
    if not (-d <= x <= length + d and -d <= y <= width + d):
        validation.add(
            (*path, "at"),
            f"must be on the plate, from (0, 0) to ({length:g}, {width:g}) m, got ({x:g}, {y:g}) "
            "m; move it",
        )


def _check_wiring(
    validation: Validation[RigSection], eras: Mapping[str, Mapping[str, Any]]
) -> None:
    amplifiers = validation.mapping(("amplifiers",))
    wired: dict[tuple[str, int], str] = {}
    if eras and not any("amplifier" in given for given in eras.values()):
        validation.add(("eras",), "must have at least one ERA with an amplifier; add its amplifier")
    for name, given in eras.items():
        amplifier, channel = given.get("amplifier"), given.get("channel")
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


def _given(
    validation: Validation[RigSection], path: KeyPath, section: type[Section] = Section
) -> dict[str, Any]:
    """Keys of a section that are not empty, with the values of those that are valid, else None."""
    own = validation.mapping(path)
    return {
        key: validation.field((*path, key), section)
        for key, value in own.items()
        if value is not None
    }
