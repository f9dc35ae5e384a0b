"""Text of a rig file with other values of the rig and unchanged comments and layout."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, TypeAlias

from ruamel.yaml.comments import CommentedMap, CommentedSeq

from model.config.document import Document, KeyPath, edited_text, parse_document
from model.errors import InputError
from model.rig.actuators import KINDS
from model.rig.file import rig_of
from model.rig.rig import Rig
from model.structure.materials import known_material
from model.structure.plate import Material

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
    rows: list[Rows] = []

    def change(data: CommentedMap) -> None:
        own = _values(before, document)
        for path, value in _values(after, document).items():
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
    read, expected = ([*_numbers(each, document)] for each in (back, after))
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


def _values(rig: Rig, document: Document) -> dict[KeyPath, Any]:
    """Values of a rig that a fit may change, by where its file has them, as it states them."""
    plate, layers = rig.plate, rig.laminate.layers if rig.laminate else ()
    found: dict[KeyPath, Any] = {("uncertainty",): asdict(rig.uncertainty)}
    # New keys come first in their block.
    stated: Any = document.data["plate"]
    whole = layers[0] if layers else plate  # a single layer of what depends on frequency
    for number, part in enumerate(layers) if "layers" in stated else ((None, whole),):
        path = ("plate",) if number is None else ("plate", "layers", number)
        found[*path, "material"] = _material(
            part.material, is_across=stated.get("grain") == "width"
        )
        found[*path, "thickness"] = part.thickness
    found["plate", "loss_factor"] = plate.loss_factor
    found["plate", "loss_exponent"] = plate.loss_exponent
    found["plate", "modes"] = [
        [math.exp(shift / 2), math.exp(loss)] for shift, loss in plate.mode_deviations
    ]
    for era in rig.eras:
        found["eras", era.name, "at"] = [era.x, era.y]
        for field, key in KINDS[type(era)].keys.items():
            found["eras", era.name, key] = getattr(era, field)
        found["eras", era.name, "gains"] = [[f, size, math.degrees(a)] for f, size, a in era.gains]
    for name, number in zip(rig.foot_names, rig.feet, strict=True):
        found["supports", name, "stiffness"] = rig.masses[number].stiffness
    return found


def _material(material: Material, *, is_across: bool) -> dict[str, Any]:
    """Numbers of a material as a file states them, whose grain may run across the plate."""
    along = material.turned() if is_across else material
    ratio = "nu" if material.orthotropy is None else "nu12"
    return {"name": material.name, **along.moduli, "rho": material.rho, ratio: along.nu}


def _restated(after: Rig) -> set[KeyPath]:
    """Where values are that are written in any case: others of the file would change them."""
    own: set[KeyPath] = {
        ("eras", era.name, key) for era in after.eras for key in KINDS[type(era)].instead
    }
    return {("plate", "loss_factor"), *own}


def _numbers(rig: Rig, document: Document) -> Iterator[float]:
    """Yield all numbers of a rig that are written."""
    # A file's own masses come before its supports, and those that were found after both.
    masses = sorted(
        rig.masses, key=lambda each: (each.stiffness > 0, round(each.x, 5), round(each.y, 5))
    )
    parts: list[Any] = [_values(rig, document), [(each.x, each.y, each.mass) for each in masses]]
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
