"""Rigs by the keys of a rig file that a program gives: made, changed, and written.

A rig keeps the keys that it was made of, so that what follows from one follows its change: the
damping of a ratio, a mesh that is chosen, the homogeneous plate that a laminate is like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from model.config.document import Document, data_text, parse_document
from model.config.fields import LENGTH, Section, Validation, quantity
from model.errors import InputError, expect, expect_path
from model.files.array_file import check_ending, whole_or_nothing
from model.rig.file import rig_of
from model.rig.rewritten import rewritten_text
from model.rig.rig import Rig
from model.rig.sections import PlateSection, RigSection

_SECTIONS = RigSection.model_fields.keys() - {"plate", "eras"}
"""Keys that are changed as a whole."""

_PLACED = {"eras", "masses", "supports"}
"""Those of what has a place on the plate."""

_OF_THEORY = {"length", "width", "thickness", "material", "grain", "layers", "bond", "air_gap"}
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
