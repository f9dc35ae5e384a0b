"""The answers that the control loop gives, and their replacement in one step.

A replacement is prepared before: by the estimator, and here, a frequency at a time, the onsets and
endings, whose shapes are taken over from the answers before until then.
"""

import asyncio

from controller.learning.messages import Answers
from controller.play.loop import Controller
from model.answer.answer_report import Timing
from model.errors import InputError
from model.table.table import LocalizationTable

_PAUSE = 0.02  # s; between frequencies, which take a millisecond or two each


class AnswersInUse:
    """The answers of a controller; table, timing: of the rig as built, with which it starts."""

    def __init__(self, controller: Controller, table: LocalizationTable, timing: Timing) -> None:
        self._controller = controller
        self._base = table, timing
        self.table, self._timing = table, timing

    def replace(self, answers: Answers) -> None:
        """Answer by a corrected table from now on; raises InputError for one of another table."""
        fingerprint = self._base[0].fingerprint
        if answers.base != fingerprint:
            raise InputError(f"answers must be those of table {fingerprint}, got {answers.base}")
        self._use(answers.table, self._timing.following(answers.table))

    def reset(self) -> None:
        """Answer by the table as built from now on."""
        self._use(*self._base)

    async def shape_anew(self) -> None:
        """Shape onsets and endings for the present table, while nothing is on its way."""
        timing, frequencies = Timing(self.table), self.table.frequencies.tolist()
        while frequencies:
            if not self._controller.cycle.is_preparing:
                timing.prepare([frequencies.pop()])
            await asyncio.sleep(_PAUSE)
        self._use(self.table, timing.following(self.table))

    def _use(self, table: LocalizationTable, timing: Timing) -> None:
        self.table, self._timing = table, timing
        self._controller.replace_answers(table, timing)
