"""Selector: keep the contents that realise a haptic intent, and decide when to choose again.

Lasting contents are chosen together (`controller.play.lasting`), and each short pulse alone
(`controller.play.pulses`), by `controller.play.chooser`. One choice is made at a time, for the
fingers as they are once the previous choice has been made.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from controller.play.chooser import ChoiceThread, Chooser, contents_of
from controller.play.continuity import is_met_by, serves_late, targets_of
from controller.play.crossfades import Improvement, is_due
from controller.play.intent import HapticIntent, Target, Targets
from controller.play.joined_selections import joined
from controller.play.lasting import LastingContents
from controller.play.layer_allotment import targets_on_plate, within_layers
from controller.play.pulses import ChosenPulses
from controller.play.selected_contents import (
    BEING_CHOSEN,
    NOTHING,
    Content,
    ContentKey,
    Question,
    Selection,
)
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from model.table.table import LocalizationTable


class _Situation(NamedTuple):
    """Everything a joint answer depends on except the positions of fingers."""

    fingers: frozenset[tuple[ContactKey, float, float]]
    """Key, time of arrival [s] and load of each contact."""
    lasting_targets: frozenset[Target]
    protected: frozenset[ContactKey]
    table: LocalizationTable
    capabilities: PlaybackCapabilities


class Selector:
    """Keeps a selection for the contacts on a plate, and chooses again when it no longer serves.

    All lasting contents are chosen together, in a thread if there are several, and kept while they
    serve: a finger can move by `MOVE_TOLERANCE` (`controller.play.continuity`). Each short pulse is
    chosen alone and never changed.

    Once all fingers have rested for `RESTS_AFTER` (`controller.play.crossfades`), contents are
    cross-faded to a better answer, if there is one, step by step until anything changes: fingers,
    the table with its clocks, or the limits of the amplifiers. If a finger was held back before
    that change, all contents are chosen again. `ChoiceThread` gives up a choice after `TIME_LIMIT`
    (`controller.play.selected_contents`): the lasting contents of several fingers are silent until
    it has ended.

    chooser: makes the next choice, while the thread finishes with the former chooser; arrived:
    called when the thread is done; can_crossfade: whether present contents can be cross-faded to
    these at a time [s].
    """

    def __init__(
        self,
        chooser: Chooser,
        *,
        arrived: Callable[[], None] = lambda: None,
        can_crossfade: Callable[[Sequence[Content], float], bool] = lambda contents, now: True,
    ) -> None:
        self.chooser = chooser
        self._can_crossfade = can_crossfade
        self._thread = ChoiceThread(arrived)
        self._lasting = LastingContents()
        self._pulses = ChosenPulses()
        self._improvement = Improvement()
        self._situation: _Situation | None = None
        self._requested_situation: _Situation | None = None
        """The situation of the last question with lasting targets."""

    @property
    def pending(self) -> Question | None:
        """The question in the thread; None if its answer has been taken."""
        return self._thread.pending

    @property
    def due(self) -> float:
        """Time [s] of the next selection if no contact changes."""
        return min(self._improvement.due, self._lasting.limits_end_at)

    def select(
        self,
        contacts: Sequence[Contact],
        intent: HapticIntent,
        capabilities: PlaybackCapabilities,
        *,
        now: float = math.inf,
    ) -> Selection:
        """Return the selection for contacts in order of arrival; an equal one if contents are kept.

        While the thread computes, contents that play and are still wanted continue. now [s]:
        infinite if fingers do not move.
        """
        targets = targets_on_plate(contacts, intent)
        served, skipped = within_layers(targets, capabilities)
        intended = _question(contacts, served, intent.protected)

        self._end_silence()
        self._lasting.follow_fingers(intended)
        self._follow_situation(intended, capabilities, now)
        has_arrived = self._take_arrived(intended, now)
        former_pulses = self._pulses.selections
        self._pulses.keep_requested(intended.short)
        if not contacts:
            self._lasting.drop()
        if self.pending is None:
            self._choose_if_due(intended, former_pulses, capabilities, now, has_waited=has_arrived)
        else:
            self._put_off(now)

        parts = [self._lasting.felt, *self._pulses.selections]
        selection = joined(contacts, targets, parts, skipped, intent.reason, self.chooser.table)
        return self._marked_pending(selection, intent)

    def choose_again(self) -> None:
        """Drop lasting contents and the choice under way, so that the next cycle chooses again."""
        self._lasting.drop()
        self._improvement.stop()
        self._requested_situation = None

    def wait_for_change(self) -> None:
        """Choose nothing more until a contact or the intent changes."""
        self._improvement.stop()
        self._lasting.limits_end_at = math.inf

    def _end_silence(self) -> None:
        """End the silence in place of a choice that took too long, once the thread is free."""
        if self._lasting.chosen.is_given_up and not self._thread.is_given_up:
            self._lasting.drop()

    def _follow_situation(
        self, intended: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Leave the steps to a better answer if the situation has changed."""
        fingers = [(contact.key, contact.since, contact.load) for contact in intended.contacts]
        situation = _Situation(
            frozenset(fingers),
            targets_of(intended.lasting),
            intended.protected,
            self.chooser.table,
            capabilities,
        )
        if situation != self._situation:
            self._situation = situation
            self._improvement.wait_for_rest(now)

    def _take_arrived(self, intended: Question, now: float) -> bool:
        """Take the choice of the thread if it is done; return whether it was."""
        question = self._thread.pending
        selections = self._thread.take()
        if question is None or selections is None:
            return False
        is_outdated = self._is_outdated(selections, intended)
        self._take(question, selections, now, is_outdated=is_outdated)
        return True

    def _is_outdated(self, selections: Sequence[Selection], intended: Question) -> bool:
        """Whether lasting contents that were chosen in the thread are no longer wanted.

        They are dropped if present contents serve again, because a finger that came has lifted.
        """
        if self._requested_situation is None:
            return True
        selection = next(iter(selections), NOTHING)
        if selection.is_given_up:
            return False  # it silences
        may_improve = self._lasting.chosen.is_limited or not self._has_situation_changed()
        if not may_improve and is_met_by(intended, self._lasting.chosen):
            return True
        return not serves_late(selection, intended)

    def _has_situation_changed(self) -> bool:
        """Whether the situation differs from that of the last question with lasting targets."""
        return self._requested_situation != self._situation

    def _put_off(self, now: float) -> None:
        """Put off due choices, because the thread is busy."""
        if is_due(self._improvement.due, now):
            self._improvement.wait_for_rest(now)
        self._lasting.put_limits_off(now)

    def _marked_pending(self, selection: Selection, intent: HapticIntent) -> Selection:
        """Return a selection that says whether contents of its targets are still being chosen."""
        target_keys = {target.key for target in intent.targets}
        if self.pending is None or len(selection.finger_sensations) >= len(target_keys):
            return selection
        pending = replace(selection, is_pending=True)
        if pending.reason is None and not pending.contents:
            return replace(pending, reason=BEING_CHOSEN)
        return pending

    def _choose_if_due(
        self,
        intended: Question,
        former_pulses: Sequence[Selection],
        capabilities: PlaybackCapabilities,
        now: float,
        *,
        has_waited: bool,
    ) -> None:
        """Choose contents that are due: for new pulses, for lasting targets, or better ones.

        former_pulses: selections of pulses until now; has_waited: whether the thread was busy. A
        pulse that has waited for the thread is chosen before lasting contents, after which it would
        be late.
        """
        new_pulses = self._pulses.new_among(intended.short)
        is_served = not self._needs_choice(intended, now)
        self._lasting.note_limits(now)
        if is_served and is_due(self._improvement.due, now):
            self._improve_at_rest(intended, capabilities, now, has_new_pulses=bool(new_pulses))
        if new_pulses and (is_served or has_waited):
            question = self._question_of_pulses(intended, new_pulses, former_pulses, now)
            self._choose(question, capabilities, now)
            new_pulses = ()
        if not is_served:
            self._improvement.wait_for_rest(now)
            question = self._question_of_lasting(intended, former_pulses, now)
            self._choose_lasting(replace(question, short=new_pulses), capabilities, now)

    def _needs_choice(self, intended: Question, now: float) -> bool:
        """Whether lasting targets are not served, or can gain from another choice."""
        if not intended.lasting:
            return False
        if not is_met_by(intended, self._lasting.chosen):
            return True
        if self._lasting.are_limits_over(now):
            return True
        has_rested = is_due(self._improvement.rests_at, now)
        return has_rested and self._has_situation_changed() and self._lasting.holds_back_a_finger

    def _improve_at_rest(
        self,
        intended: Question,
        capabilities: PlaybackCapabilities,
        now: float,
        *,
        has_new_pulses: bool,
    ) -> None:
        """Improve contents at a time [s] if all fingers rest; otherwise wait until they do."""
        if not _may_crossfade(intended):
            self._improvement.stop()
        elif has_new_pulses or not self._are_at_rest(intended.contacts, now):
            self._improvement.wait_for_rest(now)
        else:
            self._improve(intended, capabilities, now)

    def _are_at_rest(self, contacts: Iterable[Contact], now: float) -> bool:
        """Whether no contact moves at a time [s], and no pulse is active or limits contents."""
        if self._pulses.active_at(now) or self._lasting.chosen.is_limited:
            return False
        return not any(any(contact.velocity(now)) for contact in contacts)

    def _improve(self, intended: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Take the next step to a better answer at a time [s], or look for such an answer."""
        next_step = self._improvement.next_step
        if next_step is None:
            self._improvement.stop()
            question = self._question_of_lasting(intended, (), now)
            self._choose_lasting(replace(question, is_rested=True), capabilities, now)
        elif self._can_crossfade(next_step.contents, now):
            self._improvement.take_step(self._lasting.chosen, now)
            self._lasting.chosen = next_step
        else:
            self._improvement.stop()

    def _question_of_pulses(
        self,
        intended: Question,
        new_pulses: Targets,
        former_pulses: Sequence[Selection],
        now: float,
    ) -> Question:
        """Return the question for new pulses, while all other contents continue."""
        return replace(
            intended,
            lasting=(),
            short=new_pulses,
            playing=self._felt_contents(former_pulses),
            kept=(self._lasting.felt, *self._pulses.active_at(now)),
            fading=self._improvement.fading_at(now),
        )

    def _question_of_lasting(
        self, intended: Question, former_pulses: Sequence[Selection], now: float
    ) -> Question:
        """Return the question for lasting targets, without pulses."""
        return replace(
            intended,
            short=(),
            playing=self._felt_contents(former_pulses),
            kept=self._pulses.active_at(now),
            now=now,
        )

    def _felt_contents(self, pulses: Sequence[Selection]) -> dict[ContentKey, Content]:
        """Return the lasting contents and the contents of some pulses, by finger and voice."""
        selections = [self._lasting.felt, *pulses]
        return {content.key: content for content in contents_of(selections)}

    def _choose_lasting(
        self, question: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Choose for a question with lasting targets, and note its situation."""
        self._requested_situation = self._situation
        self._choose(question, capabilities, now)

    def _choose(self, question: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Choose for a question at a time [s]: immediately, or in the thread if it takes long."""
        selections: tuple[Selection, ...] | None
        if question.takes_long:
            selections = self._thread.start(self.chooser, question, capabilities)
        else:
            selections = self.chooser.choose(question, capabilities)
        if selections is not None:
            self._take(question, selections, now)

    def _take(
        self,
        question: Question,
        selections: Sequence[Selection],
        now: float,
        *,
        is_outdated: bool = False,
    ) -> None:
        """Take the selections for a question at a time [s]; only pulses of an outdated choice."""
        if question.is_rested:
            if selections and not self._has_situation_changed():
                self._improvement.start(selections, now)
            return
        for selection in selections:
            if selection.targets[0].target.is_short:
                self._pulses.take(selection)
            elif not is_outdated:
                self._lasting.take(selection, question)
                if selection.is_limited or selection.is_given_up:
                    self._improvement.stop()


def _question(
    contacts: Sequence[Contact], served: Targets, protected: frozenset[ContactKey]
) -> Question:
    """Return the question whose answer would serve some targets."""
    short = [finger for finger in served if finger.target.is_short]
    lasting = [finger for finger in served if not finger.target.is_short]
    return Question(tuple(contacts), tuple(lasting), tuple(short), protected)


def _may_crossfade(intended: Question) -> bool:
    """Whether lasting contents can cross-fade to a better answer; courses have no cross-fades."""
    has_course = any(finger.target.course is not None for finger in intended.lasting)
    return intended.takes_long and not has_course
