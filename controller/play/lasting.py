"""The lasting contents of all fingers, which are chosen together."""

import math

from controller.play.continuity import is_met_by
from controller.play.crossfades import RESTS_AFTER, is_due
from controller.play.intent import FADED_AFTER
from controller.play.pulses import last_end
from controller.play.selected_contents import NOTHING, Question, Selection
from controller.sources.touch import ContactKey


class LastingContents:
    """The lasting contents as chosen, and the fingers that still want them.

    Contents that were chosen while pulses were active have only the limits that the pulses left.
    They are chosen again once the pulses have faded.
    """

    def __init__(self) -> None:
        self.chosen = NOTHING
        """The selection as chosen, also for fingers that have left since."""
        self.limits_end_at = math.inf
        """When [s] the pulses that limit these contents have faded; infinite without any."""
        self._arrivals: dict[ContactKey, float] = {}
        """When [s] the fingers of lasting targets came down."""

    @property
    def felt(self) -> Selection:
        """The contents of the fingers that still want them."""
        return self.chosen.restricted(self._arrivals.keys())

    @property
    def holds_back_a_finger(self) -> bool:
        """Whether a finger that wants a content feels none."""
        return any(finger.contact.key in self._arrivals for finger in self.chosen.unserved)

    def are_limits_over(self, now: float) -> bool:
        """Whether the pulses that limit these contents have faded at a time [s]."""
        return self.chosen.is_limited and is_due(self.limits_end_at, now)

    def drop(self) -> None:
        """Forget the contents, so that others are chosen."""
        self.chosen = NOTHING

    def take(self, selection: Selection, question: Question) -> None:
        """Take the selection for a question."""
        self.chosen = selection
        self.limits_end_at = math.inf
        if selection.is_limited:
            self.limits_end_at = last_end(question.kept) + FADED_AFTER

    def put_limits_off(self, now: float) -> None:
        """Put off a choice without limits that is due, because the thread is busy."""
        if is_due(self.limits_end_at, now):
            self.limits_end_at = now + RESTS_AFTER

    def note_limits(self, now: float) -> None:
        """Note that a choice without limits is due only once."""
        if is_due(self.limits_end_at, now):
            self.limits_end_at = math.inf

    def follow_fingers(self, intended: Question) -> None:
        """Drop the content of fingers that have left and come back elsewhere."""
        former_arrivals = self._arrivals
        self._arrivals = {}
        returned = set[ContactKey]()
        for contact, _ in intended.lasting:
            self._arrivals[contact.key] = contact.since
            is_new = former_arrivals.get(contact.key) != contact.since
            if is_new and contact.key in self.chosen.target_keys:
                returned.add(contact.key)
        if returned and not is_met_by(intended, self.chosen):
            self.chosen = self.chosen.restricted(self.chosen.target_keys - returned)
