"""Selection: from a haptic intent to the contents of a table that realise it, and when to ask anew.

All contents that last are chosen together, by one answer of the table; each short pulse is chosen
alone, beside what lasts: with the stroke and the power that this leaves, all other fingers quiet,
30 Hz from all that plays where its band allows it. What lasts at its own finger goes on. A pulse is
over before an answer for all would help, so it is never changed. Contents that last and do not fit
beside a pulse that plays get what it leaves, until it has ended.

One choice is made at a time, for the fingers as they are when the one before was made.
"""

import asyncio
import logging
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import TypeAlias

from controller.play.intent import (
    BEING_CHOSEN,
    FADED_AFTER,
    NOTHING,
    Content,
    HapticIntent,
    Prediction,
    Question,
    Selection,
    Target,
    Targets,
    foreign_at,
    no_layer_free,
    not_served,
)
from controller.play.joint_answers import (
    LIMITS_LEAVE_NOTHING,
    STRETCH,
    Crossfades,
    Shape,
    answered,
    selection_of,
)
from controller.play.routing import PlaybackCapabilities
from controller.play.slots import CROSSFADE, FALL_AFTER
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import APART_HZ, Answer
from model.answer.plan import MAX_SEPARATE, scaled
from model.arrays import NEARLY
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.table.table import SAME_FREQUENCY, LocalizationTable
from registry.plugins import failure_text
from registry.threads import DaemonThreads

_USED_UP = "the contents of other fingers use the whole stroke; lift a finger"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chooser:
    """Chooses contents by a table; shape: adds envelopes to those of a joint answer."""

    table: LocalizationTable
    shape: Shape | None = None

    def choose(
        self, question: Question, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, ...]:
        """Return the selection of what lasts, then one for each short pulse of a question.

        Where all rest, return the selections on the way from what plays to what promises more, one
        after the other; none on any failure.
        """
        if question.is_rested:
            try:
                return Crossfades(self.table, question, capabilities, self.shape).steps()
            except Exception as error:
                _logger.error("loop: table failed, keeping what plays", exc_info=error)
                return ()
        found = [self._lasting(question, capabilities)] if question.lasting else []
        kept = [*question.kept, *found]
        for each in question.short:
            beside = [*kept, question.fading]
            left = self._left_by(_contents(beside), capabilities)
            kept.append(self._chosen(question, (each,), left, beside))
            found.append(kept[-1].beside([question.fading], self.table))
        return tuple(found)

    def _lasting(self, question: Question, capabilities: PlaybackCapabilities) -> Selection:
        """Choose what lasts; it is limited by pulses that play.

        Beside these what it replaces fades, too.
        """
        targets = question.lasting
        free = self._chosen(question, targets, capabilities)
        pulses = _contents(question.kept) if question.kept else []
        if not pulses:
            return free
        fading = [
            one
            for (finger, _), one in question.before.items()
            if finger in free.target_keys and one not in pulses
        ]
        left = self._left_by([*pulses, *fading], capabilities)
        total = [each.layer for each in free.contents]
        if left.limits.factor_within(total, self.table) >= 1 - NEARLY:
            return free
        limited = self._chosen(question, targets, left)
        if not limited.contents:
            limited = question.silent(targets, _USED_UP)
        return replace(limited, is_limited=True)

    def _left_by(
        self, contents: Sequence[Content], capabilities: PlaybackCapabilities
    ) -> PlaybackCapabilities:
        """Return what contents leave of the amplifiers' limits."""
        if not contents:
            return capabilities
        return capabilities.left_by([each.layer for each in contents], self.table)

    def _chosen(
        self,
        question: Question,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection] = (),
    ) -> Selection:
        """Choose for targets within capabilities; any failure is their reason for silence.

        beside: selections that a pulse is felt beside.
        """
        raised, avoided = targets, list[float]()
        if beside:
            raised = tuple([(contact, _over(to, contact, beside)) for contact, to in targets])
            excitations = [content.layer.excitation.values() for content in _contents(beside)]
            avoided = [*{tone.frequency for tones in excitations for tone in tones}]
        is_long = question.takes_long and not targets[0][1].is_short
        try:
            answer = answered(
                self.table,
                question,
                raised,
                capabilities,
                keeps=is_long or _is_step(targets, question.before),
                now=question.now if is_long else math.inf,
                avoided_hz=avoided,
            )
            if not is_long:
                answer = _alike(answer, raised[0][1])
            found = selection_of(
                self.table,
                question,
                answer,
                targets,
                shape=self.shape if is_long else None,
                is_in_phase=is_long,
            )
            if avoided:
                found = _among(question, found, avoided)
        except Exception as error:
            if isinstance(error, InputError):
                reason = str(error)
            else:
                _logger.error("loop: table failed, silencing its targets", exc_info=error)
                reason = failure_text(error)
            found = question.silent(targets, reason)
        return found


