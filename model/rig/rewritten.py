"""Text of a rig file with other values of the rig and unchanged comments and layout."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from model.config.document import Document, KeyPath, parse_document
from model.config.editing import edited_text
from model.errors import InputError
from model.rig.actuators import KINDS
from model.rig.file import rig_of
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.materials import known_material
from model.structure.plate import Material

_Written: TypeAlias = "float | tuple[Any, ...] | Material | Uncertainty"

_PER_LINE = 4
_SAME = 1e-4  # relative; of phases and of what modes deviate, absolute
_SAME_PLACE = 1e-6  # m

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
    rows: list[list[str]] = []

    def change(data: CommentedMap) -> None:
        own = _values(before, document)
        for path, value in _values(after, document).items():
            if value != own[path] or path in _restated(after):
                _put(data, path, value, rows)
        for era in after.eras:
            _drop_replaced(data["eras"][era.name], KINDS[type(era)].instead)
        for mass in after.masses[len(before.masses) :]:
            masses = data.setdefault("masses", CommentedMap())
            masses[_free_name(masses)] = _flow(
                {"at": _sequence([mass.x, mass.y]), "mass": _rounded(mass.mass)}
            )

    def rows_text(match: re.Match[str]) -> str:
        return match["start"] + _rows_text(rows[int(match["number"])], indent=match["indent"])

    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    text = f"{lines}\n{_PLACEHOLDER.sub(rows_text, edited_text(document, change))}"
    back = rig_of(parse_document(document.source, text), mesh=mesh)
    read, expected = ([*_numbers(each, document)] for each in (back, after))
    if len(read) != len(expected) or not all(
        math.isclose(one, other, rel_tol=_SAME, abs_tol=none)
        for (one, _), (other, none) in zip(read, expected, strict=True)
    ):
        raise InputError(
            f"{document.source}: values read back must be those written; write plate and ERAs as "
            "`era config init` does, and try again"
        )
    return text


def _values(rig: Rig, document: Document) -> dict[KeyPath, _Written]:
    """Values of a rig that a fit may change, by where its file has them."""
    plate, layers = rig.plate, rig.laminate.layers if rig.laminate else ()
    found: dict[KeyPath, _Written] = {("uncertainty",): rig.uncertainty}
    # New keys come first in their block.
    stated: Any = document.data["plate"]
    if "layers" in stated:
        for number, layer in enumerate(layers):
            found["plate", "layers", number, "material"] = layer.material
            found["plate", "layers", number, "thickness"] = layer.thickness
    else:
        whole = layers[0] if layers else plate  # a single layer of what depends on frequency
        found["plate", "material"], found["plate", "thickness"] = whole.material, whole.thickness
    found["plate", "loss_factor"] = plate.loss_factor
    found["plate", "loss_exponent"] = plate.loss_exponent
    found["plate", "modes"] = plate.mode_deviations
    for era in rig.eras:
        found["eras", era.name, "at"] = (era.x, era.y)
        for field, key in KINDS[type(era)].keys.items():
            found["eras", era.name, key] = getattr(era, field)
    for name, number in zip(rig.foot_names, rig.feet, strict=True):
        found["supports", name, "stiffness"] = rig.masses[number].stiffness
    return found


def _restated(rig: Rig) -> set[KeyPath]:
    """Where values are that are written in any case: others of the file would change them."""
    kinds = [(era.name, KINDS[type(era)]) for era in rig.eras]
    own = {("eras", name, key) for name, kind in kinds for key in kind.restated}
    return {("plate", "loss_factor"), *own}


def _drop_replaced(entry: CommentedMap, instead: Mapping[str, tuple[str, ...]]) -> None:
    """Remove keys in whose place others have been written."""
    for key, others in instead.items():
        for other in others if key in entry else ():
            entry.pop(other, None)


def _numbers(rig: Rig, document: Document) -> Iterator[tuple[float, float]]:
    """Values of a rig that are written, each with what counts as none of its quantity."""
    for path, value in _values(rig, document).items():
        match value:
            case Material():
                yield from ((each, 0.0) for each in value.moduli.values())
            case Uncertainty():
                yield from ((each, 0.0) for each in asdict(value).values())
            case tuple() if path[-1] == "at":
                yield from ((each, _SAME_PLACE) for each in value)
            case tuple() if path[-1] == "modes":
                yield from ((each, _SAME) for pair in value for each in pair)
            case tuple():
                for _, size, phase in value:
                    yield from ((size, 0.0), (math.cos(phase), _SAME), (math.sin(phase), _SAME))
            case _:
                yield value, 0.0
    # A file's own masses come before its supports, and those that were found after both.
    for mass in sorted(rig.masses, key=lambda each: (each.stiffness, round(each.x, 5), each.y)):
        yield from ((mass.x, _SAME_PLACE), (mass.y, _SAME_PLACE), (mass.mass, 0.0))


def _put(data: CommentedMap, path: KeyPath, value: _Written, rows: list[list[str]]) -> None:
    """Set a value in the data of a file; rows of numbers are added to those given."""
    entry, key = data, path[-1]
    for part in path[:-1]:
        entry = entry[part]
    if key == "damping":
        # With another stiffness a ratio would be another damping.
        _rename(entry, "damping_ratio", "damping")
    match value:
        case Material():
            _set_material(entry, value)
        case Uncertainty():
            entry[key] = _flow({name: _rounded(each) for name, each in asdict(value).items()})
        case tuple() if key == "at":
            _set(entry, key, _sequence(value))
        case tuple():
            text = _mode_rows if key == "modes" else _gain_rows
            rows.append(text(value))
            _set(entry, key, f"{_ROWS_OF}{len(rows) - 1}")
        case _:
            _set(entry, key, _rounded(value))


def _mode_rows(deviations: Sequence[tuple[float, float]]) -> list[str]:
    """Rows of natural frequency and loss factor, relative to the plate's theory."""
    return [f"[{math.exp(shift / 2):.7g}, {math.exp(loss):.5g}]" for shift, loss in deviations]


