"""Promises by drive mode, and of a finger that is alone: `python -m benchmarks.promise modes`.

A vibration with one to three quiet fingers, of 14 and 24 dB SL in several bands, is answered in
both drive modes. A finger that is alone gets 20 dB SL in wide and narrow bands; the median level
over the drawn plates is compared with the promised one.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.promise.cases import EXAMPLES, RIGS, Case, Point
from benchmarks.setting import random_contacts
from model.answer.answer import Answer
from model.answer.fingers_on_plate import DriveTones, FingersOnPlate
from model.answer.plan import answer, query
from model.answer.promise import drawn_percentile
from model.answer.stimulus import Finger, Placement, Stimulus
from model.ensemble.draws import PROMISED_DRAWS
from model.finger import FINGERTIP_RADIUS, decibels
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table

NARROW_BANDS = [
    (frequency, frequency) for frequency in (40.0, 60.0, 80.0, 130.0, 170.0, 200.0, 300.0)
]
BANDS = [*NARROW_BANDS, (40.0, 60.0), (40.0, 100.0), (40.0, 320.0)]
LEVELS_DB_SL = (14.0, 24.0)
SAME_DB = 0.05
ALONE_BANDS = ((100.0, 300.0), (150.0, 250.0), (180.0, 220.0), (200.0, 200.0))
EXCITERS = "weekend/rig"


@dataclass(frozen=True)
class _Setting:
    """A table with its name, and a generator of fingers on its plate."""

    name: str
    table: LocalizationTable
    rng: np.random.Generator

    def fingers(self, count: int) -> list[Point]:
        """Draw the positions of fingers."""
        size = (self.table.plate.length, self.table.plate.width)
        drawn = random_contacts(self.rng, count, size, margin=FINGERTIP_RADIUS + 0.001)
        return [(float(x), float(y)) for x, y in drawn]


def run(sets: int) -> None:
    """Print a row for each rig, first of both drive modes, then of a finger alone."""
    rigs = [Case("", name, is_identified=is_identified) for name, is_identified in RIGS]
    print("| rig | phased promises less | at most [dB] | phased promises more, mean [dB] |")
    print("|---|---|---|---|")
    for case in rigs:
        setting = _Setting(case.title.lstrip(", "), case.table, np.random.default_rng(5))
        print(f"| {setting.name} | {_compared(setting, sets)} |", flush=True)
    bands = [f"{low:g} to {high:g} Hz" for low, high in ALONE_BANDS]
    print(f"\n| alone: median above promised level [dB] | {' | '.join(bands)} |")
    print("|---" * (1 + len(bands)) + "|")
    tables = {case.title.lstrip(", "): case.table for case in rigs}
    frequencies = np.arange(100.0, 301.0, 10.0)
    exciters = load_rig(EXAMPLES / f"{EXCITERS}.yaml")
    tables["4 exciters"] = build_table(exciters, drive_mode="phased", frequencies=frequencies)
    for name, table in tables.items():
        setting = _Setting(name, table, np.random.default_rng(7))
        cells = [_median_above_promise(setting, band, 2 * sets) for band in ALONE_BANDS]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _compared(setting: _Setting, sets: int) -> str:
    gains = []
    for _ in range(sets):
        for quiet in (1, 2, 3):
            target, *others = setting.fingers(1 + quiet)
            placed = Placement((target,), tuple(others))
            for level in LEVELS_DB_SL:
                gains += [_gain(setting.table, placed, level, band) for band in BANDS]
    lost = np.maximum(-np.array(gains), 0)
    share = np.count_nonzero(lost > SAME_DB)
    return f"{share} of {len(gains)} | {lost.max():.1f} | {np.mean(gains):.1f}"


def _gain(
    table: LocalizationTable, placed: Placement, level_db_sl: float, band_hz: tuple[float, float]
) -> float:
    """Return the gain of `phased` [dB]; zero if `switched` is further below the level."""
    phased, switched = (
        query(table, placed, level_db_sl, drive_mode=mode, band_hz=band_hz)
        for mode in ("phased", "switched")
    )
    if switched.fingers[0].lowered_db > phased.fingers[0].lowered_db:
        return 0.0
    assert phased.promised_worst_db is not None
    assert switched.promised_worst_db is not None
    return phased.promised_worst_db - switched.promised_worst_db


def _median_above_promise(setting: _Setting, band_hz: tuple[float, float], count: int) -> str:
    differences = []
    for _ in range(count):
        finger = Finger(setting.fingers(1)[0], Stimulus(20.0, band_hz))
        alone = answer(setting.table, [finger], drive_mode="phased")
        differences.append(_spread(setting.table, alone))
    return f"{np.median(differences):.1f} ({np.percentile(differences, 90):.1f})"


def _spread(table: LocalizationTable, alone: Answer) -> float:
    """Return how far the median level of drawn plates is above the promised level [dB]."""
    contents, tones = alone.contents, alone.tones
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    drive = DriveTones.of([[(tones.rows[0], np.array(tones.weights[0], dtype=np.complex64))]])
    means, _ = fingers.felt(PROMISED_DRAWS, drive)
    felt = means[0, 0]
    return float(decibels(drawn_percentile(felt, 50) / drawn_percentile(felt)))
