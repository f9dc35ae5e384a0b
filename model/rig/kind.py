"""Rig files as a kind of configuration of `era config`."""

from typing import Any

from model.config.document import ConfigError, Document, Problem
from model.config.kinds import CheckedFile
from model.rig.amplifiers import check_amplifiers
from model.rig.file import example_rig_path, rig_of, rig_schema
from model.rig.rig import Rig
from model.rig.voltage_costs import voltage_costs
from model.structure.support import support_problem


class RigKind:
    """A rig file."""

    def recognises(self, document: Document) -> bool:
        """A rig has a plate."""
        return "plate" in document.data

    def check(self, document: Document) -> CheckedFile:
        """Check a rig and its amplifiers; return its values in a line, to show unlikely ones."""
        problems: list[Problem] = []
        rig = None
        try:
            rig = rig_of(document)
        except ConfigError as error:
            problems += error.problems
        wrong, warnings = check_amplifiers(document, rig)
        support = None if rig is None else support_problem(rig.plate, rig.eras, loads=rig.masses)
        if support is not None:
            problems.append(document.problem(("eras",), support))
        known = {problem.key for problem in problems}
        problems += [problem for problem in wrong if problem.key not in known]
        if rig is None or problems:
            raise ConfigError(document.source, problems)
        note = rig.uncertainty.note
        costs = voltage_costs(rig)
        return CheckedFile(_summary(rig), [*warnings, *costs, *([note] if note else [])])

    def example(self) -> str:
        """The paper's plate."""
        return example_rig_path().read_text(encoding="utf-8")

    def schema(self) -> dict[str, Any]:
        """The JSON schema for editors."""
        return rig_schema()


RIG = RigKind()


def _summary(rig: Rig) -> str:
    plate, laminate = rig.plate, rig.laminate
    thickness = plate.thickness if laminate is None else laminate.thickness
    sizes = " x ".join(f"{1e3 * size:g}" for size in (plate.length, plate.width, thickness))
    made_of = plate.material.name
    if laminate is not None:
        made_of = f"laminate ({', '.join(layer.material.name for layer in laminate.layers)})"
    parts = [
        f"{sizes} mm of {made_of}",
        f"mesh {rig.mesh}",
        f"ERAs {', '.join(era.name for era in rig.eras)}",
    ]
    if rig.supports:
        parts.append(f"supported without being driven by {', '.join(rig.supports)}")
    if carried := sum(mass.mass for mass in rig.masses):
        parts.append(f"carries {1e3 * carried:g} g")
    return f"good: {', '.join(parts)}"