def _is_step(targets: Targets, before: Mapping[tuple[ContactKey, int], Content]) -> bool:
    """Whether all that changes is the level of a single target that is not raised."""
    ((contact, new),) = targets
    then = before.get((contact.key, new.voice))
    if then is None or new.level_db_sl is None or (new.pulse and new.pulse.is_raised):
        return False
    old = then.targets[0][1]
    return new != old and new == replace(old, level_db_sl=new.level_db_sl)


def _alike(found: Answer, target: Target) -> Answer:
    """Return an answer whose level in a band is the same wherever the finger is.

    The margin for other plates, by which the level exceeds the promise, differs between places.
    """
    is_level = target.level_db_sl is not None and not (target.pulse and target.pulse.is_raised)
    if not (is_level and target.band and found.layers):
        return found
    excess = found.fingers[0].level_db_sl - (target.level_db_sl or 0.0)
    return scaled(found, -excess) if excess > 0 else found


def _over(target: Target, contact: Contact, beside: Sequence[Selection]) -> Target:
    """Return the target of a short pulse, raised as far as it must be above what lasts there."""
    level, above = target.level_db_sl, target.above_db
    if level is None or above is None:
        return target
    for each in _contents(beside):
        for felt in each.predictions:
            if felt.contact.key == contact.key and felt.nominal_db_sl is not None:
                level = max(level, felt.nominal_db_sl + above)
    return replace(target, level_db_sl=level)


def _among(question: Question, found: Selection, frequencies: Sequence[float]) -> Selection:
    """Return the selection for a pulse among vibrations of some frequencies [Hz].

    It is mixed where it is nearer than 30 Hz to one of them.
    """
    if not found.contents:
        is_used_up = found.reason == LIMITS_LEAVE_NOTHING
        return question.silent(found.targets, _USED_UP) if is_used_up else found
    (content,) = found.contents
    gap = min([abs((content.frequency or 0.0) - each) for each in frequencies])
    if gap >= APART_HZ - SAME_FREQUENCY:
        return found
    mixed = tuple([replace(each, is_apart=False).judged() for each in content.predictions])
    return replace(found, contents=(replace(content, predictions=mixed),))


def _contents(parts: Iterable[Selection]) -> list[Content]:
    return [content for part in parts for content in part.contents]


TIME_LIMIT = 1.0
"""Time [s] after which a choice is given up; it takes some tens of milliseconds."""

MAX_LATE = 2
"""Choices that may still be computed after they were given up; until one ends none is begun."""

# Bending wavelengths are 17 cm and more below 500 Hz; a fingertip that has moved by about its own
# radius is still within the disc that the pattern was chosen for. One that moves is answered for
# this way ahead.
MOVE_TOLERANCE = STRETCH

# s; fingers of which none has come, left or moved further for so long rest.
_RESTS_AFTER = 0.1

CROSSFADE_INTERVAL = 0.4
"""Time [s] between two steps on the way to a better answer, each of another finger."""

MIN_INTERVAL = 1.0
"""Time [s] from the last step on such a way to the first on the next."""

GIVEN_UP = f"no answer within {TIME_LIMIT:g} s for these fingers; lift or move one to ask again"
BLOCKED = (
    f"{MAX_LATE} answers are still computed that took more than {TIME_LIMIT:g} s; touch with one "
    "finger, and restart the daemon if it lasts"
)

