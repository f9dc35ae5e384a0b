"""A table that learns its plate: settled patterns in, corrected answers out.

Answers follow the plate as it is known after each pattern. From an alarm on they wait for its
explanation. Where the plate has changed in a way that its parameters do not follow they become
those of the plate as last known, with errors as wide as those of a plate that nobody measured,
until it is again as it was.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from model.identification.in_service import Known, LivePlate, Report, widest
from model.identification.learned_file import LearnedPlate, OtherPlate, load_learned, save_learned
from model.identification.settled import SettledPattern
from model.rig.rig import Rig, physics_fingerprint
from model.table.live_table import table_following
from model.table.table import LocalizationTable


@dataclass(frozen=True, eq=False)
class Learned:
    """What a pattern has led to: its report, and the table from now on, None for the same."""

    report: Report
    table: LocalizationTable | None


class LearnedTable:
    """A table in service, corrected by what its plate shows.

    table: of the rig as known when service began, never changed; file: where what is learned is
    kept, None for nowhere.
    """

    def __init__(self, table: LocalizationTable, known: Known, *, file: Path | None = None) -> None:
        self._table, self._file = table, file
        self.live = LivePlate(known)
        self.current = table
        """The table as corrected so far."""

    @classmethod
    def resumed(cls, table: LocalizationTable, known: Known, *, file: Path) -> Self:
        """A table with what was learned of it before, if its file is there.

        Raises InputError for a file that is none, OtherPlate for one of another table or of other
        parameters.
        """
        if not file.exists():
            return cls(table, known, file=file)
        learned = load_learned(file, table=table.fingerprint)
        space = known.model.space
        if learned.names != space.names or learned.base != physics_fingerprint(known.before):
            raise OtherPlate(
                f"{file}: parameters must be those of this rig and its sensors; remove the file to "
                "learn anew"
            )
        resumed = cls(table, replace(known, state=learned.state), file=file)
        resumed.current = table_following(table, resumed.live.rig)
        return resumed

    @property
    def has_changed(self) -> bool:
        """Whether the plate has changed in a way that its parameters do not follow."""
        return self.live.has_changed

    def take(self, pattern: SettledPattern) -> Learned:
        """Take a settled pattern, and correct the table by it."""
        before, had_changed = self.live.state, self.has_changed
        report = self.live.take(pattern)
        if self.has_changed and not had_changed:
            self.current = table_following(self._table, self.cautious_rig)
        elif self.live.state is not before:
            self.current = table_following(self._table, self.live.rig)
        else:
            return Learned(report, None)
        return Learned(report, self.current)

    def save(self) -> None:
        """Write what was learned, atomically; nothing of a plate that has changed unexplained."""
        if self._file is None or self.has_changed:
            return
        base = physics_fingerprint(self.live.before)
        learned = LearnedPlate(
            self._table.fingerprint, base, self.live.space.names, self.live.state
        )
        save_learned(learned, self._file)

    @property
    def cautious_rig(self) -> Rig:
        """The rig as last known, with the errors of a plate that was not measured."""
        rig = self.live.rig
        return replace(rig, uncertainty=widest(rig.uncertainty))
