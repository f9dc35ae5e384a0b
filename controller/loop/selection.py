"""Selection: from a haptic intent to the contents of a table that realise it."""

import contextlib
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from controller.loop.answer_thread import AnswerThread
from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.content import (
    Content,
    Prediction,
    Selection,
    no_layer_free,
    not_served,
)
from controller.loop.intent import HapticIntent, Target
from controller.loop.joint_answer import LIMITS_LEAVE_NOTHING, Shape, query_jointly
from controller.loop.table_query import TableAnswer, query_table
from controller.sources.contacts import Contact, ContactKey
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.finger.perception import decibels
from model.table.effect_level import EffectLevels
from model.table.pattern import IMPERCEPTIBLE_DB_SL, Pattern
from model.table.question import Question
from model.table.request import verdict_of
from model.table.table import LocalizationTable
from registry.plugins import failure_text

# Bending wavelengths are 17 cm and more below 500 Hz; a fingertip that has moved by about its own
# radius is still within the disc that the pattern was chosen for.
MOVE_TOLERANCE = 0.008

# s; a finger that has not moved further for so long rests, and contents are chosen anew for it.
_RESTS_AFTER = 0.1

# A step of a ramp or texture may be this far [dB] below its level before its frequency changes.
_STEP_SHORT_OF = 1.0

_QUIETER = "lower its level, or lift that finger"

_logger = logging.getLogger(__name__)

Targets = tuple[tuple[Contact, Target], ...]
_NOTHING = Selection((), ())


def unshaped(question: Question, pattern: Pattern, is_continued: bool) -> Pattern:
    """Return a pattern as it is."""
    return pattern


@dataclass(frozen=True)
class _Chosen:
    """What lasts, chosen together, and each short pulse that began with it.

    lasting: None where what lasts was kept; triggered_at [s]: when the change arrived; is_rested:
    whether what plays would do, too, but kept its frequencies while a finger moved.
    """

    lasting: Selection | None
    short: Mapping[ContactKey, Selection]
    triggered_at: float
    is_rested: bool = False


