"""What fingers shall feel without a layout: the newest one a buzz, until it lifts."""

from collections.abc import Sequence

from controller.play.intent import NO_CONTACTS, HapticIntent, Target
from controller.sources.touch import Contact, ContactKey
from model.finger import STRONG_DB_SL


class BuzzNewestContact:
    """Targets the newest contact; after it lifts, none until the next one."""

    def __init__(self, level_db_sl: float | None = STRONG_DB_SL) -> None:
        self._level = level_db_sl
        self._seen: frozenset[ContactKey] = frozenset()
        self._target: ContactKey | None = None

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Target the newest contact if it is new, else the previous target while it is down."""
        keys = [contact.key for contact in contacts]
        if keys and keys[-1] not in self._seen:
            self._target = keys[-1]
        elif self._target not in keys:
            self._target = None
        self._seen = frozenset(keys)
        if self._target is not None:
            return HapticIntent((Target(self._target, self._level),))
        return HapticIntent((), "the target was lifted" if keys else NO_CONTACTS)
