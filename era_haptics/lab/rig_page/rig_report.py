"""Everything that the page of a rig shows, computed once."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from controller.rig_file_check import check_rig
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import Point
from model.config.document import Document
from model.errors import InputError
from model.finger import Grid
from model.processes import Progress
from model.reduction.supported_plate import SupportedModes
from model.rig.rig import Rig
from model.structure.statics import center_of_mass
from model.study.contrast_maps import ContrastMap, map_contrast
from model.study.overview import find_overview, summarize
from model.table.table import LocalizationTable
from model.table.table_file import cached_table
from model.vibration import damped_modes

FINGERS = (0.3, 0.35), (0.8, 0.6), (0.45, 0.85)
"""Positions of the example's fingers, as fractions of the plate's length and width."""

_MAP_CELLS = 400
_STEPS = 5


@dataclass(frozen=True, eq=False)
class RigReport:
    """A rig with its predictions."""

    rig: Rig
    source: str
    """Name of the rig file, without its folder."""
    sensors: Mapping[str, Point]
    """Positions of sensors [m] by name."""
    center: Point
    """Center of mass [m] of the plate with everything on it."""
    warnings: Sequence[str]
    """Findings of `era config check`."""
    table: LocalizationTable
    modes: SupportedModes
    summary: Mapping[str, Any]
    """Summary of the table, as `era table show --json` prints it."""
    answer: Answer | None
    """Three fingers with three vibrations; None if the plate is too small or too weak."""
    maps: Sequence[ContrastMap]
    """Contrast of a finger anywhere to one and to two other fingers; empty for small plates."""
    costs: Mapping[str, float]
    """Contrast [dB] that each tolerance costs, as `era config check` prints it, the most expensive
    first."""


def report_of(
    rig: Rig, document: Document, *, sensors: Mapping[str, Point], progress: Progress
) -> RigReport:
    """Compute the report of a rig and of the document that it was built from.

    Takes five seconds with sixteen ERAs. progress: called with the number of steps done and the
    total. Raises ConfigError for a rig that `era config check` rejects.
    """
    checked = check_rig(document)
    progress(1, _STEPS)
    table, _ = cached_table(rig)
    progress(2, _STEPS)
    summary = summarize(table, find_overview(table))
    progress(3, _STEPS)
    positions = [(u * rig.plate.length, v * rig.plate.width) for u, v in FINGERS]
    maps = _contrast_maps(table, positions[1:])
    progress(4, _STEPS)
    balance = checked.data.get("balance")
    center = center_of_mass(rig.plate) if balance is None else balance["centre_of_mass_m"]
    report = RigReport(
        rig=rig,
        source=document.source.rpartition("/")[2],
        sensors=sensors,
        center=center,
        warnings=checked.warnings,
        table=table,
        modes=damped_modes(rig),
        summary=summary,
        answer=_three_vibrations(table, positions),
        maps=maps,
        costs=checked.data.get("tolerance_costs_db", {}),
    )
    progress(_STEPS, _STEPS)
    return report


def _three_vibrations(table: LocalizationTable, positions: Sequence[Point]) -> Answer | None:
    """Query a table for a vibration at each position; None if there is none."""
    fingers = [Finger(position, Stimulus()) for position in positions]
    with suppress(InputError):  # the plate is too small for three fingers
        answered = answer(table, fingers)
        if answered.layers:
            return answered
    return None


def _contrast_maps(table: LocalizationTable, positions: Sequence[Point]) -> list[ContrastMap]:
    """Map the contrast to the first finger, and to both; empty if the plate is too small."""
    plate = table.plate
    cell_side = math.sqrt(plate.length * plate.width / _MAP_CELLS)
    grid = Grid(round(plate.length / cell_side), round(plate.width / cell_side))
    with suppress(InputError):
        return [map_contrast(table, positions[:count], grid=grid) for count in (1, 2)]
    return []
