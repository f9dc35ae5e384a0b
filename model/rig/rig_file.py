"""Read a rig from its file: parse its mesh, check across sections, and build the rig.

Every section checks and builds its own part (`model.rig.sections`). This module checks for
conflicts between valid sections. All problems of a file are reported together.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Set
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple, NoReturn

from pydantic_core import to_jsonable_python

from model.config.document import (
    ConfigError,
    Document,
    KeyPath,
    Value,
    is_file_name,
    key_name,
    parse_document,
    read_document,
)
from model.config.fields import Quantity, Section, Validation, section_by_kind
from model.config.units import LENGTH, RATIO, quantity
from model.errors import InputError, expect_path, shown
from model.fem import MITC4, Mesh, element_of
from model.rig.actuator_keys import ACTUATOR_KINDS, stiff_mount_problems
from model.rig.rig import SAME_POINT, Channel, Rig, canonical_json, physics_of
from model.rig.sections import (
    ISOTROPIC,
    ORTHOTROPIC,
    FingertipSection,
    LimitsSection,
    MassSection,
    PlateSection,
    RigSection,
    SupportSection,
    SurfaceSection,
    UncertaintySection,
)
from model.spectral.modes import (
    MAX_DEGREE,
    MAX_POLYNOMIALS,
    POLYNOMIALS,
    KnownModes,
    PlateMesh,
    SpectralMesh,
)
from model.structure.attachments import (
    Fingertip,
)
from model.structure.plate import (
    Plate,
)
from model.structure.surface import LEAST_KNOWN
from registry.plugins import did_you_mean

_MAX_ELEMENTS_PER_SIDE = 1000
_ACCURACY = Quantity(RATIO, at_least=0.0005, at_most=0.1)
_DEFAULT_ACCURACY = 0.01  # changes the response as much as 0.1 mm of an ERA's position
_MAX_NODES = 300_000  # a million degrees of freedom: minutes, and most of the memory

_STRIPS = " with strips of "


def mesh_of(
    text: str, plate: Plate, *, frequency_max: float, stiffness: float = 0.0, foot: float = 0.0
) -> PlateMesh:
    """Return the mesh `auto` or `auto A %`, accurate up to a frequency [Hz], or the mesh of
    `parse_mesh`.

    `auto` uses polynomials over the plate for a response error of A %, default 1 %. stiffness
    [N/m]: of the stiffest ERA; foot [m]: smallest contact radius, 0 for a point.
    """
    words = text.split()
    if plate.surface is not None:
        if words != ["auto"]:
            raise InputError(
                f"mesh must not be given for a surface, whose modes are known, got {text[:40]!r}"
            )
        return KnownModes.of(plate, plate.surface)
    if words[:1] != ["auto"]:
        mesh = parse_mesh(text, plate)
        if isinstance(mesh, Mesh) and max(mesh.nx, mesh.ny) > _MAX_ELEMENTS_PER_SIDE:
            raise InputError(
                f"mesh must have 1 to {_MAX_ELEMENTS_PER_SIDE} elements a side, got {mesh}"
            )
        if isinstance(mesh, Mesh) and mesh.node_count > _MAX_NODES:
            raise InputError(f"mesh must have at most {_MAX_NODES} nodes, got {mesh}")
        return mesh
    asked = " ".join(words[1:]) or _DEFAULT_ACCURACY
    try:
        accuracy = _ACCURACY.read(asked)
    except ValueError as error:
        raise InputError(f"mesh: the accuracy of auto {error}; for example auto 1 %") from None
    polynomials = SpectralMesh.accurate(
        plate, frequency_max=frequency_max, accuracy=accuracy, stiffness=stiffness, foot=foot
    )
    if polynomials is None:
        raise InputError(
            f"mesh: {text} must need at most {MAX_POLYNOMIALS} polynomials up to degree "
            f"{MAX_DEGREE}, got more up to {frequency_max:g} Hz; check the plate's sizes, lower "
            "limits.frequency, or ask for less accuracy"
        )
    return polynomials


def parse_mesh(text: str, plate: Plate) -> PlateMesh:
    """Parse the mesh `NXxNY`, or `NXxNY ELEMENT`, over a plate; Legendre numbers are degrees.

    Elements can have `with strips of` a length, as a mesh is printed. Raises InputError for other
    text, an unknown element, and zero elements.
    """
    if plate.surface is not None:
        return KnownModes.of(plate, plate.surface)
    match = re.fullmatch(
        rf"\s*(\d{{1,6}})\s*[xX×]\s*(\d{{1,6}})(?:\s+(\S{{1,40}}))?(?:{_STRIPS}(.{{1,40}}))?\s*",
        text,
        re.ASCII,
    )
    if match is None:
        raise InputError(
            f"mesh must be auto, auto 1 %, or NXxNY with an optional element, for example 48x36 "
            f"or 12x9 Q3, got {text[:40]!r}"
        )
    nx, ny = int(match[1]), int(match[2])
    strip = quantity(match[4], LENGTH) if match[4] else 0.0
    if match[3] == POLYNOMIALS:
        if strip:
            raise InputError(f"mesh of polynomials must be without strips, got {text[:40]!r}")
        return SpectralMesh(nx, ny, plate.length, plate.width)
    element = element_of(match[3]) if match[3] else MITC4
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width, element=element, strip=strip)


class Way(NamedTuple):
    """One of two alternative ways to describe a property: its required keys, and optional ones."""

    needed: Set[str]
    further: Set[str] = frozenset()


_WHOLE, _LAYERED = Way({"thickness", "material"}, {"grain"}), Way({"layers"}, {"bond"})
_ISOTROPIC, _ORTHOTROPIC = Way(ISOTROPIC, {"by_frequency"}), Way(ORTHOTROPIC)


def check_across(validation: Validation[RigSection], *, mesh_given: bool) -> None:
    """Add conflicts between sections that are valid on their own."""
    limits = validation.field(("limits", "frequency"), LimitsSection)
    high = (limits or LimitsSection().frequency)[1]
    plate = _check_plate(validation, frequency_max=high)
    if plate is not None and plate.surface is None and not mesh_given:
        _check_mesh(validation, plate, frequency_max=high)
    path = "uncertainty", "mode_amplitude"
    if plate is not None and plate.surface is None and validation.field(path, UncertaintySection):
        validation.add(path, "must be given only with surface; remove it, or give surface")
    eras = {}
    for name, keys in validation.mapping(("eras",)).items():
        section = section_by_kind([*ACTUATOR_KINDS.values()], keys)
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
    """Check that a mass or support is on the plate, at a point or along the edges; return its
    keys."""
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
    """Check that a section has all keys of the chosen alternative and none of the other."""
    given = _given(validation, path).keys()
    missing, too_many = this.needed - given, given & (other.needed | other.further)
    for key in sorted(missing):
        instead = ", ".join(sorted(other.needed))
        validation.add((*path, key), f"missing; add it, or {instead} instead")
    for key in sorted(too_many):
        other_key = min(this.needed & given, default="the others")
        validation.add((*path, key), f"must not be given with {other_key}; remove it")
    return not (missing or too_many)


def _check_plate(validation: Validation[RigSection], *, frequency_max: float) -> Plate | None:
    """Return the plate if its section is valid: thickness and material, or layers."""
    given = _given(validation, ("plate",))
    if "surface" in (whole := validation.mapping(())):
        return _check_surface(validation, frequency_max=frequency_max)
    if "plate" not in whole:
        validation.add(("plate",), "missing; add it, or surface instead")
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
        laminate = section.laminate
        plate = section.made(frequency_max=frequency_max)
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


def _modes_of(section: SurfaceSection, document: Document) -> Path:
    """Return the file of a surface's modes, relative to the rig file or the target of its link."""
    return replace(document, source=str(Path(document.source).resolve())).beside(section.modes)


