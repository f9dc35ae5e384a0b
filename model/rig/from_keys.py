"""Rigs by the keys of a rig file that a program gives: made, changed, and as text.

A rig keeps the keys that it was made of, so that what follows from one follows its change: the
damping of a ratio, a mesh that is chosen, the homogeneous plate that a laminate is like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from typing import Any

from model.config.document import Document, parse_document
from model.config.editing import data_text
from model.config.sections import Validation
from model.config.units import LENGTH, quantity
from model.errors import InputError
from model.rig.file import rig_of
from model.rig.rewritten import rewritten_text
from model.rig.rig import Rig
from model.rig.sections import PlateSection, RigSection

_REWRITTEN = {"plate", "mesh", "eras", "masses", "laminate", "uncertainty"}
"""Fields of a rig that the text of a fitted one states."""

_OF_THEORY = {"length", "width", "thickness", "material", "layers", "bond", "air_gap"}
"""Keys of a plate that decide the modes to which its `modes` are relative."""


_SECTIONS = RigSection.model_fields.keys() - {"plate"}
"""Keys that are given as a whole."""


def plain_data(value: Any) -> Any:
    """Keys that a program gives as data of a file: without None, dataclasses and arrays."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): plain_data(each) for key, each in value.items() if each is not None}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain_data(each) for each in value]
    return value


def keys_of(source: str, keys: Mapping[str, Any]) -> Document:
    """The document of keys that a program gives; source: what it calls with them."""
    return Document(source, "", plain_data(keys), {})


def replaced(rig: Rig, changes: Mapping[str, Any]) -> Rig:
    """Make a rig with other keys, see `Rig.replaced`."""
    whole = {key: value for key, value in changes.items() if key in _SECTIONS}
    data: dict[str, Any] = {**stated(rig).data, **whole}
    of_plate = {key: value for key, value in changes.items() if key not in whole}
    if data["plate"].get("modes") and _OF_THEORY & of_plate.keys() and "modes" not in of_plate:
        raise InputError(
            "rig.replaced: plate.modes must be given with another plate, got those identified on "
            "this one; modes=None for the theory's"
        )
    data = plain_data({**data, "plate": {**data["plate"], **of_plate}})
    document = Document("rig.replaced", "", data, {})
    validation = Validation(document, RigSection)
    sides = {"length": rig.plate.length, "width": rig.plate.width}
    read = {key: validation.field(("plate", key), PlateSection) for key in sides}
    factors = [(read[key] or own) / own for key, own in sides.items()]
    for kind in {"eras", "masses"} - whole.keys() if factors != [1, 1] else ():
        for section in data.get(kind, {}).values():
            at = zip(factors, section["at"], strict=True)
            section["at"] = [factor * quantity(place, LENGTH) for factor, place in at]
    return rig_of(document)


def stated(rig: Rig) -> Document:
    """A document that states a rig; raises InputError for one that was not made of keys.

    Of a rig that was fitted those of its plate, ERAs, masses and uncertainty, rounded.
    """
    document = rig.document
    if document is None:
        raise InputError("rig must be read from a file or made by era.rig, got one without keys")
    before = rig_of(document)
    if before == rig:
        return document
    text = rewritten_text(
        parse_document(document.source, document.text or data_text(document.data)),
        before,
        rig,
        comment="Fitted",
    )
    made = parse_document(document.source, text)
    back = rig_of(made)
    for name in (each.name for each in fields(rig) if each.compare):
        if name not in _REWRITTEN and getattr(back, name) != getattr(rig, name):
            raise InputError(f"rig must have the {name} of its file; use rig.replaced")
    return made


def rig_text(rig: Rig) -> str:
    """The text of a rig's file: as it was read, or its keys."""
    document = stated(rig)
    return document.text or data_text(document.data)
