"""Rigs made, changed and written by the keys of a rig file.

A rig keeps the keys that it was made of, so that dependent values follow a change: the damping of a
ratio, a mesh that is chosen, the homogeneous plate of a laminate. The text of a file with other
values keeps its comments and layout.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias

from pydantic_core import to_jsonable_python
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from model.config.document import Document, KeyPath, data_text, edited_text, parse_document
from model.config.fields import Section, Validation
from model.config.units import LENGTH, quantity
from model.errors import InputError, expect, expect_path
from model.files.array_file import whole_or_nothing
from model.files.output_paths import check_ending
from model.rig.actuator_keys import KINDS
from model.rig.rig import Rig
from model.rig.rig_file import rig_of
from model.rig.sections import PlateSection, RigSection
from model.structure.material import known_material
from model.structure.plate import FOLLOWED_FIELDS

_PER_LINE = 4
_SAME, _NONE = 1e-4, 1e-6  # relative; and what counts as nothing of every quantity

# ruamel.yaml wraps long sequences anywhere, so rows replace placeholders in its text.
_ROWS_OF = "rows-of-"
_PLACEHOLDER = re.compile(
    rf"^(?P<start>(?P<indent> *).*(gains|modes):\s+){_ROWS_OF}(?P<number>\d+)", re.MULTILINE
)


def rewritten_text(
    document: Document, before: Rig, after: Rig, *, comment: str, mesh: str | None = None
) -> str:
    """Return a rig file's text with the values of another rig of the same ERAs, after a comment.

    Written are plate, ERAs, feet and uncertainty where they differ, further masses after its own.
    mesh: that replaces the file's. Raises ConfigError if a comment of the file would be lost,
    InputError where the text, read as a rig, has other values.
    """
    section = Validation(document, RigSection).finish()
    rows: list[Rows] = []

    def change(data: CommentedMap) -> None:
        own = _values(before, section)
        for path, value in _values(after, section).items():
            if value != own[path] or path in _restated(after):
                _put(data, path, value, rows)
        for era in after.eras:
            entry = data["eras"][era.name]
            for key, others in KINDS[type(era)].instead.items():
                for other in others if key in entry else ():
                    entry.pop(other, None)
        for mass in after.masses[len(before.masses) :]:
            masses = data.setdefault("masses", CommentedMap())
            numbers = range(1, len(masses) + 2)
            name = next(name for n in numbers if (name := f"found{n}") not in masses)
            masses[name] = _flow({"at": [mass.x, mass.y], "mass": mass.mass})

    def rows_text(match: re.Match[str]) -> str:
        """Rows in brackets, a few on each line."""
        texts = [str(_rounded(row)) for row in rows[int(match["number"])]]
        lines = [texts[at : at + _PER_LINE] for at in range(0, len(texts), _PER_LINE)]
        joined = f",\n{match['indent']}    ".join(map(", ".join, lines))
        return f"{match['start']}[\n{match['indent']}    {joined}]"

    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    text = f"{lines}\n{_PLACEHOLDER.sub(rows_text, edited_text(document, change))}"
    back = rig_of(parse_document(document.source, text), mesh=mesh)
    read, expected = ([*_numbers(each, section)] for each in (back, after))
    if len(read) != len(expected) or not all(
        math.isclose(one, other, rel_tol=_SAME, abs_tol=_NONE)
        for one, other in zip(read, expected, strict=True)
    ):
        raise InputError(
            f"{document.source}: values read back must be those written; write plate and ERAs as "
            "`era config init` does, and try again"
        )
    return text


Rows: TypeAlias = list[list[float]]


def _values(rig: Rig, section: RigSection) -> dict[KeyPath, Any]:
    """Values of a rig that a fit may change, by where its file has them, as it states them."""
    found: dict[KeyPath, Any] = {("uncertainty",): asdict(rig.uncertainty)}
    # New keys come first in their block.
    of_plate = section.plate.stated(rig.plate, rig.laminate)
    found |= {("plate", *path): value for path, value in of_plate.items()}
    for era in rig.eras:
        of_era = KINDS[type(era)].stated(era)
        found |= {("eras", era.name, key): value for key, value in of_era.items()}
    for name, number in zip(rig.foot_names, rig.feet, strict=True):
        found["supports", name, "stiffness"] = rig.masses[number].stiffness
    return found


def _restated(after: Rig) -> set[KeyPath]:
    """Where values are that are written in any case: others of the file would change them."""
    own: set[KeyPath] = {
        ("eras", era.name, key) for era in after.eras for key in KINDS[type(era)].instead
    }
    return {("plate", "loss_factor"), *own}


def _numbers(rig: Rig, section: RigSection) -> Iterator[float]:
    """Yield all numbers of a rig that are written."""
    # A file's own masses come before its supports, and those that were found after both.
    masses = sorted(
        rig.masses, key=lambda each: (each.stiffness > 0, round(each.x, 5), round(each.y, 5))
    )
    parts: list[Any] = [_values(rig, section), [(each.x, each.y, each.mass) for each in masses]]
    while parts:
        match parts.pop():
            case int() | float() as number:
                yield number
            case Mapping() as values:
                parts += values.values()
            case list() | tuple() as values:
                parts += values


def _put(data: CommentedMap, path: KeyPath, value: Any, rows: list[Rows]) -> None:
    """Set a value in the data of a file; rows of numbers are added to those given."""
    entry, key = data, path[-1]
    for part in path[:-1]:
        entry = entry[part]
    if key in ("gains", "modes"):
        rows.append(value)
        value = f"{_ROWS_OF}{len(rows) - 1}"
    if key == "material":
        given = entry[key]
        texts = {name: f"{value[name] / 1e9:.7g} GPa" for name in value if name[0] in "EG"}
        if isinstance(given, CommentedMap):
            given.update(texts)
            return
        by_frequency = known_material(given).by_frequency
        value |= texts | ({"by_frequency": by_frequency} if by_frequency else {})
    # A new key comes first in a block, where it separates no comment.
    if key in entry or entry.fa.flow_style():
        entry[key] = _flow(value)
    else:
        entry.insert(0, key, _flow(value))


def _flow(value: Any) -> Any:
    """A value of a file on one line, its numbers rounded."""
    rounded = _rounded(value)
    if not isinstance(rounded, dict | list):
        return rounded
    found = CommentedMap(rounded) if isinstance(rounded, dict) else CommentedSeq(rounded)
    found.fa.set_flow_style()
    return found


def _rounded(value: Any) -> Any:
    """A value with six digits of each of its numbers."""
    match value:
        case float():
            return float(f"{value:.6g}")
        case Mapping():
            return {key: _rounded(each) for key, each in value.items()}
        case list() | tuple():
            return [*map(_rounded, value)]
    return value


_SECTIONS = RigSection.model_fields.keys() - {"plate", "eras"}
"""Keys that are changed as a whole."""

_PLACED = {"eras", "masses", "supports"}
"""Those of what has a place on the plate."""

_OF_THEORY = PlateSection.model_fields.keys() - {*FOLLOWED_FIELDS, "modes"}
"""Keys of a plate that decide the modes to which its `modes` are relative."""

_REWRITTEN = ("plate", "mesh", "eras", "masses", "laminate", "uncertainty")
"""Fields of a rig that the text of a fitted one states."""


def checked_keys(source: str, section: type[Section], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of a section as data of a file; source: what is called with them. Raises ConfigError."""
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
    """Make a rig of a `Plate` and an `Era` for each name, as of a file with these sections.

    amplifiers: by default `{"main": {"url": "sim://"}}`, a simulated one, with the ERAs on its
    channels in order; uncertainty, fingertip: also an `Uncertainty` and a `Fingertip`, "none" for
    weightless fingers. What is left out, or None, has the file's default. Raises ConfigError with
    all problems, by argument and key.

    Example:
        >>> sheet = era.Plate(length=0.4, width=0.3, thickness="3 mm", material="aluminium")
        >>> places = {"SW": (0, 0), "SE": (0.4, 0), "NE": (0.4, 0.3), "NW": (0, 0.3)}
        >>> keys = {"stiffness": "15 kN/m", "stroke": "50 um"}
        >>> eras = {name: era.Era(at=at, **keys) for name, at in places.items()}
        >>> mine = era.rig(sheet, eras)
    """
    if amplifiers is None:
        expect(eras, Mapping, what="eras", made_by='{"SW": era.Era(at=(0, 0), stiffness=17e3)}')
        amplifiers = {"main": {"url": "sim://"}}
        wired = {name: {"amplifier": "main", "channel": n} for n, name in enumerate(eras)}
        eras = _merged(wired, eras)
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
    """Write a rig file that reads back as this rig: its file's text, or its keys.

    Values of a fitted rig, as of `calibrate`, are rounded. Raises InputError for a rig that no file
    states, OSError if the file cannot be written.

    Example:
        >>> era.save_rig(mine, "mine.yaml")
        >>> era.load_rig("mine.yaml").fingerprint == mine.fingerprint
        True
    """
    expect(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    place, document = expect_path(path, what="path"), stated(rig)
    check_ending(place, ".yaml", ".yml", what="a rig file")
    written = parse_document(str(place), document.text or data_text(document.data))
    rig_of(written)
    with whole_or_nothing(place) as stream:
        stream.write(written.text.encode())


def replaced(rig: Rig, changes: Mapping[str, Any]) -> Rig:
    """Make a rig with other keys, see `Rig.replaced`."""
    data: dict[str, Any] = {**stated(rig).data}
    for key in {"plate", "eras"} & changes.keys():
        expect(changes[key], Mapping, what=key, made_by='{"thickness": 0.002} or era.Era')
    of_plate = {key: each for key, each in changes.items() if key not in RigSection.model_fields}
    of_plate |= changes.get("plate", {})
    data["plate"] = _given({**data["plate"], **of_plate})
    if data["plate"].get("modes") and _OF_THEORY & of_plate.keys() and "modes" not in of_plate:
        raise InputError(
            "rig.replaced: plate.modes must be given with another plate, got those identified on "
            "this one; modes=None for the theory's"
        )
    read = Validation(_document("rig.replaced", data), RigSection).field
    factors = [
        (read(("plate", key), PlateSection) or own) / own
        for key, own in (("length", rig.plate.length), ("width", rig.plate.width))
    ]
    for kind in _PLACED & data.keys() if factors != [1, 1] else ():
        data[kind] = {
            name: {
                **each,
                "at": [f * quantity(x, LENGTH) for f, x in zip(factors, each["at"], strict=True)],
            }
            if "at" in each
            else each
            for name, each in data[kind].items()
        }
    eras = _merged(data["eras"], changes.get("eras", {}))
    whole = {key: changes[key] for key in _SECTIONS & changes.keys()}
    return rig_of(_document("rig.replaced", {**data, **whole, "eras": eras}))


def _merged(own: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Sections of which keys are changed, added, or left out, as whole sections are, by None."""
    sections = {**own, **changes}
    return _given(
        {
            name: _given({**own.get(name, {}), **each}) if isinstance(each, Mapping) else each
            for name, each in sections.items()
        }
    )


def stated(rig: Rig) -> Document:
    """A document that states a rig; raises InputError for one that was not made of keys.

    Of a rig that was fitted it has the plate, ERAs, masses and uncertainty, rounded.
    """
    document = rig.document
    if document is None:
        raise InputError("rig must be read from a file or made by era.rig, got one without keys")
    if rig_of(document) == rig:
        return document
    before = parse_document(document.source, document.text or data_text(document.data))
    text = rewritten_text(before, rig_of(document), rig, comment="Fitted")
    document = parse_document(document.source, text)
    if replace(rig_of(document), **{name: getattr(rig, name) for name in _REWRITTEN}) != rig:
        raise InputError(
            "rig must have other plate, ERAs, masses and uncertainty than its keys alone; change "
            "others by rig.replaced"
        )
    return document


def _document(source: str, keys: Mapping[str, Any]) -> Document:
    """The keys that a program gives, as data of a file."""
    return Document(
        source,
        "",
        to_jsonable_python(
            _given(keys),
            fallback=lambda each: each.tolist() if hasattr(each, "tolist") else repr(each),
        ),
        {},
    )


def _given(keys: Mapping[str, Any]) -> dict[str, Any]:
    """The keys that are not left out."""
    return {key: value for key, value in keys.items() if value is not None}