class Selector:
    """Chooses the contents of a table that realise an intent for the contacts on its plate.

    Each target has its own: all that last are chosen together, in a thread where they are several;
    a short pulse is chosen alone beside them, and never changed. What lasts stays as long as its
    targets and their levels do, no contact has moved more than 8 mm, and none has another load,
    which changes by a factor of 1.5 or more. A contact that lifts, or whose effect ends, leaves the
    others as they are: a change would be felt. levels: None for steady levels only; shape: adds
    envelopes to what is chosen in the thread, which calls arrived when it is done.
    """

    def __init__(
        self,
        table: LocalizationTable,
        levels: EffectLevels | None = None,
        *,
        shape: Shape = unshaped,
        arrived: Callable[[], None] = lambda: None,
    ) -> None:
        self._table, self._levels, self._shape = table, levels, shape
        self._thread: AnswerThread[_Chosen] = AnswerThread(arrived)
        self._lasting = _NOTHING
        self._before_pulses = _NOTHING  # what lasts, with that of fingers whose pulse plays instead
        self._chosen_last = _NOTHING  # of what lasts, by the thread since it has been busy
        self._short: Mapping[ContactKey, Selection] = {}
        self._current = _NOTHING
        self.triggered_at = math.inf
        """When [s] the change arrived whose answer of the thread the last selection has."""
        self.due = math.inf
        """When [s] to select anew though no contact changes, since a finger that moved rests."""
        self._requested: tuple[Selection, Targets] = (_NOTHING, ())
        self._protected: frozenset[ContactKey] = frozenset()

    def replace(self, table: LocalizationTable, levels: EffectLevels | None, shape: Shape) -> None:
        """Answer by another table of this plate; the selection stays until its contacts change.

        What the thread computes goes on by the former one, envelopes included.
        """
        self._table, self._levels, self._shape = table, levels, shape
        self._before_pulses = _NOTHING

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
        triggered_at: float = math.inf,
    ) -> Selection:
        """Return the selection for contacts in their order of arrival; the same object if kept.

        While the thread computes, what played and is still to be felt stays. triggered_at [s]: when
        their change arrived.
        """
        by_key = {target.key: target for target in intent.targets}
        # Lists: a generator would be a call for each.
        targets = tuple([(each, by_key[each.key]) for each in contacts if each.key in by_key])
        served, skipped = _within_layers(targets, capabilities)
        lasting = tuple([each for each in served if not each[1].is_short])
        short = tuple([each for each in served if each[1].is_short])
        self.triggered_at = math.inf
        self._protected = intent.protected
        self._adopt(lasting, contacts)
        self._keep_for_pulses(lasting, short, contacts)
        pulses = self._short
        self._short = {
            contact.key: pulses[contact.key]
            for contact, target in short
            if contact.key in pulses and pulses[contact.key].targets[0][1] == target
        }
        new = tuple([each for each in short if each[0].key not in self._short])
        is_kept = not lasting or self._fits(self._lasting, lasting, contacts)
        is_due = self.due < math.inf and self.due <= triggered_at
        is_rested = bool(lasting) and is_due and is_kept and not self._thread.is_busy
        if is_due:
            self.due = triggered_at + _RESTS_AFTER if lasting and not is_rested else math.inf
        if new or is_rested or not is_kept:
            self._choose(
                lasting if is_rested or not is_kept else None,
                new,
                tuple(contacts),
                capabilities,
                pulses,
                triggered_at,
                is_rested=is_rested,
            )
        found = self._together(contacts, targets, skipped, intent.reason)
        if found != self._current:
            self._current = found
        return self._current

    def _adopt(self, lasting: Targets, contacts: Sequence[Contact]) -> None:
        """Take what the thread has chosen, unless other fingers are on the plate by now."""
        chosen = self._thread.take()
        if chosen is None:
            return
        self._short = {**self._short, **chosen.short}
        if chosen.short:
            self.triggered_at = chosen.triggered_at
        if chosen.lasting is not None:
            targets = chosen.lasting.targets
            is_for_all = _is_for(chosen.lasting, contacts)
            # Levels and places may have changed since: else a finger that moves would get nothing.
            # What plays may do again, since a finger that came has lifted meanwhile.
            is_kept = self._fits(self._lasting, lasting, contacts)
            if (
                (chosen.is_rested or not is_kept)
                and is_for_all
                and self._protected <= chosen.lasting.protected
                and {each.key for each, _ in lasting} <= {each.key for each, _ in targets}
            ):
                self._lasting, self.triggered_at = chosen.lasting, chosen.triggered_at

    def _keep_for_pulses(
        self, lasting: Targets, short: Targets, contacts: Sequence[Contact]
    ) -> None:
        """End what lasts of fingers that feel it no more; have it again after a pulse of them."""
        pulsing = {contact.key for contact, _ in short}
        before = self._before_pulses
        if before.contents and {each.key for each, _ in before.targets} <= (
            pulsing | {contact.key for contact, _ in lasting}
        ):
            is_part = all(content in before.contents for content in self._lasting.contents)
            if is_part and self._fits(before, lasting, contacts):
                self._lasting, self._before_pulses = before, _NOTHING
        else:
            self._before_pulses = _NOTHING
            if any(contact.key in pulsing for contact, _ in self._lasting.targets):
                self._before_pulses = self._lasting
        self._lasting = _remaining(self._lasting, lasting)

    def _choose(
        self,
        lasting: Targets | None,
        short: Targets,
        contacts: tuple[Contact, ...],
        capabilities: PlaybackCapabilities,
        pulses: Mapping[ContactKey, Selection],
        triggered_at: float,
        *,
        is_rested: bool,
    ) -> None:
        """Choose for what lasts, None where it is kept, and for new short pulses.

        Several in the thread, and what comes while it is busy, which has the table for itself:
        pulses first, which would be late. pulses: before these.
        """
        is_busy = self._thread.is_busy
        if is_busy and short:
            lasting = None
        if is_busy and self._is_requested(lasting, short, contacts):
            return
        table, levels, shape = self._table, self._levels, self._shape
        before, protected = self._lasting, self._protected
        takes_long = lasting is not None and not _is_quick(lasting, protected)
        is_moving = False
        if lasting is not None and takes_long and not is_rested:
            is_moving = self._has_moved(lasting, contacts)
        if lasting is not None:
            self.due = triggered_at + _RESTS_AFTER if is_moving else math.inf

        def chosen() -> _Chosen:
            found = None
            if lasting is not None:
                found = self._chosen_last = _lasting_of(
                    table,
                    levels,
                    shape,
                    lasting,
                    contacts,
                    capabilities,
                    before,
                    protected,
                    is_moving=is_moving,
                )
            beside = self._chosen_last if _is_for(self._chosen_last, contacts) else before
            playing = {key: each for key, each in pulses.items() if _plays(each, triggered_at)}
            new: dict[ContactKey, Selection] = {}
            for contact, target in short:
                playing.pop(contact.key, None)  # its new one takes its place
                new[contact.key] = playing[contact.key] = _alone(
                    table,
                    levels,
                    contact,
                    target,
                    contacts,
                    capabilities,
                    pulses.get(contact.key),
                    protected,
                    beside=_joined(beside, *playing.values()),
                )
            return _Chosen(found, new, triggered_at, is_rested)

        if not is_busy:
            self._chosen_last = _NOTHING
        if is_busy or takes_long:
            self._requested = Selection(lasting or (), contacts, protected=protected), short
            self._thread.compute(chosen)
            return
        found = chosen()
        self._lasting = found.lasting or self._lasting
        self._short = {**self._short, **found.short}

    def _is_requested(
        self, lasting: Targets | None, short: Targets, contacts: tuple[Contact, ...]
    ) -> bool:
        """Whether the thread computes this already."""
        requested, pulses = self._requested
        if lasting is not None and not self._fits(requested, lasting, contacts):
            return False
        return _intents(short) <= _intents(pulses)

    def _together(
        self,
        contacts: Sequence[Contact],
        targets: Targets,
        skipped: tuple[Prediction, ...],
        reason: str,
    ) -> Selection:
        """Join what lasts and the short pulses beside it."""
        keys = {contact.key for contact, _ in targets}
        quiet = tuple(each for each in contacts if each.key not in keys)
        if not targets:
            return Selection((), quiet, (), reason)
        parts = [part for part in (self._lasting, *self._short.values()) if part != _NOTHING]
        if len(parts) == 1 and {each.key for each, _ in parts[0].targets} == keys:
            return parts[0]
        reasons = [part.reason for part in parts if part.reason is not None]
        levels = [part.quiet_levels for part in parts]
        return Selection(
            targets,
            quiet,
            tuple(content for part in parts for content in part.contents),
            reasons[0] if reasons else None,
            (*(each for part in parts for each in part.not_served), *skipped),
            is_pending=self._thread.is_busy,
            quiet_levels={
                each.key: _sum_db(level[each.key] for level in levels if each.key in level)
                for each in quiet
            },
        )

    def _has_moved(self, lasting: Targets, contacts: Sequence[Contact]) -> bool:
        """Whether those that felt several contents feel them still, in other places."""
        if not _is_for(self._lasting, contacts):
            return False
        of_any_level = [
            {replace(target, level_db_sl=None) for target in _intents(targets)}
            for targets in (lasting, self._lasting.targets)
        ]
        return of_any_level[0] == of_any_level[1]

    def _fits(self, chosen: Selection, lasting: Targets, contacts: Sequence[Contact]) -> bool:
        """Whether what was chosen also serves these targets among these contacts."""
        if _intents(lasting) != _intents(chosen.targets):
            return False
        then = {each.key: each for each in (*(c for c, _ in chosen.targets), *chosen.quiet)}
        now = {each.key: each for each in contacts}
        same = now.keys() <= then.keys() if _is_whole(chosen) else now.keys() == then.keys()
        return same and all(
            math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
            and contact.load == then[key].load
            and (key in self._protected) == (key in chosen.protected)
            for key, contact in now.items()
        )


