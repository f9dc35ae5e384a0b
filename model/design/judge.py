"""What a layout gives on fresh contact sets: the answers of its localization table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, IntArray
from model.finger.perception import STRONG_DB_SL
from model.rig.rig import Rig
from model.table.answer import answer
from model.table.build import build_table
from model.table.request import Finger, Request
from model.table.table import LocalizationTable

_LEVEL_MARGIN = 0.1  # dB


@dataclass(frozen=True, eq=False)
class Judged:
    """Answers at contact sets (s,): robust felt contrast [dB] of the worst finger.

    quiet (s,): numbers of quiet fingers; level_db_sl (s,): robust level of the weakest content.
    """

    quiet: IntArray
    contrast_db: FloatArray
    level_db_sl: FloatArray

    @property
    def mean_db(self) -> float:
        """Mean contrast, each number of quiet fingers counting the same."""
        return float(np.mean([self.contrast_db[self.quiet == k].mean() for k in self.kinds]))

    @property
    def kinds(self) -> list[int]:
        """Numbers of quiet fingers, ascending."""
        return [int(each) for each in np.unique(self.quiet)]

    def median_db(self, quiet: int) -> float:
        """Median contrast with a number of quiet fingers."""
        return float(np.median(self.contrast_db[self.quiet == quiet]))

    @property
    def summary(self) -> dict[str, float]:
        """Mean and medians [dB] for JSON."""
        return {"mean": self.mean_db} | {f"median_{k}_quiet": self.median_db(k) for k in self.kinds}

    @property
    def reached_share(self) -> float:
        """Share of the sets whose contents have the level on nine of ten plates."""
        return float((self.level_db_sl >= STRONG_DB_SL - _LEVEL_MARGIN).mean())


def judge(rig: Rig, sets: Sequence[FloatArray], *, contents: int = 1) -> Judged:
    """What a rig's table answers at contact sets (fingers, 2) [m], fingers with contents first.

    For contents of STRONG_DB_SL, where it cannot be reached for the highest found, none of which is
    shared or held back. Raises InputError for ERAs that do not support the plate.
    """
    table = build_table(rig, drive_mode="phased")
    contrast, level = np.array([_answer(table, contacts, contents) for contacts in sets]).T
    quiet = np.array([len(contacts) - contents for contacts in sets])
    return Judged(quiet, contrast, level)


def _answer(table: LocalizationTable, contacts: FloatArray, contents: int) -> tuple[float, float]:
    places = [(float(x), float(y)) for x, y in contacts]
    requests = [Request(at) for at in places[:contents]]
    fingers = [Finger(at) for at in places[contents:]]
    found = answer(table, requests, fingers, min_contrast_db=-math.inf)
    assert found.promised_worst_db is not None  # noqa: S101  a set has two fingers
    level = min(layer.promised_level_db_sl for layer in found.layers)
    return found.promised_worst_db, level
