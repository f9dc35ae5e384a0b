"""Build, change and write rigs from keys, and write the results of a fit.

A rig stores its keys, so that dependent values follow a change: damping from a ratio, an automatic
mesh, the equivalent plate of a laminate. A user's file is never overwritten: a fitted rig names it
as its `base` and contains only the differences.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from pydantic_core import to_jsonable_python

from model.config.document import (
    Document,
    KeyPath,
    Value,
    data_text,
    key_name,
    parse_document,
    read_document,
)
from model.config.fields import Section, Validation
from model.config.units import LENGTH, quantity
from model.errors import InputError, expect_instance, expect_path
from model.files.array_file import whole_or_nothing
from model.files.output_paths import check_ending
from model.rig.actuator_keys import ACTUATOR_KINDS
from model.rig.plate_sections import PlateSection
from model.rig.rig import Rig
from model.rig.rig_file import base_fingerprint, base_path, merged_keys, own_keys, rig_of
from model.rig.sections import RigSection
from model.structure.attachments import PointLoad
from model.structure.material import known_material
from model.structure.modal_elasticity import check_is_plate
from model.structure.plate import FIELDS_BESIDE_THEORY

_TOLERANCE = 1e-9  # of written numbers, relative

_ZERO = 1e-12  # a smaller value of any quantity counts as zero

_SECTIONS = RigSection.model_fields.keys() - {"plate", "eras"}
"""Keys that are changed as a whole."""

_CHANGED = "change_rig"
"""Document name in errors."""

_POSITIONED = {"eras", "masses", "supports"}
"""Sections whose entries have a position on the plate."""

_THEORY_KEYS = PlateSection.model_fields.keys() - {*FIELDS_BESIDE_THEORY, "modes"}
"""Keys of a plate that determine the theoretical modes to which its `modes` are relative."""

_REWRITTEN = ("plate", "mesh", "eras", "masses", "laminate", "uncertainty")
"""Fields of a rig that the text of a fitted one contains."""


def save_beside(
    output: Path,
    document: Document,
    keys: Mapping[str, Any],
    *,
    comment: str,
    errors: Mapping[KeyPath, float] | None = None,
    expected: Rig | None = None,
) -> Rig:
    """Write fitted keys to a new rig file, which names the original file as its base.

    document: from which the rig was built; if it is a fitted one, its keys are kept unless
    replaced. errors: standard errors by key path. expected: the rig that the file must read back
    as. If the output is neither in the folder of the rig file nor above it, it cannot name that
    file, and contains the complete rig. Returns the rig as read back. Raises InputError, before
    writing, if that differs from the expected one; OSError if the file cannot be written.
    """
    fitted_file = document.over
    if fitted_file is None:
        base, former_keys = Path(document.source), {}
    else:
        base, former_keys = base_path(fitted_file), own_keys(fitted_file)
    name = _name_below(output, base)
    if name is None:
        data = merged_keys(document.data, {**keys})
    else:
        if fitted_file is None:
            fingerprint: Value = base_fingerprint(document)
        else:
            fingerprint = fitted_file.data["base_fingerprint"]
        changes = merged_keys(former_keys, {**keys}, is_final=False)
        data = {"base": name, "base_fingerprint": fingerprint, **changes}
        if errors:
            rounded = {path: float(f"{error:.3g}") for path, error in errors.items()}
            data["standard_errors"] = _nested(rounded)
    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    text = f"{lines}\n{data_text(data)}"
    rig = rig_of(parse_document(str(output), text))
    section = Validation(document, RigSection).finish()
    if expected is not None and not _is_same(rig, expected, section):
        raise InputError(
            f"{document.source}: values read back must equal those written; write plate and ERAs "
            "as `era config init` does, and try again"
        )
    with whole_or_nothing(output) as stream:
        stream.write(text.encode())
    return rig


def save_fitted(
    output: Path,
    before: Rig,
    after: Rig,
    *,
    comment: str,
    errors: Mapping[KeyPath, float] | None = None,
) -> None:
    """Write a fitted rig with the original rig file as its base; see `save_beside`.

    Writes plate, ERAs, feet, uncertainty and masses that differ. Raises InputError if the file
    reads back with other values.
    """
    keys = fitted_keys(before, after)
    document = document_of(before)
    save_beside(output, document, keys, comment=comment, errors=errors, expected=after)


def fitted_keys(before: Rig, after: Rig) -> dict[str, Any]:
    """Return only the rig-file keys that turn a rig into another rig with the same ERAs.

    None removes a key.
    """
    document = document_of(before)
    section = Validation(document, RigSection).finish()
    data = cast("dict[str, Any]", document.data)
    changes = _changed_values(before, after, section)
    for path, value in changes.items():
        if path[-1] == "material":
            changes[path] = _restated_material(data, path, value)
    keys = _nested(changes, data)
    for era in after.eras:
        entry, base_keys = keys["eras"][era.name], data["eras"][era.name]
        for key, replaced_keys in ACTUATOR_KINDS[type(era)].instead.items():
            if key in entry:
                entry |= {replaced: None for replaced in replaced_keys if replaced in base_keys}
    _add_masses(keys, data, after.masses[len(before.masses) :])
    return keys


def _changed_values(before: Rig, after: Rig, section: RigSection) -> dict[KeyPath, Any]:
    """Return the values that differ between two rigs, and values that replace other keys."""
    always: set[KeyPath] = {("plate", "loss_factor")}
    for era in after.eras:
        always |= {("eras", era.name, key) for key in ACTUATOR_KINDS[type(era)].instead}
    former = _values(before, section)
    changes = {}
    for path, value in _values(after, section).items():
        if value != former[path] or path in always:
            changes[path] = value
    return changes


def _add_masses(keys: dict[str, Any], data: Mapping[str, Any], masses: Sequence[PointLoad]) -> None:
    """Add identified masses to rig-file keys, as found1, found2, ..."""
    names = {*(data.get("masses") or ())}
    for mass in masses:
        number = 1
        while f"found{number}" in names:
            number += 1
        names.add(f"found{number}")
        entry = {"at": [mass.x, mass.y], "mass": mass.mass}
        keys.setdefault("masses", {})[f"found{number}"] = entry


def fitted_rows(rig: Rig) -> list[tuple[str, Any, Any, float | None]]:
    """Return key, base value, value and standard error of every key that a fitted rig changes.

    Numbers in SI units; None without a standard error. Raises InputError for a rig without a base.
    """
    document = document_of(rig)
    if document.over is None:
        raise InputError(
            f"{document.source} must be a fitted rig with a `base`; `era calibrate` and "
            "`era rig identify` write one"
        )
    base = rig_of(read_document(base_path(document.over)))
    base_document = document_of(base)
    section = Validation(base_document, RigSection).finish()
    base_values = dict(_leaves(base_document.data))
    base_values |= _leaves(_nested(_values(base, section)))
    errors = dict(_leaves(document.over.data.get("standard_errors") or {}))
    rows = []
    for path, value in _leaves(own_keys(document.over)):
        base_value = base_values.get(path)
        if value != base_value:
            rows.append((key_name(path), base_value, value, errors.get(path)))
    return rows


def _leaves(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the values in nested mappings with their paths; a list is one value."""
    if not isinstance(value, Mapping):
        yield path, value
        return
    for key, entry in value.items():
        yield from _leaves(entry, (*path, key))