def _check_surface(validation: Validation[RigSection], *, frequency_max: float) -> Plate | None:
    """Return the plate of a surface if its section is valid and has enough modes."""
    for key in validation.mapping(()).keys() & {"plate", "mesh"}:
        validation.add((key,), "must not be given with surface; remove it")
    section: SurfaceSection | None = validation.field(("surface",), RigSection)
    if section is None:
        return None
    try:
        plate = section.made(_modes_of(section, validation.document))
    except InputError as error:
        validation.add(("surface",), str(error))
        return None
    known = mesh_of("auto", plate, frequency_max=frequency_max)
    if frequency_max > known.highest_frequency(plate):
        validation.add(
            ("surface",),
            f"modes must be known up to {LEAST_KNOWN:g} times the {frequency_max:g} Hz of "
            f"limits.frequency, got {known}; export more, or lower the limit",
        )
        return None
    return plate


def _check_material(validation: Validation[RigSection], path: KeyPath) -> bool:
    """Check that a numeric material has the numbers of exactly one of both kinds."""
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
    """Check that an attachment is on the plate, if both positions and plate are valid."""
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
    elif not plate.contains(min(max(x, 0.0), length), min(max(y, 0.0), width)):
        validation.add((*path, "at"), f"must be within the outline, got ({x:g}, {y:g}) m; move it")


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
                f"known: {known}",
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
    """Return the non-empty keys of a section: valid ones with their values, others None."""
    own = validation.mapping(path)
    return {
        key: validation.field((*path, key), section)
        for key, value in own.items()
        if value is not None
    }