_UNANSWERED = (GIVEN_UP, BLOCKED)

_FADES_FOR = FALL_AFTER + CROSSFADE + FADED_AFTER  # s; what a step leads away from


def _is_met_by(intended: Question, chosen: Selection) -> bool:
    """Whether what was chosen also serves what lasts of what is intended now."""
    is_whole, then = chosen.is_whole, chosen.contacts
    requested, had = _targets_of(intended.lasting), _targets_of(chosen.targets)
    # Others would gain from the end of one only where fingers share or are not served.
    if not (had and (requested == had or (requested < had and is_whole))):
        return False
    now = {each.key: each for each in intended.contacts}
    hands = {key for key, contact in then.items() if contact.is_hand}
    same = hands <= now.keys() <= then.keys() if is_whole else now.keys() == then.keys()
    follows = not intended.is_alone
    return same and all(
        math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
        and (contact.load, contact.is_surplus) == (then[key].load, then[key].is_surplus)
        and (key in intended.protected) == (key in chosen.protected)
        and not (follows and _has_set_out(contact, then[key]))
        for key, contact in now.items()
    )


def _has_set_out(now: Contact, then: Contact) -> bool:
    """Whether a contact that rested then is under way, and to be answered for the way ahead."""
    has_moved = (now.x, now.y) != (then.x, then.y)
    return has_moved and now.motion.is_under_way and not then.motion.is_under_way


def _targets_of(targets: Targets) -> set[Target]:
    return set(map(itemgetter(1), targets))


def _of_any_course(targets: Targets) -> set[Target]:
    """Return targets without what may differ in a late choice: level, pulse, course."""
    return {
        replace(target, level_db_sl=None, pulse=None, modulation_hz=None, course=None)
        for _, target in targets
    }


_Choosing: TypeAlias = "asyncio.Future[tuple[Selection, ...]]"
"""The selections of a question, made in the thread."""


