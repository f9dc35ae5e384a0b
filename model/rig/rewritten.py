"""Text of a rig file with other values of the rig and unchanged comments and layout."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from model.config.document import Document, parse_document
from model.config.editing import edited_text
from model.errors import InputError
from model.rig.file import rig_of
from model.rig.rig import Rig
from model.structure.attachments import Gain
from model.structure.plate import Material

_PER_LINE = 4
_SAME = 1e-4  # relative; of phases and of what modes deviate, absolute
_SAME_PLACE = 1e-6  # m

# ruamel.yaml wraps long sequences anywhere, so rows replace placeholders in its text.
_ROWS_OF = "rows-of-"
_PLACEHOLDER = re.compile(
    rf"^(?P<start>(?P<indent> *).*(gains|modes):\s+){_ROWS_OF}(?P<what>\d+|modes)", re.MULTILINE
)


def rewritten_text(
    document: Document, before: Rig, after: Rig, *, comment: str, mesh: str | None = None
) -> str:
    """Return a rig file's text with the values of another rig of the same ERAs, after a comment.

    Written are plate, ERAs and uncertainty where they differ, and further masses after its own.
    mesh: that replaces the file's. Raises ConfigError if a comment of the file would be lost,
    InputError where the text, read as a rig, has other values.
    """

    def change(data: CommentedMap) -> None:
        _change_plate(data["plate"], before, after)
        for number, era in enumerate(after.eras):
            _change_era(data["eras"][era.name], number, before, after)
        own = len(before.masses)
        if len(after.masses) > own:
            masses = data.setdefault("masses", CommentedMap())
            for mass in after.masses[own:]:
                masses[_free_name(masses)] = _flow(
                    {"at": _sequence([mass.x, mass.y]), "mass": _rounded(mass.mass)}
                )
        if after.uncertainty != before.uncertainty:
            data["uncertainty"] = _flow(
                {key: _rounded(value) for key, value in asdict(after.uncertainty).items()}
            )

    def rows_text(match: re.Match[str]) -> str:
        indent = match["indent"]
        if match["what"] == "modes":
            rows = [
                f"[{math.exp(shift / 2):.7g}, {math.exp(loss):.5g}]"
                for shift, loss in after.plate.mode_deviations
            ]
        else:
            rows = _gain_rows(after.eras[int(match["what"])].gains)
        return match["start"] + _rows_text(rows, indent=indent)

    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    text = f"{lines}\n{_PLACEHOLDER.sub(rows_text, edited_text(document, change))}"
    back = rig_of(parse_document(document.source, text), mesh=mesh)
    read, expected = _numbers(back), _numbers(after)
    if len(read) != len(expected) or not all(map(_is_same, read, expected)):
        raise InputError(
            f"{document.source}: values read back must be those written; write plate and ERAs as "
            "`era config init` does, and try again"
        )
    return text


def _numbers(rig: Rig) -> list[tuple[float, float]]:
    """Values of a rig that are written, each with what counts as none of its quantity."""
    plate = rig.plate
    layers = rig.laminate.layers if rig.laminate else ()
    found = [(layer.material.E, 0.0) for layer in layers] or [(plate.material.E, 0.0)]
    found += [(each, 0.0) for each in (plate.thickness, plate.loss_factor, plate.loss_exponent)]
    found += [(part, _SAME) for pair in plate.mode_deviations for part in pair]
    found += [(each, 0.0) for each in asdict(rig.uncertainty).values()]
    for era in rig.eras:
        found += [(era.x, _SAME_PLACE), (era.y, _SAME_PLACE)]
        found += [(each, 0.0) for each in (era.stiffness, era.damping, era.bolt_mass)]
        for _, size, phase in era.gains:
            found += [(size, 0.0), (np.cos(phase), _SAME), (np.sin(phase), _SAME)]
    for mass in rig.masses:
        found += [(mass.x, _SAME_PLACE), (mass.y, _SAME_PLACE), (mass.mass, 0.0)]
    return found


def _is_same(read: tuple[float, float], expected: tuple[float, float]) -> bool:
    """Whether a value was read back as it was written."""
    return math.isclose(read[0], expected[0], rel_tol=_SAME, abs_tol=expected[1])


def _change_plate(data: CommentedMap, before: Rig, after: Rig) -> None:
    plate, own = after.plate, before.plate
    _set(data, {"loss_factor": _rounded(plate.loss_factor)})
    if plate.loss_exponent != own.loss_exponent:
        _set(data, {"loss_exponent": _rounded(plate.loss_exponent)})
    if plate.mode_deviations != own.mode_deviations:
        _set(data, {"modes": f"{_ROWS_OF}modes"})
    if plate.thickness != own.thickness:
        _set_thickness(data, before, plate.thickness)
    _set_modulus(data, before, after)


def _change_era(entry: CommentedMap, number: int, before: Rig, after: Rig) -> None:
    era = after.eras[number]
    own = before.era(era.name)
    # With another stiffness a ratio would be another damping.
    _rename(entry, "damping_ratio", "damping")
    if (era.x, era.y) != (own.x, own.y):
        _set(entry, {"at": _sequence([era.x, era.y])})
    _set(
        entry,
        {
            "stiffness": _rounded(era.stiffness),
            "damping": _rounded(era.damping),
            "bolt_mass": _rounded(era.bolt_mass),
        },
    )
    if era.gains and era != own:
        _set(entry, {"gains": f"{_ROWS_OF}{number}"})


def _gain_rows(gains: tuple[Gain, ...]) -> list[str]:
    """Rows of frequency [Hz], magnitude and phase [degrees]."""
    return [f"[{f:.9g}, {size:.5g}, {np.degrees(phase):.6g}]" for f, size, phase in gains]


def _rows_text(rows: Sequence[str], *, indent: str) -> str:
    """Rows in brackets, a few on each line."""
    joined = f",\n{indent}    ".join(
        ", ".join(rows[at : at + _PER_LINE]) for at in range(0, len(rows), _PER_LINE)
    )
    return f"[\n{indent}    {joined}]"


def _set_thickness(plate: CommentedMap, before: Rig, thickness: float) -> None:
    """Set the thickness [m] of a plate, of a laminate those of all layers by one factor."""
    if before.laminate is None:
        plate["thickness"] = _rounded(thickness)
        return
    factor = thickness / before.plate.thickness
    for entry, layer in zip(plate["layers"], before.laminate.layers, strict=True):
        entry["thickness"] = _rounded(factor * layer.thickness)


def _set_modulus(plate: CommentedMap, before: Rig, after: Rig) -> None:
    if before.laminate is None:
        _set_material(plate, before.plate.material, after.plate.material.E)
        return
    factor = after.plate.material.E / before.plate.material.E
    for entry, layer in zip(plate["layers"], before.laminate.layers, strict=True):
        _set_material(entry, layer.material, factor * layer.material.E)


def _set_material(entry: CommentedMap, material: Material, modulus: float) -> None:
    """Set the modulus [Pa] of a plate's or layer's material, writing out a named material."""
    text = f"{modulus / 1e9:.7g} GPa"
    if isinstance(entry["material"], CommentedMap):
        entry["material"]["E"] = text
        return
    entry["material"] = _flow(
        {"name": material.name, "E": text, "rho": material.rho, "nu": material.nu}
    )


def _free_name(masses: CommentedMap) -> str:
    """A name that no mass of the file has."""
    numbers = range(1, len(masses) + 2)
    return next(name for number in numbers if (name := f"found{number}") not in masses)


def _rename(mapping: CommentedMap, old: str, new: str) -> None:
    """Rename a key in its place."""
    if old in mapping:
        position = list(mapping).index(old)
        mapping.insert(position, new, mapping.pop(old))


def _set(mapping: CommentedMap, values: Mapping[str, Any]) -> None:
    """Set keys of a mapping; new ones come first in a block, where they separate no comment."""
    for key, value in values.items():
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