_BASE_KEYS = ("base", "base_fingerprint", "standard_errors")
"""Keys that only a fitted rig has: its base, and standard errors."""

_RIG_KEYS = {*RigSection.model_fields, *_BASE_KEYS}

_MAX_KEYS_SHOWN = 3

_NAMED = ("eras", "supports", "amplifiers")  # sections whose entries are merged with the base


def with_base(document: Document) -> Document:
    """Merge a fitted rig's keys with the rig file that `base` names.

    Other documents are returned unchanged. Raises ConfigError for a base that is missing, outside
    the folder, fitted itself, invalid, or changed since the fit, and for names that it lacks.
    """
    if "base" not in document.data or document.over is not None:
        return document

    def refuse(message: str, *path: str) -> NoReturn:
        raise ConfigError(document.source, [document.problem(path or ("base",), message)])

    name = document.data["base"]
    if not is_file_name(name):
        refuse(f"must be the name of a rig file, got {shown(name)}")
    named = shown(name)
    if PurePath(name).is_absolute() or ".." in PurePath(name).parts:
        refuse(
            f"must be in the folder of this file or below it, got {named}; put both files together"
        )
    path = base_path(document)
    if not path.is_file():
        refuse(f"must be an existing rig file in this folder or below it, got {named}; put it back")
    if path.resolve() == Path(document.source).resolve():
        refuse(f"must be the rig file that was fitted, got this file, {named}; name the other one")
    base = read_document(path)
    check_is_rig(base)
    if "base" in base.data:
        refuse(f"must be a complete rig, got {named}, which has a base of its own; name that base")
    if document.data.get("base_fingerprint") != base_fingerprint(base):
        refuse(
            f"{named} must have the same plate, ERAs, masses and supports as when "
            "they were fitted; undo the changes there, or fit again"
        )
    over = own_keys(document)
    for kind in _NAMED:
        known, given = (each.get(kind) for each in (base.data, over))
        for each in given if isinstance(given, dict) else ():
            if not isinstance(known, dict) or each not in known:
                refuse(f"must be a name in {named}, which does not have it; remove it", kind, each)
    data = merged_keys(base.data, over)
    return Document(document.source, "", data, document.find_lines, over=document)


def base_path(document: Document) -> Path:
    """Return the path of the rig file named as base by a fitted one."""
    return Path(document.source).parent / str(document.data["base"])


def own_keys(document: Document) -> dict[str, Value]:
    """Return the rig keys that a fitted file has in addition to its base."""
    return {key: value for key, value in document.data.items() if key not in _BASE_KEYS}


def base_fingerprint(base: Document) -> str:
    """Return sixteen digits that change with a rig's plate, ERAs, masses and supports.

    Values count to twelve digits, in any unit. Wiring, limits and thresholds can change, since no
    fit depends on them. Raises ConfigError for an invalid rig.
    """
    physics = physics_of(rig_of(base))
    stated = canonical_json({key: physics[key] for key in ("plate", "eras", "masses")})
    rounded = json.loads(stated, parse_float=lambda text: f"{float(text):.12g}")
    return hashlib.sha256(canonical_json(rounded).encode()).hexdigest()[:16]


def merged_keys(base: Value, over: Value, *, is_final: bool = True) -> Any:
    """Merge keys of two files recursively, `over` taking precedence; lists are replaced as a whole.

    is_final: whether null removes a key; otherwise null is kept for a later merge.
    """
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    found = {
        **base,
        **{key: merged_keys(base.get(key), each, is_final=is_final) for key, each in over.items()},
    }
    return {
        key: value
        for key, value in found.items()
        if not (is_final and value is None and key in over)
    }


