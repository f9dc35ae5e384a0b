"""Selector: keep the contents that realise a haptic intent, and decide when to choose again.

Lasting contents are chosen together, and each short pulse alone (`controller.play.chooser`). A
pulse would be over before a joint answer could help, so it is never changed. One choice is made at
a time, for the fingers as they are once the previous choice has been made.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from controller.play.chooser import ChoiceThread, Chooser, contents_of
from controller.play.crossfades import RESTS_AFTER, Improvement, is_due
from controller.play.intent import FADED_AFTER, FingerTarget, HapticIntent, Target, Targets
from controller.play.joint_answers import STRETCH
from controller.play.selected_contents import (
    BEING_CHOSEN,
    NOTHING,
    Content,
    ContentKey,
    FingerSensation,
    Question,
    Selection,
    foreign_at,
    no_layer_free,
    not_served,
)
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from model.answer.plan import MAX_SEPARATE
from model.drive_modes import UNRESTRICTED
from model.table.table import LocalizationTable

# Bending wavelengths are at least 17 cm below 500 Hz, so a fingertip that has moved by about its
# own radius is still within the disc that the pattern was chosen for. The answer for a moving
# finger covers this distance ahead.
MOVE_TOLERANCE = STRETCH


def _is_met_by(intended: Question, chosen: Selection) -> bool:
    """Whether a selection also serves the lasting targets that are intended now."""
    requested = _targets_of(intended.lasting)
    served = _targets_of(chosen.targets)
    if not served or not requested <= served:
        return False
    # If a target ends, the others gain only if fingers share or are not served.
    if requested != served and not chosen.is_whole:
        return False
    if not _are_same_fingers(intended.contacts, chosen):
        return False
    for contact in intended.contacts:
        former_contact = chosen.contacts[contact.key]
        if not _feels_alike(contact, former_contact):
            return False
        if (contact.key in intended.protected) != (contact.key in chosen.protected):
            return False
        if not intended.is_alone and _has_set_out(contact, former_contact):
            return False
    return True


def _are_same_fingers(contacts: Iterable[Contact], chosen: Selection) -> bool:
    """Whether a selection has these contacts; fingers can have left a whole selection."""
    keys = {contact.key for contact in contacts}
    if not chosen.is_whole:
        return keys == chosen.contacts.keys()
    if not keys <= chosen.contacts.keys():
        return False
    for key, former_contact in chosen.contacts.items():
        if former_contact.is_hand and key not in keys:
            return False
    return True


def _feels_alike(contact: Contact, former: Contact) -> bool:
    """Whether an answer still serves a contact: near its former position, with the same load."""
    distance = math.dist((contact.x, contact.y), (former.x, former.y))
    is_as_heavy = contact.load == former.load and contact.is_surplus == former.is_surplus
    return distance <= MOVE_TOLERANCE and is_as_heavy


def _has_set_out(contact: Contact, former: Contact) -> bool:
    """Whether a contact that rested is moving now, and needs an answer for the path ahead."""
    has_moved = (contact.x, contact.y) != (former.x, former.y)
    return has_moved and contact.is_under_way and not former.is_under_way


def _targets_of(targets: Targets) -> frozenset[Target]:
    return frozenset([finger.target for finger in targets])


def _at_any_level(targets: Targets) -> set[Target]:
    """Return targets without the values that may differ in a late choice."""
    return {
        replace(target, level_db_sl=None, pulse=None, modulation_hz=None, course=None)
        for _, target in targets
    }


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

    All lasting contents are chosen together, in a thread if there are several. Each short pulse is
    chosen alone and never changed. Lasting contents are kept while their targets and levels are the
    same, no contact has moved more than 8 mm, none of several has set out, and no load has changed
    (loads change in steps of a factor of 1.5 or more). A contact that lifts, or whose effect ends,
    does not change the others.

    Once all fingers rest, contents are cross-faded to a better answer, if there is one, step by
    step until anything changes: fingers, the table with its clocks, or the limits of the
    amplifiers. If a finger was held back before that change, all contents are chosen again. A
    choice that takes too long is given up: the lasting contents of several fingers are silent until
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
        self._improvement = Improvement()
        self._lasting = NOTHING
        """The lasting contents as chosen, also for fingers that have left."""
        self._lasting_fingers: dict[ContactKey, float] = {}
        """When [s] the fingers of lasting targets came down."""
        self._limits_end_at = math.inf
        """When [s] the pulses that limit the lasting contents have faded; infinite without any."""
        self._pulses: dict[ContactKey, Selection] = {}
        """The contents of pulses that are active, or have not started yet."""
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
        return min(self._improvement.due, self._limits_end_at)

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
        targets = _targets_on_plate(contacts, intent)
        served, skipped = _within_layers(targets, capabilities)
        short = tuple([finger for finger in served if finger.target.is_short])
        lasting = tuple([finger for finger in served if not finger.target.is_short])
        intended = Question(tuple(contacts), lasting, short, intent.protected)
        if self._lasting.is_given_up and not self._thread.is_given_up:
            self._lasting = NOTHING
        self._follow_fingers(intended)
        self._follow_situation(intended, capabilities, now)
        has_arrived = self._take_arrived(intended, now)
        former_pulses = self._pulses
        self._pulses = _still_requested(former_pulses, intended.short)
        if not contacts:
            self._lasting = NOTHING
        if self.pending is None:
            self._choose_if_due(intended, former_pulses, capabilities, now, has_waited=has_arrived)
        else:
            self._put_off(now)
        parts = [self._felt_lasting(), *self._pulses.values()]
        selection = _joined(contacts, targets, parts, skipped, intent.reason, self.chooser.table)
        target_keys = {target.key for target in intent.targets}
        if self.pending is None or len(selection.finger_sensations) >= len(target_keys):
            return selection
        pending = replace(selection, is_pending=True)
        if pending.reason is None and not pending.contents:
            return replace(pending, reason=BEING_CHOSEN)
        return pending

    def choose_again(self) -> None:
        """Drop lasting contents and the choice under way, so that the next cycle chooses again."""
        self._lasting = NOTHING
        self._improvement.stop()
        self._requested_situation = None

    def wait_for_change(self) -> None:
        """Choose nothing more until a contact or the intent changes."""
        self._improvement.stop()
        self._limits_end_at = math.inf

    def _follow_fingers(self, intended: Question) -> None:
        """Drop the lasting content of fingers that have left and come back elsewhere."""
        former_fingers = self._lasting_fingers
        self._lasting_fingers = {}
        returned = set[ContactKey]()
        for contact, _ in intended.lasting:
            self._lasting_fingers[contact.key] = contact.since
            is_new = former_fingers.get(contact.key) != contact.since
            if is_new and contact.key in self._lasting.target_keys:
                returned.add(contact.key)
        if returned and not _is_met_by(intended, self._lasting):
            self._lasting = self._lasting.restricted(self._lasting.target_keys - returned)

    def _follow_situation(
        self, intended: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Leave the steps to a better answer if the situation has changed."""
        fingers = [(contact.key, contact.since, contact.load) for contact in intended.contacts]
        situation = _Situation(
            frozenset(fingers),
            _targets_of(intended.lasting),
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
        is_outdated = self._requested_situation is None or not self._still_serves(
            selections, intended
        )
        self._take(question, selections, now, is_outdated=is_outdated)
        return True

    def _put_off(self, now: float) -> None:
        """Put off due choices, because the thread is busy."""
        if is_due(self._improvement.due, now):
            self._improvement.wait_for_rest(now)
        if is_due(self._limits_end_at, now):
            self._limits_end_at = now + RESTS_AFTER

    def _felt_lasting(self) -> Selection:
        """Return the lasting contents of the fingers that still want them."""
        return self._lasting.restricted(self._lasting_fingers.keys())

    def _choose_if_due(
        self,
        intended: Question,
        former_pulses: Mapping[ContactKey, Selection],
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
        new_pulses = tuple(
            [finger for finger in intended.short if finger.contact.key not in self._pulses]
        )
        is_served = not self._needs_choice(intended, now)
        if is_due(self._limits_end_at, now):
            self._limits_end_at = math.inf
        if is_served and is_due(self._improvement.due, now):
            if not _may_crossfade(intended):
                self._improvement.stop()
            elif new_pulses or not self._are_at_rest(intended.contacts, now):
                self._improvement.wait_for_rest(now)
            else:
                self._improve(intended, capabilities, now)
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
        if not _is_met_by(intended, self._lasting):
            return True
        if is_due(self._limits_end_at, now) and self._lasting.is_limited:
            return True
        return is_due(self._improvement.rests_at, now) and self._may_serve_more()

    def _may_serve_more(self) -> bool:
        """Whether a finger is held back, and the situation has changed since."""
        if self._requested_situation == self._situation:
            return False
        return any(finger.contact.key in self._lasting_fingers for finger in self._lasting.unserved)

    def _are_at_rest(self, contacts: Iterable[Contact], now: float) -> bool:
        """Whether no contact moves at a time [s], and no pulse is active or limits contents."""
        if self._active_pulses(now) or self._lasting.is_limited:
            return False
        return not any(any(contact.velocity(now)) for contact in contacts)

    def _improve(self, intended: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Take the next step to a better answer at a time [s], or look for such an answer."""
        next_step = self._improvement.next_step
        if next_step is None:
            self._improvement.stop()
            question = self._question_of_lasting(intended, {}, now)
            self._choose_lasting(replace(question, is_rested=True), capabilities, now)
        elif self._can_crossfade(next_step.contents, now):
            self._improvement.take_step(self._lasting, now)
            self._lasting = next_step
        else:
            self._improvement.stop()

    def _question_of_pulses(
        self,
        intended: Question,
        new_pulses: Targets,
        former_pulses: Mapping[ContactKey, Selection],
        now: float,
    ) -> Question:
        """Return the question for new pulses, while all other contents continue."""
        return replace(
            intended,
            lasting=(),
            short=new_pulses,
            playing=self._felt_contents(former_pulses),
            kept=(self._felt_lasting(), *self._active_pulses(now)),
            fading=self._improvement.fading_at(now),
        )

    def _question_of_lasting(
        self, intended: Question, former_pulses: Mapping[ContactKey, Selection], now: float
    ) -> Question:
        """Return the question for lasting targets, without pulses."""
        return replace(
            intended,
            short=(),
            playing=self._felt_contents(former_pulses),
            kept=self._active_pulses(now),
            now=now,
        )

    def _felt_contents(self, pulses: Mapping[ContactKey, Selection]) -> dict[ContentKey, Content]:
        """Return the lasting contents and the contents of some pulses, by finger and voice."""
        selections = [self._felt_lasting(), *pulses.values()]
        return {content.key: content for content in contents_of(selections)}

    def _active_pulses(self, now: float) -> tuple[Selection, ...]:
        """Return the short pulses that have not ended at a time [s]."""
        active = list[Selection]()
        for selection in self._pulses.values():
            if any(now < pulse.end for pulse in selection.pulses):
                active.append(selection)
        return tuple(active)

    def _choose_lasting(
        self, question: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Choose for a question with lasting targets, and note its situation."""
        self._requested_situation = self._situation
        self._choose(question, capabilities, now)

    def _choose(self, question: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Choose for a question at a time [s]: immediately, or in the thread if it takes long.

        While the thread works on a choice that was given up, it can make no other choice.
        """
        if not question.takes_long:
            self._take(question, self.chooser.choose(question, capabilities), now)
        elif self._thread.is_given_up:
            self._take(question, question.given_up(), now)
        else:
            self._thread.start(self.chooser, question, capabilities)

    def _still_serves(self, selections: Sequence[Selection], intended: Question) -> bool:
        """Whether a late choice of lasting contents still serves the contacts on the plate.

        All contacts must have been present when it was made, without lifting since. Positions,
        levels and courses may have changed, since a finger that keeps moving would get nothing
        otherwise; the layout may not. The choice is dropped if present contents serve again,
        because a finger that came has lifted.
        """
        selection = next(iter(selections), NOTHING)
        if selection.is_given_up:
            return True  # it silences
        may_improve = self._lasting.is_limited or self._requested_situation == self._situation
        if not may_improve and _is_met_by(intended, self._lasting):
            return False
        for contact in intended.contacts:
            former_contact = selection.contacts.get(contact.key)
            if former_contact is None or former_contact.since != contact.since:
                return False
        if not intended.protected <= selection.protected:
            return False
        return _at_any_level(intended.lasting) <= _at_any_level(selection.targets)

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
            if selections and self._requested_situation == self._situation:
                self._improvement.start(selections, now)
            return
        for selection in selections:
            contact, target = selection.targets[0]
            if target.is_short:
                self._pulses[contact.key] = selection
            elif not is_outdated:
                self._take_lasting(question, selection)

    def _take_lasting(self, question: Question, selection: Selection) -> None:
        """Take the lasting contents chosen for a question."""
        self._lasting = selection
        self._limits_end_at = math.inf
        if selection.is_limited:
            self._limits_end_at = _last_end(question.kept) + FADED_AFTER
        if selection.is_limited or selection.is_given_up:
            self._improvement.stop()


def _targets_on_plate(contacts: Sequence[Contact], intent: HapticIntent) -> Targets:
    """Return the targets of an intent with their contacts, in order of arrival."""
    targets = list[FingerTarget]()
    for contact in contacts:
        for target in intent.targets:
            if target.key == contact.key:
                targets.append(FingerTarget(contact, target))
    return tuple(targets)


def _still_requested(
    pulses: Mapping[ContactKey, Selection], short: Targets
) -> dict[ContactKey, Selection]:
    """Return the selections of pulses that are still targets."""
    requested = dict[ContactKey, Selection]()
    for contact, target in short:
        selection = pulses.get(contact.key)
        if selection is not None and selection.targets[0].target == target:
            requested[contact.key] = selection
    return requested


def _last_end(selections: Iterable[Selection]) -> float:
    """Return when [s] the last pulse of some selections ends."""
    ends = list[float]()
    for selection in selections:
        for pulse in selection.pulses:
            ends.append(pulse.end)
    return max(ends, default=-math.inf)


def _may_crossfade(intended: Question) -> bool:
    """Whether lasting contents can cross-fade to a better answer; courses have no cross-fades."""
    has_course = any(finger.target.course is not None for finger in intended.lasting)
    return intended.takes_long and not has_course


def _joined(
    contacts: Sequence[Contact],
    targets: Targets,
    parts: Sequence[Selection],
    skipped: tuple[FingerSensation, ...],
    reason: str,
    table: LocalizationTable,
) -> Selection:
    """Join selections that were chosen separately, with the contacts as they were then.

    reason: why there are no targets.
    """
    chosen = [part for part in parts if part.targets]
    if len(chosen) == 1 and len(chosen[0].targets) == len(targets):
        return chosen[0]
    former_contacts = dict[ContactKey, Contact]()
    contents = list[Content]()
    unserved = list[FingerSensation]()
    first_reason = None
    for part in chosen:
        former_contacts |= part.contacts
        if first_reason is None:
            first_reason = part.reason
        restated = part.beside([other for other in chosen if other is not part], table)
        contents += restated.contents
        unserved += restated.unserved
    former_targets = [
        FingerTarget(former_contacts.get(contact.key, contact), target)
        for contact, target in targets
    ]
    target_keys = {contact.key for contact, _ in targets}
    quiet = list[Contact]()
    foreign_levels = dict[ContactKey, tuple[float, ...]]()
    for contact in contacts:
        foreign_levels[contact.key] = foreign_at(contact.key, chosen)
        if contact.key not in target_keys:
            quiet.append(former_contacts.get(contact.key, contact))
    return Selection(
        tuple(former_targets),
        tuple(quiet),
        tuple(contents),
        first_reason if targets else reason,
        (*unserved, *skipped),
        foreign_levels=foreign_levels,
    )


def _within_layers(
    targets: Targets, capabilities: PlaybackCapabilities
) -> tuple[Targets, tuple[FingerSensation, ...]]:
    """Split targets into targets with a layer, and sensations of fingers that feel nothing.

    Short pulses of fingers with a lasting content are left out first, then the targets of lowest
    priority, the earliest first. Many targets that may share have one layer together.
    """
    mode = capabilities.drive_mode
    has_layers = mode == UNRESTRICTED
    layer_count = 1
    reason = f"the drive mode {mode} plays only one content; lift a finger"
    if has_layers:
        layer_count = capabilities.layers
        reason = no_layer_free(layer_count)
    if len(targets) <= layer_count:
        return targets, ()
    group_sizes = Counter([finger.target.shared_as for finger in targets])
    layer_groups = list[str | bool | None]()  # of each layer, what its targets share
    served_numbers = set[int]()
    for number in _by_rank(targets):
        group = targets[number].target.shared_as
        is_joint = has_layers and group is not None and group_sizes[group] > MAX_SEPARATE
        if is_joint and group in layer_groups:
            served_numbers.add(number)
        elif len(layer_groups) < layer_count:
            layer_groups.append(group)
            served_numbers.add(number)
    served = list[FingerTarget]()
    skipped = list[FingerSensation]()
    for number, finger in enumerate(targets):
        if number in served_numbers:
            served.append(finger)
        else:
            skipped.append(not_served(finger.contact, reason))
    return tuple(served), tuple(skipped)


def _by_rank(targets: Targets) -> list[int]:
    """Return the numbers of targets, in the order in which they get a layer."""
    lasting_keys = {finger.target.key for finger in targets if not finger.target.is_short}
    ranks = list[tuple[bool, int, int]]()
    for number, finger in enumerate(targets):
        target = finger.target
        is_extra = target.is_short and target.key in lasting_keys
        ranks.append((not is_extra, target.priority, number))
    return [number for _, _, number in sorted(ranks, reverse=True)]
