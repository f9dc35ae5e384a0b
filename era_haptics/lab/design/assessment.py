"""Full evaluation of a layout: answers of its table at contact sets."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray, IntArray, Point
from model.finger import STRONG_DB_SL
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table

_LEVEL_MARGIN = 0.1  # dB


@dataclass(frozen=True, eq=False)
class Assessment:
    """Answers for contact sets (s,), with the promised felt contrast [dB] of the worst finger.

    quiet (s,): number of quiet fingers; level_db_sl (s,): promised level of the weakest content.
    """

    quiet: IntArray
    contrast_db: FloatArray
    level_db_sl: FloatArray

    def __repr__(self) -> str:
        return f"<Assessment of {len(self.quiet)} sets: {self.mean_db:.1f} dB>"

    @property
    def mean_db(self) -> float:
        """Mean contrast [dB]; every number of quiet fingers has the same weight."""
        means = [self.contrast_db[self.quiet == quiet].mean() for quiet in self.kinds]
        return float(np.mean(means))

    @property
    def kinds(self) -> list[int]:
        """Numbers of quiet fingers, ascending."""
        return [int(quiet) for quiet in np.unique(self.quiet)]

    def median_db(self, quiet: int) -> float:
        """Median contrast [dB] with a number of quiet fingers."""
        return float(np.median(self.contrast_db[self.quiet == quiet]))

    @property
    def summary(self) -> dict[str, float]:
        """Return mean and medians [dB] for JSON."""
        medians = {f"median_{quiet}_quiet": self.median_db(quiet) for quiet in self.kinds}
        return {"mean": self.mean_db, **medians}

    @property
    def reached_share(self) -> float:
        """Fraction of the sets in which all contents reach their level on 90 % of plates."""
        is_reached = self.level_db_sl >= STRONG_DB_SL - _LEVEL_MARGIN
        return float(is_reached.mean())


def assess(rig: Rig, sets: Sequence[FloatArray], *, contents: int = 1) -> Assessment:
    """Answer contact sets (fingers, 2) [m], fingers with contents first, with a rig's table.

    Contents are at STRONG_DB_SL, or at the highest level found if that cannot be reached; none is
    shared or held back. Raises InputError for ERAs that do not support the plate.
    """
    table = build_table(rig)
    answers = [_answer_set(table, contacts, contents) for contacts in sets]
    contrasts, levels = np.array(answers).T
    quiet_counts = [len(contacts) - contents for contacts in sets]
    return Assessment(np.array(quiet_counts), contrasts, levels)


def _answer_set(
    table: LocalizationTable, contacts: FloatArray, contents: int
) -> tuple[float, float]:
    """Return the promised contrast [dB] and the level of the weakest content [dB SL]."""
    positions: list[Point] = [(x, y) for x, y in contacts.tolist()]
    fingers = [Finger(position, Stimulus()) for position in positions[:contents]]
    result = answer(table, fingers, quiet=positions[contents:], min_contrast_db=-math.inf)
    assert result.promised_worst_db is not None  # noqa: S101  a set has two fingers
    levels = [sensation.promised_level_db_sl for sensation in result.fingers[:contents]]
    return result.promised_worst_db, min(levels)
