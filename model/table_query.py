"""Questions to a table as JSON, and its answers."""

import time
from collections.abc import Iterable, Iterator
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.errors import InputError
from model.perception import STRONG_DB_SL
from model.question import Question
from model.robust import with_robust_contrast
from model.table import LocalizationTable

_Place = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Line(BaseModel):
    """What a line of a batch may hold."""

    model_config = ConfigDict(extra="forbid")

    target: _Place | None = None
    targets: list[_Place] = []
    quiet: list[_Place] = []
    mode: str | None = None
    level_db_sl: float = STRONG_DB_SL
    eras_at_most: int = 2


def question_from_json(line: str) -> Question:
    """The question of one line, `{"target": [x, y], "quiet": [[x, y], ...], "mode": ...}`.

    Several targets: `"targets": [[x, y], ...]`; also `"level_db_sl"` and `"eras_at_most"`. Raises
    InputError.
    """
    try:
        asked = _Line.model_validate_json(line)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{where or 'line'}: {first['msg']}") from None
    targets = [*([] if asked.target is None else [asked.target]), *asked.targets]
    return Question(
        targets=tuple((x, y) for x, y in targets),
        quiet=tuple((x, y) for x, y in asked.quiet),
        level_db_sl=asked.level_db_sl,
        mode=asked.mode,
        eras_at_most=asked.eras_at_most,
    )


def answer_as_json(table: LocalizationTable, question: Question) -> dict[str, Any]:
    """The answer with all its measures; solve_time_s is that of the pattern, without robustness.

    A table that has been prepared answers as it does while fingers wait.
    """
    started = time.perf_counter()
    pattern = table.ask(question)
    elapsed = time.perf_counter() - started
    pattern = with_robust_contrast(table, question, pattern)
    return {
        "drive": table.drive_of(pattern.excitation),
        "mode": pattern.mode,
        "level_db_sl": pattern.level_db_sl,
        "contrast_db": pattern.contrast_db,
        "contrast_db_sl": pattern.contrast_db_sl,
        "robust_contrast_db": pattern.robust_contrast_db,
        "transient_contrast_db": pattern.transient_contrast_db,
        "surroundings_contrast_db": pattern.surroundings_contrast_db,
        "quiet_level_db_sl": pattern.quiet_level_db_sl,
        "quiet_is_unaware": pattern.quiet_is_unaware,
        "usable_level_db_sl": pattern.usable_level_db_sl,
        "ramp_s": pattern.ramp,
        "solve_time_s": elapsed,
    }


def answer_lines(table: LocalizationTable, lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """An answer for every line that is not empty; `{"error": ..., "line": n}` where it has none."""
    table.prepare()
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            yield answer_as_json(table, question_from_json(line))
        except InputError as error:
            yield {"error": str(error), "line": number}