class Selector:
    """Keeps a selection for the contacts on a plate, and chooses anew where it no longer serves.

    Each target has contents of its own: all that last are chosen together, in a thread where they
    are several; a short pulse is chosen alone beside them, and never changed. What lasts is kept as
    long as its targets and their levels are the same, no contact has moved more than 8 mm, none of
    several has set out, and none has another load, which changes by a factor of 1.5 or more. A
    contact that lifts, or whose effect ends, leaves the others as they are.

    Once all rest, contents are led to a better answer, if there is one, a step after the other,
    until anything changes: fingers, the table with its clocks, or the limits of the amplifiers.
    Where a finger was held back before that, all are chosen anew. A choice that takes too long is
    given up: all that lasts is silent until its fingers change, or until that choice has ended.

    chooser: makes the next choice; a choice in the thread goes on by the former one. arrived:
    called when the thread is done; may_lead: whether contents may be led to from what plays at a
    time [s].
    """

    def __init__(
        self,
        chooser: Chooser,
        *,
        arrived: Callable[[], None] = lambda: None,
        may_lead: Callable[[Sequence[Content], float], bool] = lambda contents, now: True,
    ) -> None:
        self.chooser, self._arrived, self._may_lead = chooser, arrived, may_lead
        self._threads = DaemonThreads()
        self.pending: tuple[Question, _Choosing] | None = None
        """What is chosen in the thread, or not taken yet: one question at a time."""
        self._late = set[_Choosing]()  # given up, and still computed
        self._lasting = NOTHING  # as it was chosen, for fingers that have left it, too
        self._short: dict[ContactKey, Selection] = {}
        self._fingers: dict[ContactKey, float] = {}  # of what lasts, down since [s]
        self._situation: object = None
        self._requested: object = None  # the situation in which what lasts was requested last
        self._steps: Sequence[Selection] = ()  # to a better answer
        self._led_at = -math.inf  # s; by the last step
        self._fading = NOTHING  # what plays until that has been taken
        self.due = math.inf
        """Time [s] to select anew though no contact changes: all rest, or pulses have ended."""

    def select(
        self,
        contacts: Sequence[Contact],
        intent: HapticIntent,
        capabilities: PlaybackCapabilities,
        *,
        now: float = math.inf,
    ) -> Selection:
        """Return the selection for contacts in their order of arrival; an equal one if it is kept.

        While the thread computes, contents that play and are still wanted stay. now [s]: infinite
        where fingers do not move.
        """
        by_key = defaultdict[ContactKey, list[Target]](list)
        for target in intent.targets:
            by_key[target.key].append(target)
        # Lists: a generator would be a call for each.
        targets = tuple([(one, each) for one in contacts for each in by_key.get(one.key, ())])
        served, skipped = _within_layers(targets, capabilities)
        short = tuple([each for each in served if each[1].is_short])
        lasting = tuple([each for each in served if each not in short]) if short else served
        intended = Question(tuple(contacts), lasting, short, intent.protected)
        before, self._fingers = self._fingers, {one.key: one.since for one, _ in lasting}
        back = dict(self._fingers.items() - before.items()).keys() & self._lasting.target_keys
        if back and not _is_met_by(intended, self._lasting):  # who has come back may be elsewhere
            self._lasting = _felt(self._lasting, self._lasting.target_keys - back)
        fingers = frozenset([(each.key, each.since, each.load) for each in contacts])  # not places
        requested = _targets_of(lasting), intent.protected
        situation = fingers, *requested, self.chooser.table, capabilities
        if situation != self._situation:
            self._situation = situation
            self._rest_again(now)
        has_arrived = self.pending is not None and self.pending[1].done()
        if self.pending is not None and has_arrived:
            (question, choosing), self.pending = self.pending, None
            arrived = choosing.result()
            is_late = self._requested is None or not self._is_intended(arrived, intended)
            self._take(question, arrived, now, is_late=is_late)
        pulses, self._short = self._short, {}
        for contact, target in short:
            pulse = pulses.get(contact.key)
            if pulse is not None and pulse.targets[0][1] == target:
                self._short[contact.key] = pulse
        if not contacts:
            self._lasting = NOTHING
        if self.pending is None:
            for question in self._questions(intended, pulses, now, has_waited=has_arrived):
                if question.lasting:
                    self._requested = situation
                self._answer(question, capabilities, now)
        elif self.due <= now:
            self.due = now + _RESTS_AFTER
        parts = [_felt(self._lasting, self._fingers.keys()), *self._short.values()]
        found = _together(contacts, targets, parts, skipped, intent.reason, self.chooser.table)
        if self.pending is not None and len(found.predictions) < len(by_key):
            reason = found.reason or (None if found.contents else BEING_CHOSEN)
            found = replace(found, is_pending=True, reason=reason)
        return found

    def _answer(self, question: Question, capabilities: PlaybackCapabilities, now: float) -> None:
        """Have a question answered at a time [s]: at once, or in the thread where it takes long.

        A choice in the thread that hangs cannot be ended, only given up: its thread holds up
        neither the next choice nor the end of the process, and what it returns is dropped.
        """
        if not question.takes_long:
            self._take(question, self.chooser.choose(question, capabilities), now)
        elif len(self._late) >= MAX_LATE:
            self._take(question, question.unanswered(BLOCKED), now)
        else:
            loop, choose = asyncio.get_running_loop(), self.chooser.choose
            choosing = loop.run_in_executor(self._threads, partial(choose, question, capabilities))
            self.pending = question, choosing
            choosing.add_done_callback(self._note)
            loop.call_later(TIME_LIMIT, self._give_up, question, choosing)

    def _give_up(self, question: Question, choosing: _Choosing) -> None:
        if not choosing.done():
            _logger.warning("loop: answer given up, still computed after %g s", TIME_LIMIT)
            self._late.add(choosing)
            self.pending = question, asyncio.get_running_loop().create_future()
            self.pending[1].set_result(question.unanswered(GIVEN_UP))
            self._arrived()

    def _note(self, choosing: _Choosing) -> None:
        if choosing in self._late:
            self._late.remove(choosing)
            choosing.exception()  # of no interest any more
            if self._lasting.reason in _UNANSWERED:  # asked again
                self._lasting = NOTHING
        self._arrived()

    def choose_anew(self) -> None:
        """Choose anew what lasts: silent until then, and not by a choice that is under way."""
        self._lasting, self._steps, self._requested = NOTHING, (), None

    def _rest_again(self, now: float) -> None:
        """Leave the way to a better answer, if any, until all have rested."""
        self._steps, self.due = (), max(now + _RESTS_AFTER, self._led_at + MIN_INTERVAL)

    def _lead(self, now: float) -> None:
        """Take the next step to a better answer at a time [s], if the amplifiers can."""
        step, *self._steps = self._steps
        if not self._may_lead(step.contents, now):
            self._steps = ()
            return
        new = {(each.key, each.frequency) for each in step.contents}
        old = [each for each in self._lasting.contents if (each.key, each.frequency) not in new]
        if step.contents != self._lasting.contents:
            self._fading, self._led_at = replace(self._lasting, contents=tuple(old)), now
        self._lasting = step
        self.due = now + CROSSFADE_INTERVAL if self._steps else math.inf

    def _questions(
        self,
        intended: Question,
        pulses: Mapping[ContactKey, Selection],
        now: float,
        *,
        has_waited: bool,
    ) -> Iterator[Question]:
        """Yield the questions that are due, one after the other.

        pulses: selections of pulses until now. A pulse that has waited for the thread goes before
        what lasts, after which it would be late.
        """
        lasting, playing, is_rested = intended.lasting, self._playing(now), False
        is_kept = not lasting or _is_met_by(intended, self._lasting)
        new = tuple([each for each in intended.short if each[0].key not in self._short])
        if self.due < math.inf and self.due <= now:
            self.due = math.inf
            held_back = [each.contact.key in self._fingers for each in self._lasting.not_served]
            if self._lasting.is_limited or (self._requested != self._situation and any(held_back)):
                is_kept = is_kept and not lasting  # by pulses that have ended, or limits of before
            # No cross-fade follows a course.
            is_rested = is_kept and intended.takes_long and not any(to.course for _, to in lasting)
            velocities = [each.motion.velocity(now) for each in intended.contacts]
            if is_rested and (new or playing or any(map(any, velocities))):
                self._rest_again(now)
                is_rested = False
        if is_rested and self._steps:
            self._lead(now)
            return
        if is_kept and not (is_rested or new):
            return
        felt = _felt(self._lasting, self._fingers.keys())
        parts = [felt] if is_rested else [felt, *pulses.values()]
        before = {each.key: each for part in parts for each in part.contents}
        if new and (has_waited or is_kept):
            fading = self._fading if now < self._led_at + _FADES_FOR else NOTHING
            kept = felt, *playing
            yield replace(intended, lasting=(), short=new, before=before, kept=kept, fading=fading)
            new, playing = (), self._playing(now)
        if is_kept and not is_rested:
            return
        if not is_rested:
            self._rest_again(now)
        yield replace(
            intended, short=new, before=before, kept=playing, is_rested=is_rested, now=now
        )

    def _playing(self, now: float) -> tuple[Selection, ...]:
        """Return the short pulses that have not ended at a time [s]."""
        parts = self._short.values()
        return tuple([part for part in parts if any(now < each.end for each in part.pulses)])

    def _is_intended(self, chosen: Sequence[Selection], intended: Question) -> bool:
        """Whether a late choice of what lasts still serves the contacts on the plate.

        All must have been there when it was chosen, and not have lifted since. Places, levels and
        courses may have changed, or such a finger would get nothing; the layout may not. It is
        dropped if what plays will do again, since a finger that came has lifted meanwhile.
        """
        found = next(iter(chosen), NOTHING)
        if found.reason in _UNANSWERED:
            return True  # in doubt nothing plays
        return (
            (
                self._lasting.is_limited
                or self._requested == self._situation
                or not _is_met_by(intended, self._lasting)
            )
            and {(each.key, each.since) for each in intended.contacts}
            <= {(each.key, each.since) for each in found.contacts.values()}
            and intended.protected <= found.protected
            and _of_any_course(intended.lasting) <= _of_any_course(found.targets)
        )

    def _take(
        self,
        question: Question,
        chosen: Sequence[Selection],
        now: float,
        *,
        is_late: bool = False,
    ) -> None:
        """Take what was chosen for a question at a time [s]; is_late: without what lasts."""
        if question.is_rested:
            if chosen and self._requested == self._situation:
                self._steps, self.due = chosen, now
            return
        for each in chosen:
            contact, target = each.targets[0]
            if target.is_short:
                self._short[contact.key] = each
            elif not is_late:
                self._lasting = each
                if each.reason in _UNANSWERED:
                    self.due = math.inf
                if each.is_limited:
                    ends = [pulse.end for part in question.kept for pulse in part.pulses]
                    self.due = max(ends) + FADED_AFTER


