"""Read a rig from its file: merge a fitted rig with its base, check it, and build the rig.

All problems of a file are reported together.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, NoReturn

from pydantic_core import to_jsonable_python

from model.config.document import (
    ConfigError,
    Document,
    Value,
    is_file_name,
    parse_document,
    read_document,
)
from model.config.fields import Validation
from model.errors import InputError, expect_path, shown
from model.rig.rig import Channel, Rig, canonical_json, physics_of
from model.rig.rig_checks import check_across, modes_file
from model.rig.rig_mesh import mesh_of
from model.rig.sections import FingertipSection, RigSection
from model.structure.attachments import PointLoad
from model.structure.exciter import Actuator
from model.structure.fingertips import Fingertip
from model.structure.plate import Plate

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
    quoted = shown(name)
    if PurePath(name).is_absolute() or ".." in PurePath(name).parts:
        refuse(
            f"must be in the folder of this file or below it, got {quoted}; put both files together"
        )
    path = base_path(document)
    if not path.is_file():
        refuse(
            f"must be an existing rig file in this folder or below it, got {quoted}; put it back"
        )
    if path.resolve() == Path(document.source).resolve():
        refuse(f"must be the rig file that was fitted, got this file, {quoted}; name the other one")
    base = read_document(path)
    check_is_rig(base)
    if "base" in base.data:
        refuse(f"must be a complete rig, got {quoted}, which has a base of its own; name that base")
    if document.data.get("base_fingerprint") != base_fingerprint(base):
        refuse(
            f"{quoted} must have the same plate, ERAs, masses and supports as when "
            "they were fitted; undo the changes there, or fit again"
        )
    changes = own_keys(document)
    for kind in _NAMED:
        base_entries, changed_entries = base.data.get(kind), changes.get(kind)
        if not isinstance(changed_entries, dict):
            continue
        for entry in changed_entries:
            if not isinstance(base_entries, dict) or entry not in base_entries:
                refuse(
                    f"must be a name in {quoted}, which does not have it; remove it", kind, entry
                )
    data = merged_keys(base.data, changes)
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
    exact = canonical_json({key: physics[key] for key in ("plate", "eras", "masses")})
    rounded = json.loads(exact, parse_float=_twelve_digits)
    return hashlib.sha256(canonical_json(rounded).encode()).hexdigest()[:16]


def _twelve_digits(text: str) -> str:
    return f"{float(text):.12g}"


def merged_keys(base: Value, over: Value, *, is_final: bool = True) -> Any:
    """Merge keys of two files recursively, `over` taking precedence; lists are replaced as a whole.

    is_final: whether null removes a key; otherwise null is kept for a later merge.
    """
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    merged = {**base}
    for key, value in over.items():
        if is_final and value is None:
            merged.pop(key, None)
        else:
            merged[key] = merged_keys(base.get(key), value, is_final=is_final)
    return merged


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
        document = _with_key(document, "mesh", mesh)
    if section.surface is not None:
        modes = modes_file(section.surface, document)
        plate = section.surface.build(modes)
        # Other folders and processes receive the keys of a rig, but not its modes file.
        keys = section.surface.model_dump(exclude_none=True) | {"modes": str(modes)}
        document = _with_key(document, "surface", to_jsonable_python(keys))
    else:
        assert section.plate is not None  # noqa: S101  see check_across
        plate = section.plate.build(frequency_max=section.limits.frequency[1])
    count = len(section.eras)
    actuators = {name: era.build(name, plate, count) for name, era in section.eras.items()}
    wiring = _wiring(section)
    mounts = {name: era for name, era in actuators.items() if name not in wiring}
    fingertip_section: FingertipSection | str = section.fingertip
    fingertip = None
    if not isinstance(fingertip_section, str):
        fingertip = Fingertip(**fingertip_section.model_dump())
    return Rig(
        plate=plate,
        mesh=mesh_of(
            section.mesh if mesh is None else mesh,
            plate,
            frequency_max=section.limits.frequency[1],
            stiffness=max(era.in_time.stiffness for era in actuators.values()),
            foot=min(era.foot for era in actuators.values()),
        ),
        eras=tuple(era for name, era in actuators.items() if name in wiring),
        wiring=wiring,
        amplifiers={name: amplifier.url for name, amplifier in section.amplifiers.items()},
        limits=section.limits.build(),
        masses=_point_loads(section, plate, mounts),
        supports=tuple(mounts),
        laminate=None if section.plate is None else section.plate.laminate,
        uncertainty=section.uncertainty.build(
            has_feet=any(foot.at is not None for foot in section.supports.values()),
            weather=0.0 if section.plate is None else section.plate.weather,
        ),
        fingertip=fingertip,
        threshold=section.threshold,
        promised_thresholds=tuple(section.promised_thresholds),
        outputs=_outputs(section),
        clock_errors=_clock_errors(section),
        document=document,
    )


def _with_key(document: Document, key: str, value: Value) -> Document:
    """Return a document with one key replaced, and without its text."""
    return replace(document, text="", data=document.data | {key: value}, find_lines=dict)


def _wiring(section: RigSection) -> dict[str, Channel]:
    """Return the channels of driven actuators, by name."""
    wiring = {}
    for name, era in section.eras.items():
        if era.amplifier is not None and era.channel is not None:
            wiring[name] = Channel(era.amplifier, era.channel)
    return wiring


def _point_loads(
    section: RigSection, plate: Plate, mounts: Mapping[str, Actuator]
) -> tuple[PointLoad, ...]:
    """Return masses, supports and then passive mounts, as loads on a plate."""
    loads: list[PointLoad] = []
    for mass in section.masses.values():
        loads += mass.build(plate)
    for support in section.supports.values():
        loads += support.build(plate)
    loads += [mount.support for mount in mounts.values()]
    return tuple(loads)


def _outputs(section: RigSection) -> frozenset[str]:
    """Return the amplifiers whose full level is an electrical output."""
    electrical = {era.amplifier for era in section.eras.values() if era.is_electrical}
    outputs = set()
    for name, amplifier in section.amplifiers.items():
        default = "output" if name in electrical else "motion"
        if (amplifier.full_level or default) == "output":
            outputs.add(name)
    return frozenset(outputs)


def _clock_errors(section: RigSection) -> dict[str, float]:
    """Return the clock error of each amplifier [s], infinite if it is unknown."""
    errors = {}
    for name, amplifier in section.amplifiers.items():
        error = amplifier.clock_error
        errors[name] = math.inf if error == "unknown" else error
    return errors


def example_rig_path() -> Path:
    """Return the path of the commented rig of the paper's plate.

    Example:
        >>> era.example_rig_path().name
        'paper_plate.yaml'
    """
    here = Path(__file__).parents[1]  # part of the package data in a wheel
    installed = here / "data" / "paper_plate.yaml"
    return installed if installed.exists() else here.parent / "examples" / "paper_plate.yaml"
