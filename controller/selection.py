"""From contacts to what is felt: who is the target, who must feel nothing, and by which pattern."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from controller.contacts import Contact
from model.errors import InputError
from model.pattern import Pattern
from model.perception import STRONG_DB_SL

# Fields vary over a good part of a bending wavelength, 17 cm and more below 500 Hz; a fingertip
# that moved by less than its own radius is still within the disc it was chosen for.
MOVE_TOLERANCE = 0.008


class PatternTable(Protocol):
    """What selection needs of a localization table."""

    def answer(
        self,
        target: tuple[float, float],
        *,
        quiet: Sequence[tuple[float, float]] = (),
        level_db_sl: float = STRONG_DB_SL,
    ) -> Pattern:
        """The best pattern for a target and quiet contacts [m]; raises InputError."""


@dataclass(frozen=True)
class Selection:
    """What was chosen: for whom, who must feel nothing, and the pattern.

    Contacts stand where they were when it was chosen. Without a pattern all is silent, and reason
    says why.
    """

    target: Contact | None
    quiet: tuple[Contact, ...]
    pattern: Pattern | None
    reason: str | None


NOBODY = Selection(None, (), None, "nobody touches the plate")


class Selector:
    """Chooses a pattern for the contacts on a plate that has no surface layout.

    The newest contact is the target, all others are quiet. When the target lifts, all is silent
    until the next contact comes. A pattern stays while no contact has moved more than 8 mm from
    where it was chosen for; a quiet contact that lifts leaves it as it is, since less is asked of
    it then and a change would be felt.
    """

    def __init__(self, table: PatternTable, *, level_db_sl: float = STRONG_DB_SL) -> None:
        self._table = table
        self._level = level_db_sl
        self._current = NOBODY
        self._seen: frozenset[tuple[str, int]] = frozenset()

    def select(self, contacts: tuple[Contact, ...]) -> Selection:
        """The selection for contacts in their order of arrival; the same object if it stays."""
        target = self._target(contacts)
        quiet = tuple(contact for contact in contacts if contact is not target)
        self._seen = frozenset(contact.key for contact in contacts)
        if not self._holds(target, quiet):
            self._current = self._choose(target, quiet)
        return self._current

    def _target(self, contacts: tuple[Contact, ...]) -> Contact | None:
        """Whom to drive: the newest contact if it is new, or else the target that was."""
        if contacts and contacts[-1].key not in self._seen:
            return contacts[-1]
        old = self._current.target
        return next((contact for contact in contacts if old and contact.key == old.key), None)

    def _holds(self, target: Contact | None, quiet: tuple[Contact, ...]) -> bool:
        """Whether what was chosen for contacts elsewhere still serves."""
        current = self._current
        if target is None or current.target is None:
            return target is current.target and bool(quiet) == bool(current.quiet)
        then = {contact.key: contact for contact in (current.target, *current.quiet)}
        now = {contact.key: contact for contact in (target, *quiet)}
        same = now.keys() <= then.keys() if current.pattern else now.keys() == then.keys()
        return (
            target.key == current.target.key
            and same
            and all(
                math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
                for key, contact in now.items()
            )
        )

    def _choose(self, target: Contact | None, quiet: tuple[Contact, ...]) -> Selection:
        """Ask the table."""
        if target is None:
            return Selection(None, quiet, None, "the target was lifted") if quiet else NOBODY
        try:
            pattern = self._table.answer(
                (target.x, target.y),
                quiet=[(contact.x, contact.y) for contact in quiet],
                level_db_sl=self._level,
            )
        except InputError as error:
            return Selection(target, quiet, None, str(error))
        return Selection(target, quiet, pattern, None)
