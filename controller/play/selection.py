"""Selector: keep the contents that realise a haptic intent, and decide when to choose again.

Lasting contents are chosen together, and each short pulse alone (`controller.play.chooser`). A
pulse would be over before a joint answer could help, so it is never changed. One choice is made at
a time, for the fingers as they are once the previous choice has been made.
"""

import asyncio
import logging
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias

from controller.play.chooser import Chooser, contents_of
from controller.play.intent import (
    BEING_CHOSEN,
    FADED_AFTER,
    NOTHING,
    Content,
    ContentKey,
    FingerSensation,
    FingerTarget,
    HapticIntent,
    Question,
    Selection,
    Target,
    Targets,
    foreign_at,
    no_layer_free,
    not_served,
)
from controller.play.joint_answers import STRETCH
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.play.slot import CROSSFADE, FALL_AFTER
from controller.sources.touch import Contact, ContactKey
from model.answer.plan import MAX_SEPARATE
from model.drive_modes import UNRESTRICTED
from model.table.table import LocalizationTable
from registry.threads import DaemonThreads

TIME_LIMIT = 1.0
"""Time [s] after which a choice is given up; it takes some tens of milliseconds."""

# Bending wavelengths are at least 17 cm below 500 Hz, so a fingertip that has moved by about its
# own radius is still within the disc that the pattern was chosen for. The answer for a moving
# finger covers this distance ahead.
MOVE_TOLERANCE = STRETCH

# s; fingers rest if no finger has come, left or moved further for this long.
_RESTS_AFTER = 0.1

CROSSFADE_INTERVAL = 0.4
"""Time [s] between two steps on the way to a better answer, each of another finger."""

MIN_INTERVAL = 1.0
"""Time [s] from the last step on such a way to the first on the next."""

GIVEN_UP = (
    f"no answer within {TIME_LIMIT:g} s: several fingers feel nothing until it is computed; touch "
    "with one finger, and restart the daemon if it lasts"
)

_FADES_FOR = FALL_AFTER + CROSSFADE + FADED_AFTER  # s; contents that a step replaces

_logger = logging.getLogger(__name__)


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
    return has_moved and contact.motion.is_under_way and not former.motion.is_under_way


def _targets_of(targets: Targets) -> frozenset[Target]:
    return frozenset([finger.target for finger in targets])


def _at_any_level(targets: Targets) -> set[Target]:
    """Return targets without the values that may differ in a late choice."""
    return {
        replace(target, level_db_sl=None, pulse=None, modulation_hz=None, course=None)
        for _, target in targets
    }


_Future: TypeAlias = "asyncio.Future[tuple[Selection, ...]]"