def _gain_rows(gains: Sequence[tuple[float, float, float]]) -> list[str]:
    """Rows of frequency [Hz], magnitude and phase [degrees]."""
    return [f"[{f:.9g}, {size:.5g}, {np.degrees(phase):.6g}]" for f, size, phase in gains]


def _rows_text(rows: Sequence[str], *, indent: str) -> str:
    """Rows in brackets, a few on each line."""
    joined = f",\n{indent}    ".join(
        ", ".join(rows[at : at + _PER_LINE]) for at in range(0, len(rows), _PER_LINE)
    )
    return f"[\n{indent}    {joined}]"


def _set_material(entry: CommentedMap, material: Material) -> None:
    """Set the moduli of a plate's or layer's material, writing out a named material."""
    along_grain = material.turned() if entry.get("grain") == "width" else material
    moduli = {key: f"{each / 1e9:.7g} GPa" for key, each in along_grain.moduli.items()}
    given = entry["material"]
    if isinstance(given, CommentedMap):
        given.update(moduli)
        return
    ratio = "nu" if material.orthotropy is None else "nu12"
    numbers = {"name": material.name, **moduli, "rho": material.rho, ratio: along_grain.nu}
    if rows := known_material(given).by_frequency:
        numbers["by_frequency"] = [list(map(_rounded, row)) for row in rows]
    entry["material"] = _flow(numbers)


def _free_name(masses: CommentedMap) -> str:
    """A name that no mass of the file has."""
    numbers = range(1, len(masses) + 2)
    return next(name for number in numbers if (name := f"found{number}") not in masses)


def _rename(mapping: CommentedMap, old: str, new: str) -> None:
    """Rename a key in its place."""
    if old in mapping:
        position = list(mapping).index(old)
        mapping.insert(position, new, mapping.pop(old))


def _set(mapping: CommentedMap, key: str | int, value: object) -> None:
    """Set a key of a mapping; a new one comes first in a block, where it separates no comment."""
    if key in mapping or mapping.fa.flow_style():
        mapping[key] = value
    else:
        mapping.insert(0, key, value)


def _flow(values: Mapping[str, Any]) -> CommentedMap:
    """A mapping on one line."""
    mapping = CommentedMap(values)
    mapping.fa.set_flow_style()
    return mapping


def _sequence(values: Sequence[float]) -> CommentedSeq:
    """Numbers on one line."""
    sequence = CommentedSeq(map(_rounded, values))
    sequence.fa.set_flow_style()
    return sequence


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
