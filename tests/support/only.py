"""Fingers and answers of tests, and of an only vibration the layer and the first sensation."""

from collections.abc import Sequence
from typing import Any

from model.answer.answer import Answer, Layer, Sensation
from model.answer.plan import answer, query
from model.answer.stimulus import ANY, ANY_BAND, BY_NAME, Finger, Placement, Stimulus
from model.arrays import Point
from model.table.table import LocalizationTable
from model.vibration import Excitation


def only(
    table: LocalizationTable, placed: Placement, level_db_sl: float = 20.0, **more: Any
) -> tuple[Layer, Sensation]:
    """What is played for fingers, and what the first of them feels."""
    found = query(table, placed, level_db_sl, **more)
    return found.layers[0], found.fingers[0]


def wants(
    at: Point,
    band_hz: tuple[float, float] = ANY_BAND,
    level_db_sl: float = 20.0,
    priority: int = 0,
    *,
    may_share: bool = False,
    name: str | None = None,
    modulation_hz: float | None = None,
    **more: Any,
) -> Finger:
    """A finger that is to feel a stimulus of its own."""
    stimulus = Stimulus(level_db_sl, band_hz, modulation_hz=modulation_hz, name=name)
    sharing = ANY if may_share else BY_NAME
    return Finger(at, stimulus, priority=priority, sharing=sharing, **more)


def phased(
    table: LocalizationTable,
    fingers: Sequence[Finger],
    quiet: Sequence[Finger | Point] = (),
    **more: Any,
) -> Answer:
    """The answer in mode `phased`, whatever the table's own is."""
    return answer(table, fingers, quiet=quiet, **{"drive_mode": "phased"} | more)


def drives(found: Answer) -> list[Excitation]:
    """What plays for each finger, empty where nothing does."""
    numbers = [each.layer for each in found.fingers]
    return [{} if n is None else found.layers[n].excitation for n in numbers]
