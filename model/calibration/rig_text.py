"""A rig file with new values in it, and everything else, comments too, as its author wrote it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import brentq

from model.calibration.calibration_result import Calibration
from model.config.document import KeyPath
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era, Gain
from model.structure.laminate import Laminate, equivalent_plate
from model.structure.plate import Material

_PER_LINE = 4  # gains


@dataclass(frozen=True)
class _Splice:
    """Text that takes the place of what stands from start to stop."""

    start: int
    stop: int
    text: str


def calibrated_text(text: str, before: Rig, calibration: Calibration, *, comment: str) -> str:
    """The rig file's text with a calibration's values, the comment's lines above it."""
    after = calibration.rig
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    splices = [*_plate_splices(root, before, after)]
    for era in after.eras:
        node = _at(root, ("eras", era.name))
        values = {
            "stiffness": f"{era.stiffness:.6g}",
            "damping": f"{era.damping:.6g}",
            "bolt_mass": f"{era.bolt_mass:.6g}",
        }
        if era.gains and era != before.era(era.name):
            values["gains"] = _gains_text(era.gains, indent=" " * (_column(node) + 2))
        # A ratio would go on meaning another damping once the stiffness has changed.
        splices += _set(node, values, instead={"damping": "damping_ratio"})
    for splice in sorted(splices, key=lambda splice: -splice.start):
        text = text[: splice.start] + splice.text + text[splice.stop :]
    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    return f"{lines}\n{text}"


def check_reads_back(rig: Rig, expected: Calibration, path: Path) -> None:
    """Raise InputError unless a rig that was read from its new file is the calibrated one."""
    wanted = expected.rig

    def numbers(one: Rig) -> list[float]:
        plate = [one.plate.material.E, one.plate.loss_factor]
        return plate + [v for era in one.eras for v in _numbers_of(era)]

    # The absolute part is for numbers near zero: 1 mg, 1 µN s/m, a millionth of a gain.
    read, fitted = numbers(rig), numbers(wanted)
    if len(read) != len(fitted) or not np.allclose(read, fitted, rtol=1e-4, atol=1e-6):
        raise InputError(
            f"{path}: the new values could not be put into the rig file as it is written; write "
            "its plate and ERAs in the way of `era config init` and calibrate again"
        )


def _numbers_of(era: Era) -> list[float]:
    gains = [part for _, size, phase in era.gains for part in (size, np.cos(phase), np.sin(phase))]
    return [era.stiffness, era.damping, era.bolt_mass, *gains]


def _plate_splices(root: yaml.Node | None, before: Rig, after: Rig) -> list[_Splice]:
    plate = _at(root, ("plate",))
    splices = _set(plate, {"loss_factor": f"{after.plate.loss_factor:.6g}"})
    if before.laminate is not None:
        factor = _layer_factor(before, before.laminate, wanted=after.plate.material.E)
        layers = _entry(plate, "layers")
        for node, layer in zip(layers.value, before.laminate.layers, strict=True):
            splices += _modulus_splices(_entry(node, "material"), layer.material, factor)
        return splices
    factor = after.plate.material.E / before.plate.material.E
    node = _entry(plate, "material")
    return splices + _modulus_splices(node, before.plate.material, factor)


def _modulus_splices(node: yaml.Node, material: Material, factor: float) -> list[_Splice]:
    text = f"{factor * material.E / 1e9:.7g} GPa"
    if isinstance(node, yaml.MappingNode):
        return _set(node, {"E": text})
    whole = f"{{name: {material.name}, E: {text}, rho: {material.rho:g}, nu: {material.nu:g}}}"
    return [_Splice(node.start_mark.index, node.end_mark.index, whole)]


def _layer_factor(rig: Rig, laminate: Laminate, *, wanted: float) -> float:
    """By how much every layer's modulus must grow for the equivalent plate to have this one."""

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


def _gains_text(gains: tuple[Gain, ...], *, indent: str) -> str:
    rows = [f"[{f:.9g}, {size:.5g}, {np.degrees(phase):.6g}]" for f, size, phase in gains]
    lines = [", ".join(rows[at : at + _PER_LINE]) for at in range(0, len(rows), _PER_LINE)]
    joined = f",\n{indent}  ".join(lines)
    return f"[\n{indent}  {joined}]"


def _set(
    mapping: yaml.MappingNode,
    values: Mapping[str, str],
    *,
    instead: Mapping[str, str] | None = None,
) -> list[_Splice]:
    """Splices that give keys of a mapping new values; those that it lacks are put in.

    instead: by key, another one whose place it takes where that stands there.
    """
    splices, added = [], []
    for key, text in values.items():
        found = _find(mapping, key) or _find(mapping, (instead or {}).get(key, key))
        if found:
            start, stop = found[0].start_mark.index, _end(found[1])
            splices.append(_Splice(start, stop, f"{key}: {text}"))
        else:
            added.append(f"{key}: {text}")
    if added and mapping.flow_style:
        stop = mapping.value[-1][1].end_mark.index
        splices.append(_Splice(stop, stop, ", ".join(["", *added])))
    elif added:
        start = mapping.value[0][0].start_mark.index
        splices.append(_Splice(start, start, f"\n{' ' * _column(mapping)}".join([*added, ""])))
    return splices


def _at(root: yaml.Node | None, path: KeyPath) -> yaml.MappingNode:
    """The mapping at a path of keys of a rig file that has been read already; KeyError for none."""
    node = root
    for key in path:
        node = _entry(node, str(key))
    if not isinstance(node, yaml.MappingNode):
        raise KeyError(path)
    return node


def _entry(mapping: yaml.Node | None, key: str) -> yaml.Node:
    found = _find(mapping, key) if isinstance(mapping, yaml.MappingNode) else None
    if found is None:
        raise KeyError(key)
    return found[1]


def _find(mapping: yaml.MappingNode, key: str) -> tuple[yaml.Node, yaml.Node] | None:
    for name, value in mapping.value:
        if name.value == key:
            return name, value
    return None


def _end(node: yaml.Node) -> int:
    """Where a value ends; that of a block ends after its last line's end, which must stay."""
    last = node
    while isinstance(last, yaml.CollectionNode) and not last.flow_style and last.value:
        entry = last.value[-1]
        last = entry[1] if isinstance(entry, tuple) else entry
    return int(last.end_mark.index)


def _column(mapping: yaml.MappingNode) -> int:
    return int(mapping.value[0][0].start_mark.column)
