"""Selection: from a haptic intent to the contents of a table that realise it, and when to ask anew.

One question is answered at a time, with the fingers as they are when the one before was answered.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from operator import itemgetter

from controller.play.ahead import STRETCH
from controller.play.answer_thread import MAX_LATE, TIME_LIMIT, AnswerThread
from controller.play.capabilities import PlaybackCapabilities
from controller.play.chooser import (
    Choice,
    ChoiceRequest,
    Chooser,
    Intention,
    is_alone,
    unanswered,
)
from controller.play.content import (
    BEING_CHOSEN,
    Content,
    Prediction,
    Selection,
    Targets,
    foreign_at,
    no_layer_free,
    not_served,
)
from controller.play.intent import FADED_AFTER, HapticIntent, Target
from controller.play.layers import CROSSFADE, FALL_AFTER
from controller.sources.contacts import Contact, ContactKey
from model.answer.plan import MAX_SEPARATE
from model.drive_modes import UNRESTRICTED
from model.table.table import LocalizationTable

# Bending wavelengths are 17 cm and more below 500 Hz; a fingertip that has moved by about its own
# radius is still within the disc that the pattern was chosen for. One that moves is answered for
# this way ahead.
MOVE_TOLERANCE = STRETCH

# s; fingers of which none has come, left or moved further for so long rest.
_RESTS_AFTER = 0.1

CROSSFADE_INTERVAL = 0.4
"""Time [s] from one step of a way to a better answer to the next, each of another finger."""

MIN_INTERVAL = 1.0
"""Time [s] from the last step of such a way to the next way."""

GIVEN_UP = f"no answer within {TIME_LIMIT:g} s for these fingers; lift or move one to ask again"
BLOCKED = (
    f"{MAX_LATE} answers are still computed that took more than {TIME_LIMIT:g} s; touch with one "
    "finger, and restart the daemon if it lasts"
)

_UNANSWERED = (GIVEN_UP, BLOCKED)

_NOTHING = Selection((), ())
_SOON = 5.0  # s; of a course whose answer takes no longer than one of what lasts, nearly
_FADES_FOR = FALL_AFTER + CROSSFADE + FADED_AFTER  # s; what a step leads away from


def _is_met_by(intended: Intention, chosen: Selection) -> bool:
    """Whether what was chosen also serves what lasts of what is intended now."""
    if not (chosen.targets and _is_part_of(intended, chosen, _targets_of)):
        return False
    is_whole, then = chosen.is_whole, chosen.contacts
    now = {each.key: each for each in intended.contacts}
    same = now.keys() <= then.keys() if is_whole else now.keys() == then.keys()
    follows = not is_alone(intended.lasting, intended.protected)
    return same and all(
        math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
        and contact.load == then[key].load
        and (key in intended.protected) == (key in chosen.protected)
        and not (follows and _has_set_out(contact, then[key]))
        for key, contact in now.items()
    )


def _has_set_out(now: Contact, then: Contact) -> bool:
    """Whether a contact that rested then is under way, and to be answered for the way ahead."""
    has_moved = (now.x, now.y) != (then.x, then.y)
    return has_moved and now.motion.is_under_way and not then.motion.is_under_way


def _is_among(intended: Intention, chosen: Selection) -> bool:
    """Whether all contacts were there when it was chosen, and have not lifted since."""
    then = {(each.key, each.since) for each in chosen.contacts.values()}
    return all((each.key, each.since) in then for each in intended.contacts)


def _is_part_of(
    intended: Intention, chosen: Selection, kinds: Callable[[Targets], set[Target]]
) -> bool:
    """Whether what lasts was chosen, and no more that would leave others more if it ended."""
    now, had = kinds(intended.lasting), kinds(chosen.targets)
    return now == had or (now < had and chosen.is_whole)


def _targets_of(targets: Targets) -> set[Target]:
    return set(map(itemgetter(1), targets))


def _of_any_level(targets: Targets) -> set[Target]:
    return {replace(target, level_db_sl=None) for _, target in targets}


def _is_long(targets: Targets) -> bool:
    """Whether any course is answered in more time than the control loop has."""
    return any(each.course is not None and each.course.duration > _SOON for _, each in targets)


def _of_any_course(targets: Targets) -> set[Target]:
    return {
        replace(target, pulse=None, modulation_hz=None, course=None)
        for target in _of_any_level(targets)
    }


class Selector:
    """Chooses the contents of a table that realise an intent for the contacts on its plate.

    Each target has its own: all that last are chosen together, in a thread where they are several;
    a short pulse is chosen alone beside them, and never changed. What lasts stays as long as its
    targets and their levels do, no contact has moved more than 8 mm, none of several has set out,
    and none has another load, which changes by a factor of 1.5 or more. A contact that lifts, or
    whose effect ends, leaves the others as they are. Once all rest, contents are led to a better
    answer, if there is one, a step after the other, until anything changes: fingers, the table with
    its clocks, or what the amplifiers allow. Where a finger was held back before that, all are
    chosen anew. An answer that takes too long is given up: all that lasts is silent until its
    fingers change, or until that answer has ended at last. chooser: answers the next question; what
    the thread computes goes on by the former one. arrived: called when the thread is done;
    may_lead: whether contents may be led to from what plays at a time [s].
    """

    def __init__(
        self,
        chooser: Chooser,
        *,
        arrived: Callable[[], None] = lambda: None,
        may_lead: Callable[[Sequence[Content], float], bool] = lambda contents, now: True,
    ) -> None:
        self.chooser, self._may_lead = chooser, may_lead
        self._thread: AnswerThread[Choice] = AnswerThread(arrived, self._request_again)
        self._lasting = _NOTHING  # as it was chosen, for fingers that have left it, too
        self._short: dict[ContactKey, Selection] = {}
        self._fingers: dict[ContactKey, float] = {}  # of what lasts, down since [s]
        self._is_limited = False  # what lasts, by pulses that play
        self._situation: object = None
        self._requested: object = None  # the situation in which what lasts was requested last
        self._steps: Sequence[Selection] = ()  # to a better answer
        self._led_at = -math.inf  # s; by the last step
        self._fading = _NOTHING  # what plays until that has been taken
        self.requests = 0
        """How often the thread was asked."""
        self.due = math.inf
        """When [s] to select anew though no contact changes: all rest, or pulses have ended."""

    @property
    def is_choosing(self) -> bool:
        """Whether the thread computes."""
        return self._thread.is_busy

    def select(
        self,
        contacts: Sequence[Contact],
        intent: HapticIntent,
        capabilities: PlaybackCapabilities,
        *,
        now: float = math.inf,
    ) -> Selection:
        """Return the selection for contacts in their order of arrival; equal if it is kept.

        While the thread computes, what played and is still to be felt stays. now [s]: infinite
        where fingers do not move.
        """
        by_key = defaultdict[ContactKey, list[Target]](list)
        for target in intent.targets:
            by_key[target.key].append(target)
        # Lists: a generator would be a call for each.
        targets = tuple([(one, each) for one in contacts for each in by_key.get(one.key, ())])
        served, skipped = _within_layers(targets, capabilities)
        lasting, short = list[tuple[Contact, Target]](), list[tuple[Contact, Target]]()
        before, self._fingers, came = self._fingers, {}, set[ContactKey]()
        for contact, target in served:
            if target.is_short:
                short.append((contact, target))
                continue
            lasting.append((contact, target))
            self._fingers[contact.key] = contact.since
            if before.get(contact.key) != contact.since:
                came.add(contact.key)
        intended = Intention(tuple(contacts), tuple(lasting), tuple(short), intent.protected)
        back = came.intersection([contact.key for contact, _ in self._lasting.targets])
        if back and not _is_met_by(intended, self._lasting):  # who has come back may be elsewhere
            self._lasting = _felt(self._lasting, self._lasting.target_keys - back)
        situation = *_situation_of(intended), self.chooser.table, capabilities
        if situation != self._situation:
            self._situation = situation
            self._rest_again(now)
        arrived = self._thread.take() if self._thread.is_busy else None
        if arrived is not None:
            is_late = self._requested is None or not self._is_intended(arrived, intended)
            self._take(arrived, now, is_late=is_late)
        pulses, self._short = self._short, {}
        for contact, target in short:
            pulse = pulses.get(contact.key)
            if pulse is not None and pulse.targets[0][1] == target:
                self._short[contact.key] = pulse
        if not contacts:
            self._lasting = _NOTHING
        if self._thread.is_busy:
            self.due = now + _RESTS_AFTER if self.due <= now else self.due
        else:
            chooser = self.chooser
            for requested in self._to_request(
                intended, pulses, now, has_waited=arrived is not None
            ):
                if requested.intended.lasting:
                    self._requested = situation
                if not requested.takes_long:
                    self._take(chooser.choose(requested, capabilities), now)
                elif self._thread.is_blocked:
                    self._take(unanswered(requested, BLOCKED), now)
                else:
                    self.requests += 1
                    self._thread.compute(
                        partial(chooser.choose, requested, capabilities),
                        instead=unanswered(requested, GIVEN_UP),
                    )
        parts = [_felt(self._lasting, self._fingers.keys()), *self._short.values()]
        found = _together(contacts, targets, parts, skipped, intent.reason, self.chooser.table)
        if self._thread.is_busy and len(found.predictions) < len(by_key):
            reason = found.reason or (None if found.contents else BEING_CHOSEN)
            found = replace(found, is_pending=True, reason=reason)
        return found

    def choose_anew(self) -> None:
        """Choose anew what lasts, silent until then; what the thread computes is not taken."""
        self._lasting, self._steps, self._requested = _NOTHING, (), None

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

    def _request_again(self) -> None:
        """Ask anew for fingers that were left without an answer, since one has ended."""
        if self._lasting.reason in _UNANSWERED:
            self._lasting = _NOTHING

    def _to_request(
        self,
        intended: Intention,
        pulses: Mapping[ContactKey, Selection],
        now: float,
        *,
        has_waited: bool,
    ) -> Iterator[ChoiceRequest]:
        """Yield what is to be asked now, one after the other; pulses: of all fingers, until now.

        A pulse that has waited for the thread goes before what lasts, for which it would be late.
        """
        lasting = intended.lasting
        is_kept = not lasting or _is_met_by(intended, self._lasting)
        new = tuple([each for each in intended.short if each[0].key not in self._short])
        is_due, takes_long = self.due < math.inf and self.due <= now, False
        if is_due:
            self.due = math.inf
            is_kept = is_kept and not self._is_limited  # by pulses that have ended
            if self._requested != self._situation and any(
                each.contact.key in self._fingers for each in self._lasting.not_served
            ):
                is_kept = False
        if lasting:
            takes_long = not is_alone(lasting, intended.protected) or _is_long(lasting)
        is_rested = is_due and is_kept and takes_long
        if is_rested and any(target.course for _, target in lasting):  # which no cross-fade follows
            is_rested = False
        if is_rested:
            velocities = [each.motion.velocity(now) for each in intended.contacts]
            if new or self._playing(now) or any(map(any, velocities)):
                self._rest_again(now)
                is_rested = False
        if is_rested and self._steps:
            self._lead(now)
            return
        if is_kept and not is_rested and not new:
            return
        felt = _felt(self._lasting, self._fingers.keys())
        parts = [felt] if is_rested else [felt, *pulses.values()]
        before = {each.key: each for part in parts for each in part.contents}
        if new and (has_waited or is_kept):
            pulses_alone = replace(intended, lasting=(), short=new)
            fading = self._fading if now < self._led_at + _FADES_FOR else _NOTHING
            kept = felt, *self._playing(now)
            yield ChoiceRequest(pulses_alone, before, kept, fading=fading)
            new = ()
        if is_kept and not is_rested:
            return
        if not is_rested:
            self._rest_again(now)
        yield ChoiceRequest(
            replace(intended, short=new),
            before,
            self._playing(now),
            takes_long,
            is_rested,
            now,
        )

    def _playing(self, now: float) -> tuple[Selection, ...]:
        """Return the short pulses that have not ended at a time [s]."""
        parts = self._short.values()
        return tuple([part for part in parts if any(now < each.end for each in part.pulses)])

    def _is_intended(self, chosen: Choice, intended: Intention) -> bool:
        """Whether what was chosen to last is for those that are on the plate by now.

        Places may have changed since, and what effects change, or a program that plays them again:
        else such a finger would get nothing. Those of another layout are not played. What plays may
        do again, since a finger that came has lifted meanwhile.
        """
        found = chosen.lasting
        if found is not None and found.reason in _UNANSWERED:
            return True  # in doubt nothing plays
        return (
            found is not None
            and (
                self._is_limited
                or self._requested == self._situation
                or not _is_met_by(intended, self._lasting)
            )
            and _is_among(intended, found)
            and intended.protected <= found.protected
            and _of_any_course(intended.lasting) <= _of_any_course(found.targets)
        )

    def _take(self, chosen: Choice, now: float, *, is_late: bool = False) -> None:
        """Take what was chosen, at a time [s]; is_late: without what lasts."""
        self._short = {**self._short, **chosen.short}
        if chosen.steps and self._requested == self._situation:
            self._steps, self.due = chosen.steps, now
        if chosen.lasting is not None and not is_late:
            self._lasting, self._is_limited = chosen.lasting, chosen.is_limited
            if self._lasting.reason in _UNANSWERED:
                self.due = math.inf
            if chosen.is_limited:
                ends = [pulse.end for part in chosen.requested.kept for pulse in part.pulses]
                self.due = max(ends) + FADED_AFTER


def _situation_of(intended: Intention) -> tuple[object, ...]:
    """Equal as long as the same fingers are to feel the same of what lasts, in any places."""
    contacts = frozenset([(each.key, each.since, each.load) for each in intended.contacts])
    return contacts, _targets_of(intended.lasting), intended.protected


def _together(
    contacts: Sequence[Contact],
    targets: Targets,
    parts: Sequence[Selection],
    skipped: tuple[Prediction, ...],
    reason: str,
    table: LocalizationTable,
) -> Selection:
    """Join what was chosen apart, contacts as they were then; reason: why there are no targets."""
    chosen: list[Selection] = []
    for part in parts:
        if part.targets:
            chosen.append(part)
    if len(chosen) == 1 and len(chosen[0].targets) == len(targets):
        return chosen[0]
    restated = []
    for part in chosen:
        restated.append(part.beside([each for each in chosen if each is not part], table))
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
    """Return what was chosen, without the contents of all fingers but some, by key."""
    targets, quiet, contents = list[tuple[Contact, Target]](), [*chosen.quiet], list[Content]()
    for contact, target in chosen.targets:
        if contact.key in keys:
            targets.append((contact, target))
        else:
            quiet.append(contact)
    if len(targets) == len(chosen.targets):
        return chosen
    for content in chosen.contents:
        for contact, _ in content.targets:
            if contact.key in keys:
                contents.append(content)
                break
    return replace(
        chosen,
        targets=tuple(targets),
        quiet=tuple(quiet),
        contents=tuple(contents),
        not_served=tuple([each for each in chosen.not_served if each.contact.key in keys]),
    )


def _within_layers(
    targets: Targets, capabilities: PlaybackCapabilities
) -> tuple[Targets, tuple[Prediction, ...]]:
    """Leave out targets for which there is no layer: of the lowest priority, then the earliest.

    Before these short pulses of fingers that feel what lasts. Many that may share have one layer
    together.
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

    def rank(number: int) -> tuple[bool, int, int]:
        _, target = targets[number]
        return not (target.is_short and target.key in lasting), target.priority, number

    for at in sorted(range(len(targets)), key=rank, reverse=True):
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
