"""Changes of fingers that wait for a plan, from which the latency of the plan counts."""

from collections.abc import Iterable, Mapping, Sequence, Set

from controller.play.intent import Content, Question
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import ContactKey

ChangeTimes = Mapping[ContactKey | None, float]
"""When [s] fingers changed, by contact; the key None is for the first finger that lifted."""


class WaitingChanges:
    """The changes that no plan has responded to.

    New changes wait in the tracker. Changes that wait for contents being chosen in the thread are
    kept here, so that the latency counts from the change that the choice is for.
    """

    refused: ChangeTimes
    """Changes of a plan that amplifiers refused."""
    _choice: Question | None
    """The question in the thread whose choice `_for_choice` wait for."""
    _for_choice: ChangeTimes
    """Changes that the choice will respond to."""

    def __init__(self, tracker: ContactTracker) -> None:
        self._tracker = tracker
        self.refused = {}
        self._choice = None
        self._for_choice = {}

    def answered_by(self, started: Sequence[Content], choice: Question | None) -> ChangeTimes:
        """Return the changes that a plan responds to; they no longer wait.

        started: contents that the plan starts; choice: the question in the thread. During a choice
        the plan responds only to lifts and to fingers whose pulses start. A lasting content that
        starts comes from the previous choice, and responds to the changes that waited for it.
        """
        changes = self._tracker.changed
        waiting = {**changes, **self._for_choice}
        if choice is None:
            self._tracker.forget_changes()
            self._choice = None
            self._for_choice = {}
            return waiting
        keys: set[ContactKey | None] = {None, *_contact_keys_of_pulses(started)}
        answered = _among(keys, waiting)
        if choice is self._choice:
            self._tracker.forget_lifts()
            return answered
        for_choice = _among(changes.keys() - keys, changes)
        self._tracker.forget_changes()
        has_lasting_start = any(not content.target.is_short for content in started)
        if has_lasting_start:
            answered |= self._for_choice
        else:
            for_choice |= self._for_choice
        self._choice = choice
        self._for_choice = for_choice
        return answered

    def wait_again_after_refusal(self) -> None:
        """Let the changes of a refused plan wait again, unless their fingers have lifted."""
        if self.refused:
            keys = {contact.key for contact in self._tracker.contacts}
            self._tracker.wait_again(_among(keys, self.refused))
            self.refused = {}


def _among(keys: Set[ContactKey | None], changes: ChangeTimes) -> dict[ContactKey | None, float]:
    """Return the changes of some contacts."""
    return {key: changed_at for key, changed_at in changes.items() if key in keys}


def _contact_keys_of_pulses(contents: Iterable[Content]) -> set[ContactKey]:
    """Return the contacts that feel the short pulses among contents."""
    keys = set[ContactKey]()
    for content in contents:
        if content.target.is_short:
            keys.update(content.contact_keys)
    return keys
