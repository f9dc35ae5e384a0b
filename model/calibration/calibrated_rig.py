"""Text of a rig file with calibrated values and unchanged comments and layout."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml.comments import CommentedMap
from scipy.optimize import brentq

from model.calibration.calibration_result import Calibration
from model.config.document import Document
from model.config.editing import edited_text
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era, Gain
from model.structure.laminate import Laminate, equivalent_plate
from model.structure.plate import Material

_GAINS_PER_LINE = 4

# ruamel.yaml wraps long sequences anywhere, so gains replace placeholders in its text.
_GAINS_OF = "gains-of-"
_PLACEHOLDER = re.compile(
    rf"^(?P<start>(?P<indent> *).*gains: ){_GAINS_OF}(?P<era>\d+)", re.MULTILINE
)


def calibrated_text(
    document: Document, before: Rig, calibration: Calibration, *, comment: str
) -> str:
    """Return a rig file's text with calibrated values, headed by a comment.

    Raises ConfigError if a comment of the file would be lost.
    """
    after = calibration.rig

    def change(data: CommentedMap) -> None:
        _set(data["plate"], {"loss_factor": _rounded(after.plate.loss_factor)})
        _set_modulus(data["plate"], before, after.plate.material.E)
        for number, era in enumerate(after.eras):
            entry = data["eras"][era.name]
            # With another stiffness a ratio would be another damping.
            _rename(entry, "damping_ratio", "damping")
            _set(
                entry,
                {
                    "stiffness": _rounded(era.stiffness),
                    "damping": _rounded(era.damping),
                    "bolt_mass": _rounded(era.bolt_mass),
                },
            )
            if era.gains and era != before.era(era.name):
                _set(entry, {"gains": f"{_GAINS_OF}{number}"})

    def gains_text(match: re.Match[str]) -> str:
        return match["start"] + _gains_text(
            after.eras[int(match["era"])].gains, indent=match["indent"]
        )

    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    text = edited_text(document, change)
    return f"{lines}\n{_PLACEHOLDER.sub(gains_text, text)}"


def check_reads_back(rig: Rig, expected: Calibration, path: Path) -> None:
    """Raise InputError unless a rig read from its new file has the calibrated values."""

    def numbers(one: Rig) -> list[float]:
        plate = [one.plate.material.E, one.plate.loss_factor]
        return plate + [v for era in one.eras for v in _numbers_of(era)]

    # The absolute part is for numbers near zero: 1 mg, 1 µN s/m, a millionth of a gain.
    read, fitted = numbers(rig), numbers(expected.rig)
    if len(read) != len(fitted) or not np.allclose(read, fitted, rtol=1e-4, atol=1e-6):
        raise InputError(
            f"{path}: values read back must be the calibrated ones; write plate and ERAs as "
            "`era config init` does and calibrate again"
        )


def _numbers_of(era: Era) -> list[float]:
    gains = [part for _, size, phase in era.gains for part in (size, np.cos(phase), np.sin(phase))]
    return [era.stiffness, era.damping, era.bolt_mass, *gains]


def _gains_text(gains: tuple[Gain, ...], *, indent: str) -> str:
    """Rows of frequency [Hz], magnitude and phase [degrees], a few on each line."""
    rows = [f"[{f:.9g}, {size:.5g}, {np.degrees(phase):.6g}]" for f, size, phase in gains]
    lines = [
        ", ".join(rows[at : at + _GAINS_PER_LINE]) for at in range(0, len(rows), _GAINS_PER_LINE)
    ]
    joined = f",\n{indent}    ".join(lines)
    return f"[\n{indent}    {joined}]"


def _set_modulus(plate: CommentedMap, before: Rig, modulus: float) -> None:
    if before.laminate is None:
        _set_material(plate, before.plate.material, modulus)
        return
    factor = _layer_factor(before, before.laminate, wanted=modulus)
    for entry, layer in zip(plate["layers"], before.laminate.layers, strict=True):
        _set_material(entry, layer.material, factor * layer.material.E)


def _set_material(entry: CommentedMap, material: Material, modulus: float) -> None:
    """Set the modulus [Pa] of a plate's or layer's material, writing out a named material."""
    text = f"{modulus / 1e9:.7g} GPa"
    if isinstance(entry["material"], CommentedMap):
        entry["material"]["E"] = text
        return
    numbers = CommentedMap(
        {"name": material.name, "E": text, "rho": material.rho, "nu": material.nu}
    )
    numbers.fa.set_flow_style()
    entry["material"] = numbers


def _layer_factor(rig: Rig, laminate: Laminate, *, wanted: float) -> float:
    """Factor on the moduli of all layers for which the equivalent plate has a modulus [Pa]."""

    def excess(factor: float) -> float:
        layers = tuple(
            replace(layer, material=replace(layer.material, E=factor * layer.material.E))
            for layer in laminate.layers
        )
        plate = equivalent_plate(
            replace(laminate, layers=layers), length=rig.plate.length, width=rig.plate.width
        )
        return plate.material.E / wanted - 1

    return float(brentq(excess, 0.1, 10.0, xtol=1e-9))


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


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