def _sum_db(levels: Iterable[float]) -> float:
    """Return the level of powers that add up [dB]."""
    power = sum(10 ** (level / 10) for level in levels)
    return 10 * math.log10(power) if power else -math.inf


def _is_quick(lasting: Targets, protected: frozenset[ContactKey]) -> bool:
    """Whether it is one steady content that no finger must not notice."""
    if len(lasting) != 1:
        return False
    ((contact, target),) = lasting
    return protected <= {contact.key} and target.modulation_hz is None


def _plays(pulse: Selection, now: float) -> bool:
    """Whether a short pulse has not ended at a time [s]."""
    return any(target.pulse is not None and now < target.pulse.end for _, target in pulse.targets)


def _joined(*parts: Selection) -> Selection:
    """What plays together, and how strongly contacts feel what others do."""
    levels = [part.quiet_levels for part in parts]
    return Selection(
        (),
        (),
        tuple(content for part in parts for content in part.contents),
        quiet_levels={
            key: _sum_db(level[key] for level in levels if key in level)
            for key in dict.fromkeys(key for level in levels for key in level)
        },
    )


def _intents(targets: Targets) -> set[Target]:
    return {target for _, target in targets}


def _is_for(chosen: Selection, contacts: Sequence[Contact]) -> bool:
    """Whether all contacts were there when it was chosen."""
    then = {each.key for each in (*(contact for contact, _ in chosen.targets), *chosen.quiet)}
    return {each.key for each in contacts} <= then


