"""What a layout gives on fresh contact sets: the answers of its localization table."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import FloatArray, IntArray
from model.finger.perception import STRONG_DB_SL
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.pattern_choice import UnreachableLevel
from model.table.question import Question
from model.table.table import LocalizationTable

_LEVEL_MARGIN = 0.1  # dB


@dataclass(frozen=True, eq=False)
class Judged:
    """Answers at contact sets (s,): robust felt contrast [dB], robust level [dB SL] at the target.

    quiet (s,): numbers of quiet fingers.
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
        """Share of the sets whose target nine of ten plates give the wanted level."""
        return float((self.level_db_sl >= STRONG_DB_SL - _LEVEL_MARGIN).mean())


def judge(rig: Rig, sets: Sequence[FloatArray]) -> Judged:
    """Query a rig's table in mode phased at contact sets (fingers, 2) [m], target first.

    For the level STRONG_DB_SL, where it cannot be reached for the highest found. Raises InputError
    for ERAs that do not support the plate.
    """
    table = build_table(rig, drive_mode="phased")
    rows = [_answer(table, contacts) for contacts in sets]
    quiet = np.array([len(contacts) - 1 for contacts in sets])
    contrast, level = np.array(rows).T
    return Judged(quiet, contrast, level)


def _answer(table: LocalizationTable, contacts: FloatArray) -> tuple[float, float]:
    target, *quiet = [(float(x), float(y)) for x, y in contacts]
    question = Question((target,), tuple(quiet))
    try:
        pattern = table.query(question)
    except UnreachableLevel as error:
        pattern = table.query(replace(question, level_db_sl=error.reachable_db_sl))
    contrast = pattern.robust_felt_contrast_db
    assert contrast is not None  # noqa: S101  a set has a quiet finger
    return contrast, pattern.robust_level_db_sl or pattern.level_db_sl
