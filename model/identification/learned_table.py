"""A table that learns its plate: settled patterns in, corrected answers out.

Answers follow the plate as it is known after each pattern. From an alarm on they wait for its
explanation. Where the plate has changed in a way that its parameters do not follow they become
those of the plate as last known, with errors as wide as those of a plate that nobody measured,
until it is again as it was.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from model.errors import InputError
from model.identification.in_service import LivePlate, PatternReport, PlateEstimate, widest
from model.identification.learned_file import LearnedPlate, OtherPlate, load_learned, save_learned
from model.identification.settled import SettledPattern
from model.rig.rig import Rig
from model.table.following import table_following
from model.table.table import LocalizationTable


@dataclass(frozen=True, eq=False)
class LearningStep:
    """What a pattern has led to: its report, and the table from now on, None for the same."""

    report: PatternReport
    table: LocalizationTable | None


class LearnedTable:
    """A table in service, corrected by what its plate shows.

    table: of the rig as known when service began, never changed; file: where what is learned is
    kept, None for nowhere.
    """

    def __init__(
        self, table: LocalizationTable, known: PlateEstimate, *, file: Path | None = None
    ) -> None:
        self._table, self._file = table, file
        self.live = LivePlate(known)
        self.current = table
        """The table as corrected so far."""

    @classmethod
    def resumed(cls, table: LocalizationTable, known: PlateEstimate, *, file: Path) -> Self:
        """A table with what was learned of it before, if its file is there.

        Raises InputError for another kind of file, OtherPlate for one of another table or of other
        parameters.
        """
        if not file.exists():
            return cls(table, known, file=file)
        learned = load_learned(file, table=table.fingerprint)
        space = known.model.space
        if learned.names != space.names or learned.base != known.before.fingerprint:
            raise OtherPlate(
                f"{file}: parameters must be those of this rig and its sensors; remove the file to "
                "learn anew"
            )
        known = replace(known, state=learned.state, time=None, change=learned.change)
        resumed = cls(table, known, file=file)
        resumed.current = resumed._followed()
        return resumed

    @property
    def change(self) -> str:
        """How the plate has changed in a way that its parameters do not follow, or nothing."""
        return self.live.known.change

    def take(self, pattern: SettledPattern) -> LearningStep:
        """Take a settled pattern, and correct the table by it.

        Raises InputError or another ValueError for a pattern that leads to no plate that a table
        can follow; the state then is that before, and what was suspect of it is forgotten.
        """
        if not np.isfinite(pattern.values).all() or not np.any(pattern.values):
            raise InputError("readings must be finite and not all 0, got others")
        before = self.live.known
        try:
            report = self.live.take(pattern)
            state, change = self.live.known.state, self.live.known.change
            if not np.isfinite(state.x).all() or not np.isfinite(state.covariance).all():
                raise InputError("parameters must be finite after a pattern, got others")
            if state is before.state and bool(change) == bool(before.change):
                return LearningStep(report, None)
            self.current = self._followed()
        except Exception:
            self.live = LivePlate(before)
            raise
        return LearningStep(report, self.current)

    def _followed(self) -> LocalizationTable:
        """The table for the plate as it is known now."""
        return table_following(
            self._table, self.cautious_rig if self.change else self.live.known.rig
        )

    def save(self) -> None:
        """Write what was learned, atomically, and whether the plate has changed since."""
        if self._file is None:
            return
        known = self.live.known
        learned = LearnedPlate(
            self._table.fingerprint,
            known.before.fingerprint,
            known.model.space.names,
            known.state,
            known.change,
        )
        save_learned(learned, self._file)

    @property
    def cautious_rig(self) -> Rig:
        """The rig as last known, with the errors of a plate that was not measured."""
        rig = self.live.known.rig
        return replace(rig, uncertainty=widest(rig.uncertainty))