def _is_whole(chosen: Selection) -> bool:
    """Whether every target feels its own, so that one finger less changes nothing for others."""
    is_each_alone = all(len(content.targets) == 1 for content in chosen.contents)
    return bool(chosen.contents) and is_each_alone and not chosen.not_served


def _remaining(chosen: Selection, lasting: Targets) -> Selection:
    """Return what was chosen, without the contents of fingers that are to feel it no more."""
    keys = {contact.key for contact, _ in lasting}
    gone = tuple(contact for contact, _ in chosen.targets if contact.key not in keys)
    contents = tuple(
        content
        for content in chosen.contents
        if any(contact.key in keys for contact, _ in content.targets)
    )
    if not gone and contents == chosen.contents:
        return chosen
    targets = tuple(each for each in chosen.targets if each[0].key in keys)
    return replace(
        chosen,
        targets=targets if _is_whole(chosen) else (),  # else answered anew: more may be served
        quiet=(*chosen.quiet, *gone),
        contents=contents,
    )


def _within_layers(
    targets: Targets, capabilities: PlaybackCapabilities
) -> tuple[Targets, tuple[Prediction, ...]]:
    """Leave out targets for which there is no layer: of the lowest priority, then the earliest."""
    count, reason = capabilities.layers, no_layer_free(capabilities.layers)
    if capabilities.drive_mode != UNRESTRICTED:
        count = 1
        reason = f"the drive mode {capabilities.drive_mode} plays 1 content at once; lift a finger"
    if len(targets) <= count:
        return targets, ()
    order = sorted(range(len(targets)), key=lambda at: (targets[at][1].priority, at), reverse=True)
    served = {*order[:count]}
    return (
        tuple(each for at, each in enumerate(targets) if at in served),
        tuple(
            not_served(contact, reason)
            for at, (contact, _) in enumerate(targets)
            if at not in served
        ),
    )


def _left_by(
    contents: Sequence[Content], capabilities: PlaybackCapabilities
) -> PlaybackCapabilities:
    """The capabilities with the amplitudes that contents leave."""
    left = dict(capabilities.max_amplitudes)
    for content in contents:
        for name, tone in content.pattern.excitation.items():
            left[name] = max(left[name] - tone.amplitude, 1e-12)
    return replace(capabilities, max_amplitudes=left)


def _power_left(
    table: LocalizationTable, pattern: Pattern, contents: Sequence[Content], max_power: float
) -> float:
    """Return the factor on a pattern for the power that contents leave, their peaks together."""
    strokes = table.strokes
    taken = dict.fromkeys(strokes, 0.0)
    for content in contents:
        for name, tone in content.pattern.excitation.items():
            taken[name] += tone.amplitude / strokes[name]
    own = [tone.amplitude / strokes[name] for name, tone in pattern.excitation.items()]
    left = math.sqrt(max_power) - math.hypot(*taken.values())
    return max(left, 1e-9) / max(math.hypot(*own), 1e-12)


def _lasting_of(
    table: LocalizationTable,
    levels: EffectLevels | None,
    shape: Shape,
    lasting: Targets,
    contacts: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    before: Selection,
    protected: frozenset[ContactKey],
    *,
    is_moving: bool,
) -> Selection:
    """Choose for all targets that last; any failure is their reason for silence."""
    if _is_quick(lasting, protected):
        return _alone(table, levels, *lasting[0], contacts, capabilities, before, protected)
    keys = {contact.key for contact, _ in lasting}
    quiet = tuple(each for each in contacts if each.key not in keys)
    felt = {content.key: content for content in before.contents}
    try:
        return query_jointly(
            table,
            lasting,
            quiet,
            capabilities,
            before=felt,
            shape=shape,
            protected=protected,
            is_moving=is_moving,
        )
    except Exception as error:
        return _failed(lasting, quiet, error)