def _name_below(output: Path, base: Path) -> str | None:
    """Return the name of a base relative to the output's folder; None outside that folder."""
    folder = output.absolute().parent
    base_file = base.absolute()
    if not base_file.is_relative_to(folder):
        return None
    return base_file.relative_to(folder).as_posix()


def document_of(rig: Rig) -> Document:
    """Return the document that a rig was built from; raises InputError without one."""
    if rig.document is None:
        raise InputError("rig must be read from a file or made by era.rig, got one without keys")
    return rig.document


def _nested(values: Mapping[KeyPath, Any], data: Any = None) -> dict[str, Any]:
    """Convert values by path to nested mappings; lists along a path are copied from the data."""
    nested: dict[str, Any] = {}
    for path, value in values.items():
        parent: Any = nested
        original = data
        for part in path[:-1]:
            if isinstance(original, Mapping):
                original = original.get(part)
            elif original:
                original = original[part]
            if isinstance(parent, dict):
                empty = deepcopy(original) if isinstance(original, list) else {}
                parent = parent.setdefault(part, empty)
            else:
                parent = parent[part]
        parent[path[-1]] = value
    return nested


def _restated_material(data: Any, path: KeyPath, value: dict[str, Any]) -> dict[str, Any]:
    """Merge fitted numbers of a material with its remaining keys, whether given by name or by
    keys."""
    for part in path:
        data = data[part]
    if isinstance(data, Mapping):
        return {**data, **value}
    by_frequency = known_material(data).by_frequency
    if not by_frequency:
        return value
    return value | {"by_frequency": [list(row) for row in by_frequency]}


def _values(rig: Rig, section: RigSection) -> dict[KeyPath, Any]:
    """Return the values of a rig that a fit can change, by key path, as the file states them."""
    values: dict[KeyPath, Any] = {}
    for key, value in asdict(rig.uncertainty).items():
        values["uncertainty", key] = value
    if section.plate is not None:
        for path, value in section.plate.keys_of(rig.plate, rig.laminate).items():
            values["plate", *path] = value
    for era in rig.eras:
        for key, value in ACTUATOR_KINDS[type(era)].keys_of(era).items():
            values["eras", era.name, key] = value
    for name, number in zip(rig.foot_names, rig.feet, strict=True):
        values["supports", name, "stiffness"] = rig.masses[number].stiffness
    return values


