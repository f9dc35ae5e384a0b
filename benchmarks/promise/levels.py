"""Promises with gains that depend on the level: `python -m benchmarks.promise levels`.

Two contents of 14 dB SL on plates that are solved exactly, drawn within the tolerances. Gains have
been identified at full level; a tenth of it changes every ERA's gain by 10 % and its phase by 3°,
as hysteresis does, or a half of this. Answers ignore it, or count it by `uncertainty.level`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
from benchmarks.promise.weather import contrasts_on, promised_and_kept
from model.answer.answer import Answer
from model.arrays import ComplexArray, FloatArray, Point
from model.rig.rig_file import load_rig
from model.study.exact_plates import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Excitation

PHASE_DEG = 30.0
"""Change of the phase relative to that of the gain."""


def run(sets: int, plates: int) -> None:
    """Print a row for each rig and size of the change."""
    print("| gain by level | ignored: promised, kept | counted: promised, kept |\n|---|---|---|")
    for label, name, is_identified in (
        ("4 ERAs default", "paper_plate", False),
        ("4 ERAs identified", "paper_plate", True),
        ("12 ERAs identified", "car_display", True),
    ):
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        if is_identified:
            rig = replace(rig, uncertainty=IDENTIFIED)
        ignoring = build_table(rig, drive_mode="phased", frequencies=np.arange(40.0, 321.0, 10.0))
        for size in (0.05, 0.1):
            counting = replace(ignoring, uncertainty=replace(rig.uncertainty, level=size))
            cells = [
                _promised_and_kept(table, size, sets, plates) for table in (ignoring, counting)
            ]
            print(f"| {100 * size:g} % a decade, {label} | {' | '.join(cells)} |", flush=True)


def _promised_and_kept(table: LocalizationTable, size: float, sets: int, plates: int) -> str:
    def gains(excitation: Excitation) -> ComplexArray:
        return _gains_at(table, excitation, size)

    def felt(rng: np.random.Generator, best: Answer, positions: Sequence[Point]) -> FloatArray:
        drawn = draw_plates(rng, table.uncertainty, count=plates, of=table, contact_count=2)
        return contrasts_on(table, best, positions, drawn, gains)

    return promised_and_kept(table, sets, felt)


def _gains_at(table: LocalizationTable, excitation: Excitation, size: float) -> ComplexArray:
    """Return the gain (eras,) of each ERA at its level, relative to full level."""
    gains = np.ones(len(table.eras), dtype=complex)
    for number, era in enumerate(table.eras):
        tone = excitation.get(era.name)
        if tone is None or not tone.amplitude:
            continue
        decades = np.log10(tone.amplitude / era.full_level)
        gains[number] = (1 + size * decades) * np.exp(-1j * np.radians(PHASE_DEG * size) * decades)
    return gains