def load_rig(path: Path | str, *, mesh: str | None = None) -> Rig:
    """Read a rig file; mesh: replaces the file's mesh, `auto` or NXxNY.

    Raises ConfigError with all problems of the file; InputError for an invalid mesh. The mesh can
    be coarser than a rig file allows, to study its error.

    Example:
        >>> rig = era.load_rig("examples/paper_plate.yaml")
        >>> [each.name for each in rig.eras]
        ['SW', 'SE', 'NE', 'NW']
    """
    if mesh is not None and not isinstance(mesh, str):
        raise InputError(f"mesh must be text such as '48x36' or 'auto', got {shown(mesh)}")
    return rig_of(read_document(expect_path(path, what="path")), mesh=mesh)


def check_is_rig(document: Document) -> None:
    """Reject a file without any key of a rig as a whole, instead of reporting each unknown key."""
    keys = [*document.data]
    if keys and _RIG_KEYS.isdisjoint(keys):
        first_keys = ", ".join(shown(key) for key in keys[:_MAX_KEYS_SHOWN])
        raise InputError(
            f"{document.source}: must be a rig, with plate or surface, got a file with "
            f"{first_keys}; era config init rig.yaml  writes one"
        )


def parse_rig(source: str, text: str) -> Rig:
    """Parse the text of a rig file; raises ConfigError."""
    return rig_of(parse_document(source, text))


def rig_of(document: Document, *, mesh: str | None = None) -> Rig:
    """Build the rig of a document, with another mesh if given; raises like `load_rig`."""
    document = with_base(document)
    check_is_rig(document)
    validation = Validation(document, RigSection)
    check_across(validation, mesh_given=mesh is not None)
    section = validation.finish()
    if mesh is not None:
        document = replace(document, text="", data=document.data | {"mesh": mesh}, find_lines=dict)
    if section.surface is not None:
        modes = _modes_of(section.surface, document)
        plate = section.surface.made(modes)
        # Other folders and processes receive the keys of a rig, but not its modes file.
        named = section.surface.model_dump(exclude_none=True) | {"modes": str(modes)}
        stated = document.data | {"surface": to_jsonable_python(named)}
        document = replace(document, text="", data=stated, find_lines=dict)
    else:
        assert section.plate is not None  # noqa: S101  see check_across
        plate = section.plate.made(frequency_max=section.limits.frequency[1])
    wanted = section.mesh if mesh is None else mesh
    fingertip: FingertipSection | str = section.fingertip
    everything = {
        name: era.made(name, plate, len(section.eras)) for name, era in section.eras.items()
    }
    wiring = {
        name: Channel(era.amplifier, era.channel)
        for name, era in section.eras.items()
        if era.amplifier is not None and era.channel is not None
    }
    electrical = {era.amplifier for era in section.eras.values() if era.is_electrical}
    supports = {name: era for name, era in everything.items() if name not in wiring}
    return Rig(
        plate=plate,
        mesh=mesh_of(
            wanted,
            plate,
            frequency_max=section.limits.frequency[1],
            stiffness=max(era.in_time.stiffness for era in everything.values()),
            foot=min(era.foot for era in everything.values()),
        ),
        eras=tuple(era for name, era in everything.items() if name in wiring),
        wiring=wiring,
        amplifiers={name: amplifier.url for name, amplifier in section.amplifiers.items()},
        limits=section.limits.made(),
        masses=(
            *(each for mass in section.masses.values() for each in mass.made(plate)),
            *(each for foot in section.supports.values() for each in foot.made(plate)),
            *(era.support for era in supports.values()),
        ),
        supports=tuple(supports),
        laminate=None if section.plate is None else section.plate.laminate,
        uncertainty=section.uncertainty.made(
            has_feet=any(foot.at is not None for foot in section.supports.values()),
            weather=0.0 if section.plate is None else section.plate.weather,
        ),
        fingertip=None if isinstance(fingertip, str) else Fingertip(**fingertip.model_dump()),
        threshold=section.threshold,
        promised_thresholds=tuple(section.promised_thresholds),
        outputs=frozenset(
            name
            for name, amplifier in section.amplifiers.items()
            if (amplifier.full_level or ("motion", "output")[name in electrical]) == "output"
        ),
        clock_errors={
            name: math.inf if amplifier.clock_error == "unknown" else amplifier.clock_error
            for name, amplifier in section.amplifiers.items()
        },
        document=document,
    )


def example_rig_path() -> Path:
    """Return the path of the commented rig of the paper's plate.

    Example:
        >>> era.example_rig_path().name
        'paper_plate.yaml'
    """
    here = Path(__file__).parents[1]  # part of the package data in a wheel
    installed = here / "data" / "paper_plate.yaml"
    return installed if installed.exists() else here.parent / "examples" / "paper_plate.yaml"