def _together(
    contacts: Sequence[Contact],
    targets: Targets,
    parts: Sequence[Selection],
    skipped: tuple[Prediction, ...],
    reason: str,
    table: LocalizationTable,
) -> Selection:
    """Join selections made apart, contacts as they were then; reason: why there are no targets."""
    chosen = [part for part in parts if part.targets]
    if len(chosen) == 1 and len(chosen[0].targets) == len(targets):
        return chosen[0]
    restated = [
        part.beside([each for each in chosen if each is not part], table) for part in chosen
    ]
    then = {key: each for part in chosen for key, each in part.contacts.items()}
    keys = {contact.key for contact, _ in targets}
    quiet = [then.get(each.key, each) for each in contacts if each.key not in keys]
    reasons = [part.reason for part in chosen if part.reason is not None]
    return Selection(
        tuple([(then.get(contact.key, contact), target) for contact, target in targets]),
        tuple(quiet),
        tuple([content for part in restated for content in part.contents]),
        next(iter(reasons), None) if targets else reason,
        (*[each for part in restated for each in part.not_served], *skipped),
        foreign_levels={each.key: foreign_at(each.key, chosen) for each in contacts},
    )


def _felt(chosen: Selection, keys: Set[ContactKey]) -> Selection:
    """Return a selection with the contents of some fingers alone, by key."""
    if chosen.target_keys <= keys:
        return chosen
    targets = tuple([each for each in chosen.targets if each[0].key in keys])
    return replace(
        chosen,
        targets=targets,
        quiet=(*chosen.quiet, *[one for one, _ in chosen.targets if one.key not in keys]),
        contents=tuple(
            [
                content
                for content in chosen.contents
                if not keys.isdisjoint([contact.key for contact, _ in content.targets])
            ]
        ),
        not_served=tuple([each for each in chosen.not_served if each.contact.key in keys]),
    )