@dataclass(frozen=True, eq=False)
class PendingChoice:
    """A question that the thread works on, or whose answer has not been taken yet."""

    question: Question
    future: _Future


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
        self._arrived = arrived
        self._can_crossfade = can_crossfade
        self._threads = DaemonThreads()
        self.pending: PendingChoice | None = None
        """The choice in the thread; there is one at a time."""
        self._given_up: _Future | None = None  # still computed
        self._lasting = NOTHING  # as chosen, also for fingers that have left
        self._pulses: dict[ContactKey, Selection] = {}  # active, or not started yet
        self._lasting_fingers: dict[ContactKey, float] = {}  # of lasting targets, down since [s]
        self._situation: _Situation | None = None
        # Of the last question with lasting targets.
        self._requested_situation: _Situation | None = None
        self._steps: Sequence[Selection] = ()  # to a better answer
        self._led_at = -math.inf  # s; time of the last step
        self._fading = NOTHING  # contents that the last step replaced
        self.due = math.inf
        """Time [s] of the next selection if no contact changes: all rest, or pulses have ended."""

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
        self._follow_fingers(intended)
        self._follow_situation(intended, capabilities, now)
        has_arrived = self._take_arrived(intended, now)
        former_pulses = self._pulses
        self._pulses = _still_requested(former_pulses, intended.short)
        if not contacts:
            self._lasting = NOTHING
        if self.pending is None:
            self._choose_if_due(intended, former_pulses, capabilities, now, has_waited=has_arrived)
        elif self.due <= now:
            self.due = now + _RESTS_AFTER
        parts = [self._felt_lasting(), *self._pulses.values()]
        selection = _joined(contacts, targets, parts, skipped, intent.reason, self.chooser.table)
        target_keys = {target.key for target in intent.targets}
        if self.pending is None or len(selection.finger_sensations) >= len(target_keys):
            return selection
        pending = replace(selection, is_pending=True)
        if pending.reason is None and not pending.contents:
            return replace(pending, reason=BEING_CHOSEN)
        return pending

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
            self._lasting = _restricted(self._lasting, self._lasting.target_keys - returned)

    def _follow_situation(
        self, intended: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Leave the way to a better answer if the situation has changed."""
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
            self._rest_again(now)

    def _take_arrived(self, intended: Question, now: float) -> bool:
        """Take the choice of the thread if it is done; return whether it was."""
        choice = self.pending
        if choice is None or not choice.future.done():
            return False
        self.pending = None
        selections = choice.future.result()
        is_outdated = self._requested_situation is None or not self._still_serves(
            selections, intended
        )
        self._take(choice.question, selections, now, is_outdated=is_outdated)
        return True

    def _felt_lasting(self) -> Selection:
        """Return the lasting contents of the fingers that still want them."""
        return _restricted(self._lasting, self._lasting_fingers.keys())

    def _choose_if_due(
        self,
        intended: Question,
        former_pulses: Mapping[ContactKey, Selection],
        capabilities: PlaybackCapabilities,
        now: float,
        *,
        has_waited: bool,
    ) -> None:
        """Choose contents that are due: for new pulses, and for lasting targets.

        former_pulses: selections of pulses until now; has_waited: whether the thread was busy. A
        pulse that has waited for the thread is chosen before lasting contents, after which it would
        be late.
        """
        is_served = not intended.lasting or _is_met_by(intended, self._lasting)
        new_pulses = tuple(
            [finger for finger in intended.short if finger.contact.key not in self._pulses]
        )
        is_rested = False
        if self.due < math.inf and self.due <= now:
            self.due = math.inf
            if intended.lasting and self._would_gain():
                is_served = False
            if is_served and _may_crossfade(intended):
                is_rested = not new_pulses and self._is_at_rest(intended, now)
                if not is_rested:
                    self._rest_again(now)
        if is_rested and self._steps:
            self._lead(now)
        elif is_rested:
            question = self._question_of_lasting(intended, {}, now)
            self._choose_lasting(replace(question, is_rested=True), capabilities, now)
        else:
            pulses_first = has_waited or is_served
            if new_pulses and pulses_first:
                question = self._question_of_pulses(intended, new_pulses, former_pulses, now)
                self._choose(question, capabilities, now)
                new_pulses = ()
            if not is_served:
                self._rest_again(now)
                question = self._question_of_lasting(intended, former_pulses, now)
                self._choose_lasting(replace(question, short=new_pulses), capabilities, now)

    def _is_at_rest(self, intended: Question, now: float) -> bool:
        """Whether no pulse is active and no contact moves at a time [s]."""
        if self._active_pulses(now):
            return False
        return not any(any(contact.motion.velocity(now)) for contact in intended.contacts)

    def _question_of_pulses(
        self,
        intended: Question,
        new_pulses: Targets,
        former_pulses: Mapping[ContactKey, Selection],
        now: float,
    ) -> Question:
        """Return the question for new pulses, while all other contents continue."""
        fading = NOTHING
        if now < self._led_at + _FADES_FOR:
            fading = self._fading
        return replace(
            intended,
            lasting=(),
            short=new_pulses,
            playing=self._felt_contents(former_pulses),
            kept=(self._felt_lasting(), *self._active_pulses(now)),
            fading=fading,
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

    def _choose_lasting(
        self, question: Question, capabilities: PlaybackCapabilities, now: float
    ) -> None:
        """Choose for a question with lasting targets, and note its situation."""
        self._requested_situation = self._situation
        self._choose(question, capabilities, now)

    def _would_gain(self) -> bool:
        """Whether another choice may give lasting targets more than the present one.

        It may if pulses have ended that limited them, or if one is held back and the situation has
        changed.
        """
        if self._lasting.is_limited:
            return True
        if self._requested_situation == self._situation:
            return False
        return any(finger.contact.key in self._lasting_fingers for finger in self._lasting.unserved)

    def _choose(self, question: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Choose for a question at a time [s]: immediately, or in the thread if it takes long.

        A choice in the thread that hangs cannot be ended, only given up. No other choice in the
        thread begins before it has ended; its result is dropped.
        """
        if not question.takes_long:
            self._take(question, self.chooser.choose(question, capabilities), now)
        elif self._given_up is not None:
            self._take(question, question.unanswered(GIVEN_UP), now)
        else:
            loop = asyncio.get_running_loop()
            choose = partial(self.chooser.choose, question, capabilities)
            future = loop.run_in_executor(self._threads, choose)
            self.pending = PendingChoice(question, future)
            future.add_done_callback(self._note_done)
            loop.call_later(TIME_LIMIT, self._give_up, question, future)

    def _give_up(self, question: Question, future: _Future) -> None:
        """Give up a choice that is not done: lasting contents fall silent."""
        if future.done():
            return
        _logger.warning("loop: answer given up, still computed after %g s", TIME_LIMIT)
        self._given_up = future
        silence: _Future = asyncio.get_running_loop().create_future()
        silence.set_result(question.unanswered(GIVEN_UP))
        self.pending = PendingChoice(question, silence)
        self._arrived()

    def _note_done(self, future: _Future) -> None:
        """Note that the thread is done with a choice."""
        if future is self._given_up:
            self._given_up = None
            future.exception()  # retrieved, so that asyncio does not log it
            if self._lasting.reason == GIVEN_UP:  # so that the next cycle chooses again
                self._lasting = NOTHING
        self._arrived()

    def choose_again(self) -> None:
        """Drop lasting contents and the choice under way, so that the next cycle chooses again."""
        self._lasting = NOTHING
        self._steps = ()
        self._requested_situation = None

    def _rest_again(self, now: float) -> None:
        """Leave the way to a better answer, if any, until all fingers have rested."""
        self._steps = ()
        self.due = max(now + _RESTS_AFTER, self._led_at + MIN_INTERVAL)

    def _lead(self, now: float) -> None:
        """Take the next step to a better answer at a time [s], if the amplifiers can."""
        step, *self._steps = self._steps
        if not self._can_crossfade(step.contents, now):
            self._steps = ()
            return
        if step.contents != self._lasting.contents:
            frequencies = {content.key: content.frequency for content in step.contents}
            fading = list[Content]()
            for content in self._lasting.contents:
                is_tuned = frequencies.get(content.key) != content.frequency
                if is_tuned or content.key not in frequencies:
                    fading.append(content)
            self._fading = replace(self._lasting, contents=tuple(fading))
            self._led_at = now
        self._lasting = step
        self.due = math.inf
        if self._steps:
            self.due = now + CROSSFADE_INTERVAL

    def _active_pulses(self, now: float) -> tuple[Selection, ...]:
        """Return the short pulses that have not ended at a time [s]."""
        active = list[Selection]()
        for selection in self._pulses.values():
            if any(now < pulse.end for pulse in selection.pulses):
                active.append(selection)
        return tuple(active)

    def _still_serves(self, selections: Sequence[Selection], intended: Question) -> bool:
        """Whether a late choice of lasting contents still serves the contacts on the plate.

        All contacts must have been present when it was made, without lifting since. Positions,
        levels and courses may have changed, since a finger that keeps moving would get nothing
        otherwise; the layout may not. The choice is dropped if present contents serve again,
        because a finger that came has lifted.
        """
        selection = next(iter(selections), NOTHING)
        if selection.reason == GIVEN_UP:
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
                self._steps = selections
                self.due = now
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
        if selection.reason == GIVEN_UP:
            self.due = math.inf
        if selection.is_limited:
            last_end = -math.inf
            for kept in question.kept:
                for pulse in kept.pulses:
                    last_end = max(last_end, pulse.end)
            self.due = last_end + FADED_AFTER


def _targets_on_plate(contacts: Sequence[Contact], intent: HapticIntent) -> Targets:
    """Return the targets of an intent with their contacts, in order of arrival."""
    by_key = defaultdict[ContactKey, list[Target]](list)
    for target in intent.targets:
        by_key[target.key].append(target)
    targets = list[FingerTarget]()
    for contact in contacts:
        for target in by_key.get(contact.key, ()):
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


def _restricted(selection: Selection, keys: Set[ContactKey]) -> Selection:
    """Return a selection with the contents of some fingers alone, by key; the others are quiet."""
    if selection.target_keys <= keys:
        return selection
    targets = [finger for finger in selection.targets if finger.contact.key in keys]
    others = [finger.contact for finger in selection.targets if finger.contact.key not in keys]
    contents = [
        content for content in selection.contents if not keys.isdisjoint(content.contact_keys)
    ]
    unserved = [finger for finger in selection.unserved if finger.contact.key in keys]
    return replace(
        selection,
        targets=tuple(targets),
        quiet=(*selection.quiet, *others),
        contents=tuple(contents),
        unserved=tuple(unserved),
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
