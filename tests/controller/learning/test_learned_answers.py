"""Answers that are replaced: only those of the table that plays, in one step."""

from dataclasses import replace
from typing import cast

import pytest

from controller.learning.answers_in_use import AnswersInUse
from controller.learning.messages import Answers
from controller.loop.loop import Controller
from model.errors import InputError
from model.table.table import LocalizationTable
from model.table.timing import Timing
from small_table import small_table


class Taking:
    """A controller that keeps what it answers by."""

    def __init__(self) -> None:
        self.taken: list[LocalizationTable] = []

    def replace_answers(self, table: LocalizationTable, timing: Timing | None) -> None:
        """Note a table."""
        self.taken.append(table)


def test_answers_of_another_table_are_refused() -> None:
    """By its fingerprint, and nothing is replaced; those of the own one are, and can be reset."""
    base, controller = small_table(), Taking()
    in_use = AnswersInUse(cast(Controller, controller), base, None)
    other = replace(base, masses=(), eras=base.eras[::-1])
    with pytest.raises(InputError, match="table"):
        in_use.replace(Answers(other.fingerprint, other, is_complete=True))
    assert controller.taken == []
    own = replace(base)
    in_use.replace(Answers(base.fingerprint, own, is_complete=False))
    in_use.reset()
    assert controller.taken == [own, base]