def _within_layers(
    targets: Targets, capabilities: PlaybackCapabilities
) -> tuple[Targets, tuple[Prediction, ...]]:
    """Split targets into those that have a layer, and predictions for the others.

    Short pulses of fingers that feel what lasts are left out first, then the targets of lowest
    priority, the earliest first. Many that may share have one layer together.
    """
    mode = capabilities.drive_mode
    count = capabilities.layers if mode == UNRESTRICTED else 1
    if len(targets) <= count:
        return targets, ()
    reason = f"the drive mode {mode} plays 1 content at once; lift a finger"
    if mode == UNRESTRICTED:
        reason = no_layer_free(count)
    sharing = Counter([target.shared_as for _, target in targets])
    layers: list[str | bool | None] = []
    served, lasting = set[int](), {target.key for _, target in targets if not target.is_short}
    ranks = [
        (not (target.is_short and target.key in lasting), target.priority, number)
        for number, (_, target) in enumerate(targets)
    ]
    for _, _, at in sorted(ranks, reverse=True):
        name = targets[at][1].shared_as
        is_one = name is not None and sharing[name] > MAX_SEPARATE and mode == UNRESTRICTED
        if is_one and name in layers:
            served.add(at)
        elif len(layers) < count:
            layers.append(name)
            served.add(at)
    return (
        tuple(each for at, each in enumerate(targets) if at in served),
        tuple(
            not_served(contact, reason)
            for at, (contact, _) in enumerate(targets)
            if at not in served
        ),
    )
