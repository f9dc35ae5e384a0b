"""Thorough answers: never less contrast at a lower level, or in a mode that contains another."""

from dataclasses import replace
from itertools import pairwise

import pytest

from model.errors import InputError
from model.rig.uncertainty import Uncertainty
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.table.thorough_query import LEVEL_STEP, query_thoroughly
from paper_table import contact_sets, smooth_table

NESTED = ("switched", "phased")
TOLERANCE = 0.1  # dB


def table(uncertainty: Uncertainty) -> LocalizationTable:
    """The paper's plate, as well known as that."""
    return replace(smooth_table(), uncertainty=uncertainty)


def answer(known: LocalizationTable, places: list[tuple[float, float]], level: float, mode: str):
    """The thorough answer for the first place beside the others."""
    question = Question((places[0],), tuple(places[1:]), level_db_sl=level, drive_mode=mode)
    return query_thoroughly(known, question)


def contrast(pattern: Pattern) -> float:
    """What nine of ten plates give."""
    assert pattern.robust_felt_contrast_db is not None
    return pattern.robust_felt_contrast_db


LEVELS = (24.0, 33.3, 36.0, 48.0)


@pytest.mark.long
@pytest.mark.parametrize("uncertainty", [Uncertainty.none(), Uncertainty()])
def test_contrast_falls_with_the_level_and_rises_with_the_mode(
    uncertainty: Uncertainty, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over random fingers, by a tenth of a decibel; each at its level on nine of ten plates."""
    monkeypatch.setattr("model.table.thorough_query.LEVEL_STEP", 12.0)
    known = table(uncertainty)
    for places in contact_sets(1, fingers=2, seed=70):
        found = {mode: [answer(known, places, level, mode) for level in LEVELS] for mode in NESTED}
        for patterns in found.values():
            for low, high in pairwise(patterns):
                assert contrast(low) >= contrast(high) - TOLERANCE
        for less, more in pairwise(NESTED):
            for one, other in zip(found[less], found[more], strict=True):
                assert contrast(other) >= contrast(one) - TOLERANCE
                assert other.drive_mode == more
        reached = [each.robust_level_db_sl for each in found["phased"]]
        assert reached == pytest.approx(LEVELS, abs=0.01)


def test_it_is_no_worse_than_the_live_answer() -> None:
    """At a multiple of the step."""
    known = table(Uncertainty())
    (places,) = contact_sets(1, fingers=3, seed=5)
    question = Question((places[0],), tuple(places[1:]), level_db_sl=45 * LEVEL_STEP)
    assert contrast(query_thoroughly(known, question)) >= contrast(known.query(question))


def test_a_level_that_cannot_be_reached_is_refused() -> None:
    """As the live answer does."""
    (places,) = contact_sets(1, fingers=2, seed=5)
    with pytest.raises(InputError):
        answer(table(Uncertainty()), places, 120.0, "phased")
