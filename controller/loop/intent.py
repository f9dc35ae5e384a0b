"""Who wants to feel what: the seam between what touches mean and how that is played.

Whoever gives touches a meaning says which contacts shall feel it and how strongly; all others on
the plate are kept quiet. The rest, from the table to the wire, does not know why.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from controller.sources.contacts import Contact, ContactKey
from model.finger.perception import STRONG_DB_SL

_SHORTEST_WAIT = 0.001  # s

NO_CONTACTS = "nobody touches the plate"


@dataclass(frozen=True, slots=True)
class Target:
    """A contact that shall feel something.

    level_db_sl: how strongly; None for as strongly as the neighbours allow. Among targets with a
    level one without feels it as the strongest of them does. or_less: where the plate cannot reach
    the level, as strongly as the neighbours allow instead of nothing.
    """

    key: ContactKey
    level_db_sl: float | None = STRONG_DB_SL
    or_less: bool = False


@dataclass(frozen=True)
class HapticIntent:
    """What is wanted now.

    targets: each contact once; those that are not on the plate are left out. reason: why there are
    none. until: when [s] the intent may be another though no contact has changed; None for never.
    """

    targets: tuple[Target, ...]
    reason: str = "nobody is to feel anything"
    until: float | None = None

    def due(self, now: float) -> float | None:
        """When [s] to ask again; an intent that has run out already does not keep the loop busy."""
        if self.until is None:
            return None
        return self.until if self.until > now else now + _SHORTEST_WAIT


class IntentSource(Protocol):
    """Where intents come from; queried when contacts change and when an intent expires."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """The intent for contacts in their order of arrival, at a time [s]; must return at once.

        What it raises silences all channels for as long as it does.
        """


class NewestBuzzes:
    """The newest contact buzzes where it is, and nobody else feels it.

    When it lifts, all is silent until the next contact comes.
    """

    def __init__(self, level_db_sl: float | None = STRONG_DB_SL) -> None:
        self._level = level_db_sl
        self._seen: frozenset[ContactKey] = frozenset()
        self._target: ContactKey | None = None

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """The newest contact if it is new, or else the target that was, while it is down."""
        keys = [contact.key for contact in contacts]
        if keys and keys[-1] not in self._seen:
            self._target = keys[-1]
        elif self._target not in keys:
            self._target = None
        self._seen = frozenset(keys)
        if self._target is not None:
            return HapticIntent((Target(self._target, self._level),))
        return HapticIntent((), "the target was lifted" if keys else NO_CONTACTS)