def _alone(
    table: LocalizationTable,
    levels: EffectLevels | None,
    contact: Contact,
    target: Target,
    contacts: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    before: Selection | None,
    protected: frozenset[ContactKey],
    *,
    beside: Selection = _NOTHING,
) -> Selection:
    """Choose for one target, all others quiet; any failure is its reason for silence.

    before: what was chosen for it; beside: what leaves less of the stroke, and may be felt there.
    """
    targets = ((contact, target),)
    quiet = tuple(each for each in contacts if each.key != contact.key)
    try:
        capabilities = _left_by(beside.contents, capabilities)
        answer = _query(table, levels, contact, target, quiet, capabilities, before)
    except Exception as error:
        return _failed(targets, quiet, error)
    pattern, reason = answer.pattern, None
    left = [
        capabilities.max_amplitudes[name] / tone.amplitude
        for name, tone in pattern.excitation.items()
        if tone.amplitude > 0
    ]
    if math.isfinite(capabilities.max_power):
        left.append(_power_left(table, pattern, beside.contents, capabilities.max_power))
    change = min(0.0, float(decibels(min(left, default=1.0))))
    if change < 0 and answer.felt_db_sl + change < 0:
        reason = LIMITS_LEAVE_NOTHING
        if beside.contents:
            reason = "the contents of other fingers use the whole stroke; lift a finger"
    felt, promised = answer.felt_db_sl + change, answer.promised_contrast_db
    leak = -math.inf if promised is None else felt - promised
    if protected - {contact.key} and leak > IMPERCEPTIBLE_DB_SL:
        reason = f"a protected finger would notice it, up to {leak:.1f} dB SL; {_QUIETER}"
    if reason is not None:
        return Selection(targets, quiet, (), reason, (not_served(contact, reason),))
    content = Content(targets, answer.question, pattern.scaled(change) if change else pattern, ())
    others = beside.quiet_levels.get(contact.key)
    if others is not None:
        promised = min(math.inf if promised is None else promised, felt - others)
    predicted = Prediction(
        contact,
        felt,
        pattern.contrast_db,
        verdict_of(promised),
        promised_contrast_db=promised,
        foreign_level_db_sl=others,
        frequency=content.frequency,
        content=target.content,
    )
    return Selection(
        targets,
        quiet,
        (replace(content, predictions=(predicted,)),),
        quiet_levels={each.key: leak for each in quiet},
        protected=protected,
    )


def _query(
    table: LocalizationTable,
    levels: EffectLevels | None,
    contact: Contact,
    target: Target,
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    before: Selection | None,
) -> TableAnswer:
    """Query the table; a level that changes keeps its frequency where that reaches it."""
    kept = None if before is None else _continued(target, before)
    if kept is not None:
        tuned = replace(target, band=(kept, kept))
        with contextlib.suppress(InputError):
            answer = query_table(table, contact, tuned, quiet, capabilities, levels)
            if answer.felt_db_sl >= (target.level_db_sl or 0.0) - _STEP_SHORT_OF:
                return answer
    return query_table(table, contact, target, quiet, capabilities, levels)


def _continued(new: Target, before: Selection) -> float | None:
    """Return the frequency [Hz] that plays if only the level of its target changes; else None."""
    for content in before.contents:
        for _, old in content.targets:
            is_step = new != old and new == replace(old, level_db_sl=new.level_db_sl)
            if is_step and new.level_db_sl is not None and not (new.pulse and new.pulse.is_raised):
                return content.frequency
    return None


def _failed(targets: Targets, quiet: tuple[Contact, ...], error: Exception) -> Selection:
    """What is selected where a question fails: silence, and why."""
    if isinstance(error, InputError):
        reason = str(error)
    else:
        _logger.error("loop: table failed, silencing its targets", exc_info=error)
        reason = failure_text(error)
    skipped = tuple(not_served(contact, reason) for contact, _ in targets)
    return Selection(targets, quiet, (), reason, skipped)
