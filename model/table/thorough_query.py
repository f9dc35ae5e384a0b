"""Answers that are never worse at a lower level, or in a drive mode that allows more.

A live answer looks at a few candidates, and so may miss what it would find for a higher level or
with fewer weights. Contrasts do not depend on how loud a pattern plays: every answer to a higher
level, and of every mode within the one that is asked for, is one to this question, turned down.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.table.pattern import Pattern
from model.table.pattern_query import UnreachableLevel
from model.table.question import MAX_LEVEL_DB_SL, Question
from model.table.table import LocalizationTable

LEVEL_STEP = 1.0
"""Levels [dB SL] at which a table is asked are multiples of this."""

_ROUNDING = 1e-3  # dB


def query_thoroughly(table: LocalizationTable, question: Question) -> Pattern:
    """Find the pattern of the highest robust felt contrast among answers to this level and higher.

    In the drive mode of the question and all that it contains; takes some tenths of a second. A
    level between two multiples of LEVEL_STEP is asked as the higher one, where it can be reached.
    Without quiet fingers as `table.query`. Raises InputError as that does.
    """
    if not question.quiet:
        return table.query(question)
    drive_mode = question.drive_mode_on(table.drive_mode)
    level = question.level_db_sl
    best: Pattern | None = None
    for mode in DRIVE_MODES[: 1 + DRIVE_MODES.index(drive_mode)]:
        for pattern in _louder(table, replace(question, drive_mode=mode)):
            robust = pattern.robust_level_db_sl
            if robust is None or robust < level - _ROUNDING:
                continue
            if best is None or _contrast(pattern) > _contrast(best):
                best = replace(pattern.scaled(min(level - robust, 0.0)), drive_mode=drive_mode)
    return table.query(question) if best is None else best


def _louder(table: LocalizationTable, question: Question) -> Iterator[Pattern]:
    """Answers of a drive mode at the levels of the raster from that of a question on."""
    level = LEVEL_STEP * math.ceil(question.level_db_sl / LEVEL_STEP - _ROUNDING)
    while level <= MAX_LEVEL_DB_SL:
        try:
            yield table.query(replace(question, level_db_sl=level))
        except UnreachableLevel as error:
            if error.reachable_db_sl >= question.level_db_sl:
                yield table.query(replace(question, level_db_sl=error.reachable_db_sl))
            return
        except InputError:
            return
        level += LEVEL_STEP


def _contrast(pattern: Pattern) -> float:
    contrast = pattern.robust_felt_contrast_db
    return -math.inf if contrast is None else contrast