def _is_same(rig: Rig, expected: Rig, section: RigSection) -> bool:
    """Return whether all written numbers of two rigs agree within rounding of logarithms."""
    numbers, expected_numbers = _numbers(rig, section), _numbers(expected, section)
    if len(numbers) != len(expected_numbers):
        return False
    is_close = partial(math.isclose, rel_tol=_TOLERANCE, abs_tol=_ZERO)
    return all(map(is_close, numbers, expected_numbers))


def _numbers(rig: Rig, section: RigSection) -> list[float]:
    """Return all written numbers of a rig."""
    # A file's own masses come before its supports, identified ones after both.
    masses = sorted(rig.masses, key=_order_of_load)
    numbers: list[float] = []
    parts: list[Any] = [_values(rig, section), [(mass.x, mass.y, mass.mass) for mass in masses]]
    while parts:
        match parts.pop():
            case int() | float() as number:
                numbers.append(number)
            case Mapping() as mapping:
                parts += mapping.values()
            case list() | tuple() as sequence:
                parts += sequence
    return numbers


def _order_of_load(load: PointLoad) -> tuple[bool, float, float]:
    return load.stiffness > 0, round(load.x, 5), round(load.y, 5)


def checked_keys(source: str, section: type[Section], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a section as file data; source: caller, for errors. Raises ConfigError."""
    document = _document(source, keys)
    Validation(document, section).finish()
    return document.data


def rig(
    plate: Mapping[str, Any],
    eras: Mapping[str, Mapping[str, Any]],
    *,
    amplifiers: Mapping[str, Mapping[str, Any]] | None = None,
    masses: Mapping[str, Mapping[str, Any]] | None = None,
    supports: Mapping[str, Mapping[str, Any]] | None = None,
    mesh: str | None = None,
    limits: Mapping[str, Any] | None = None,
    uncertainty: Any = None,
    fingertip: Any = None,
    threshold: str | None = None,
    promised_thresholds: Sequence[str] | None = None,
) -> Rig:
    """Build a rig from a `Plate` and an `Era` per name, like a file with these sections.

    amplifiers: default `{"main": {"url": "sim://"}}`, a simulated one, with the ERAs on its
    channels in order; uncertainty, fingertip: mappings, or an `Uncertainty` and a `Fingertip`;
    fingertip="none" for massless fingers. An argument that is omitted or None has the default
    of a file. Raises ConfigError with all problems, by argument and key.

    Example:
        >>> sheet = era.Plate(length=0.4, width=0.3, thickness="3 mm", material="aluminium")
        >>> places = {"SW": (0, 0), "SE": (0.4, 0), "NE": (0.4, 0.3), "NW": (0, 0.3)}
        >>> keys = {"stiffness": "15 kN/m", "stroke": "50 um"}
        >>> eras = {name: era.Era(at=at, **keys) for name, at in places.items()}
        >>> mine = era.rig(sheet, eras)
    """
    if amplifiers is None:
        expect_instance(
            eras, Mapping, what="eras", made_by='{"SW": era.Era(at=(0, 0), stiffness=17e3)}'
        )
        amplifiers = {"main": {"url": "sim://"}}
        wiring = {name: {"amplifier": "main", "channel": n} for n, name in enumerate(eras)}
        eras = _merged(wiring, eras)
    sections = {
        "plate": plate,
        "eras": eras,
        "amplifiers": amplifiers,
        "masses": masses,
        "supports": supports,
        "mesh": mesh,
        "limits": limits,
        "uncertainty": uncertainty,
        "fingertip": fingertip,
        "threshold": threshold,
        "promised_thresholds": promised_thresholds,
    }
    return rig_of(_document("era.rig", sections))


def save_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig file from which `load_rig` returns the same rig.

    It contains the text of the rig's original file, or all keys without a file. Raises InputError
    for a rig that a file cannot express, OSError if the file cannot be written.

    Example:
        >>> era.save_rig(mine, "mine.yaml")
        >>> era.load_rig("mine.yaml").fingerprint == mine.fingerprint
        True
    """
    expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    file = expect_path(path, what="path")
    document = document_for(rig)
    if document.over is not None:
        for source in (Path(document.over.source), base_path(document.over)):
            if file.resolve() == source.resolve():
                raise InputError(
                    f"path must be another file than {source}, which this fitted rig was read from"
                )
    check_ending(file, ".yaml", ".yml", what="a rig file")
    written = parse_document(str(file), document.whole_text)
    rig_of(written)
    with whole_or_nothing(file) as stream:
        stream.write(written.text.encode())


def change_rig(rig: Rig, **changes: Any) -> Rig:
    """Return a rig with changed keys of the plate (thickness=0.002) or changed sections.

    `plate` and `eras` change only the given keys: eras={"SW": {"stiffness": 2e4}}. Dependent values
    are computed again: damping from `damping_ratio`, the mesh if it is `auto`, the equivalent plate
    of a laminate. If the plate changes size, ERAs and masses keep their relative positions. None
    removes an ERA, or a key, whose default then applies. So fingertip=None restores the default
    fingertip; fingertip="none" is a massless finger. Raises ConfigError with all problems,
    InputError for `modes` identified on another plate.

    Example:
        >>> thick = era.change_rig(rig, thickness=0.002, eras={"SW": {"stiffness": 2e4}})
    """
    expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    check_is_plate(rig.plate, _CHANGED)
    for key in ("plate", "eras"):
        if key in changes:
            expect_instance(
                changes[key], Mapping, what=key, made_by='{"thickness": 0.002} or era.Era'
            )
    data: dict[str, Any] = {**document_for(rig).data}
    plate_changes = {
        key: value for key, value in changes.items() if key not in RigSection.model_fields
    }
    plate_changes |= changes.get("plate", {})
    data["plate"] = _without_none(data["plate"] | plate_changes)
    changes_modes = not _THEORY_KEYS.isdisjoint(plate_changes)
    if data["plate"].get("modes") and changes_modes and "modes" not in plate_changes:
        raise InputError(
            f"{_CHANGED}: plate.modes must be given for another plate, got those identified on "
            "this one; use modes=None for theoretical modes"
        )
    sections = _with_relative_positions(rig, data)
    for key in _SECTIONS & changes.keys():
        sections[key] = changes[key]
    sections["eras"] = _merged(sections["eras"], changes.get("eras", {}))
    return rig_of(_document(_CHANGED, sections))


def _with_relative_positions(rig: Rig, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of a rig of another size, with relative positions unchanged."""
    validation = Validation(_document(_CHANGED, data), RigSection)
    length = validation.field(("plate", "length"), PlateSection) or rig.plate.length
    width = validation.field(("plate", "width"), PlateSection) or rig.plate.width
    factors = (length / rig.plate.length, width / rig.plate.width)
    sections = {**data}
    if factors == (1, 1):
        return sections
    for kind in _POSITIONED & data.keys():
        sections[kind] = {name: _moved(keys, factors) for name, keys in data[kind].items()}
    return sections


def _moved(keys: Mapping[str, Any], factors: tuple[float, float]) -> Mapping[str, Any]:
    """Multiply the position in a section's keys by factors; unchanged without a position."""
    if "at" not in keys:
        return keys
    position = [
        factor * quantity(coordinate, LENGTH)
        for factor, coordinate in zip(factors, keys["at"], strict=True)
    ]
    return {**keys, "at": position}


def _merged(sections: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into sections: keys are changed or added; None removes keys or whole
    sections."""
    merged = {**sections, **changes}
    for name, keys in merged.items():
        if isinstance(keys, Mapping):
            merged[name] = _without_none({**sections.get(name, {}), **keys})
    return _without_none(merged)


def document_for(rig: Rig) -> Document:
    """Return a document that expresses a rig; raises InputError for one not built from keys.

    For a fitted rig it contains plate, ERAs, masses and uncertainty.
    """
    document = document_of(rig)
    before = rig_of(document)
    if before == rig:
        return document
    data = merged_keys(document.data, fitted_keys(before, rig))
    fitted_document = Document(document.source, "", data)
    fitted = rig_of(fitted_document)
    is_same = _is_same(fitted, rig, Validation(document, RigSection).finish())
    rewritten = {name: getattr(rig, name) for name in _REWRITTEN}
    if not is_same or replace(fitted, **rewritten) != rig:
        raise InputError(
            "rig must differ from its keys only in plate, ERAs, masses and uncertainty; change "
            "others by change_rig"
        )
    return fitted_document


def _document(source: str, keys: Mapping[str, Any]) -> Document:
    """Return keys given by a program as file data."""
    return Document(source, "", to_jsonable_python(_without_none(keys), fallback=_as_list_or_text))


def _as_list_or_text(value: Any) -> Any:
    """Convert an array to a list, and any other object to text."""
    return value.tolist() if hasattr(value, "tolist") else repr(value)


def _without_none(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys whose value is not None."""
    return {key: value for key, value in keys.items() if value is not None}
