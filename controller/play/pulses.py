"""Short pulses: each is chosen alone, and never changed, since it would be over before."""

import math
from collections.abc import Iterable

from controller.play.intent import Targets
from controller.play.selected_contents import Selection
from controller.sources.touch import ContactKey


class ChosenPulses:
    """The selections of short pulses that are active, or have not started yet."""

    def __init__(self) -> None:
        self._by_finger: dict[ContactKey, Selection] = {}

    @property
    def selections(self) -> tuple[Selection, ...]:
        """The selection of each pulse."""
        return tuple(self._by_finger.values())

    def take(self, selection: Selection) -> None:
        """Add the selection of a pulse."""
        contact, _ = selection.targets[0]
        self._by_finger[contact.key] = selection

    def keep_requested(self, requested: Targets) -> None:
        """Drop the selections of pulses that are no longer requested."""
        kept = dict[ContactKey, Selection]()
        for contact, target in requested:
            selection = self._by_finger.get(contact.key)
            if selection is not None and selection.targets[0].target == target:
                kept[contact.key] = selection
        self._by_finger = kept

    def new_among(self, requested: Targets) -> Targets:
        """Return the requested pulses that have not been chosen yet."""
        return tuple([finger for finger in requested if finger.contact.key not in self._by_finger])

    def active_at(self, now: float) -> tuple[Selection, ...]:
        """Return the selections of pulses that have not ended at a time [s]."""
        active = list[Selection]()
        for selection in self._by_finger.values():
            if any(now < pulse.end for pulse in selection.pulses):
                active.append(selection)
        return tuple(active)


def last_end(selections: Iterable[Selection]) -> float:
    """Return when [s] the last pulse of some selections ends."""
    ends = list[float]()
    for selection in selections:
        for pulse in selection.pulses:
            ends.append(pulse.end)
    return max(ends, default=-math.inf)
