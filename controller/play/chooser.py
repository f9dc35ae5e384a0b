"""What is chosen for fingers: one answer for all contents that last, and one for each short pulse.

A pulse is chosen beside what lasts: with the stroke and the power that this leaves, all other
fingers quiet, 30 Hz from all that plays where its band allows it. What lasts at its own finger goes
on. It is over before an answer for all would help, and never changed. What lasts and does not fit
beside a pulse that plays has what that leaves, until it has ended.
"""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from controller.play.capabilities import PlaybackCapabilities
from controller.play.content import Content, Selection, Targets, not_served
from controller.play.crossfades import Crossfades
from controller.play.intent import Target
from controller.play.joint_answer import (
    LIMITS_LEAVE_NOTHING,
    Shape,
    answered,
    selection_of,
)
from controller.sources.contacts import Contact, ContactKey
from model.answer.answer import Answer
from model.answer.promise import scaled
from model.answer.stimulus import APART_HZ
from model.arrays import NEARLY
from model.errors import InputError
from model.table.table import SAME_FREQUENCY, LocalizationTable
from registry.plugins import failure_text

_NOTHING = Selection((), ())
_USED_UP = "the contents of other fingers use the whole stroke; lift a finger"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Intention:
    """Who is to feel what, among contacts: what lasts, and short pulses.

    protected: contacts that must not notice the contents of others.
    """

    contacts: tuple[Contact, ...]
    lasting: Targets
    short: Targets
    protected: frozenset[ContactKey] = frozenset()

    def quiet_beside(self, targets: Targets) -> tuple[Contact, ...]:
        """Return the contacts that are to feel nothing of what these targets feel."""
        quiet = [*self.contacts]
        for contact, _ in targets:
            quiet.remove(contact)
        return tuple(quiet)


@dataclass(frozen=True)
class ChoiceRequest:
    """What is to be chosen; of what is intended only that.

    before: what is felt now, by finger and voice; kept: what plays on beside it; takes_long:
    whether what lasts takes longer than the control loop may wait; is_rested: whether what plays
    would do, too, but may be led to what promises more; now [s]; fading: what played before a
    cross-fade that goes on.
    """

    intended: Intention
    before: Mapping[tuple[ContactKey, int], Content]
    kept: tuple[Selection, ...]
    takes_long: bool = False
    is_rested: bool = False
    now: float = math.inf
    fading: Selection = _NOTHING


@dataclass(frozen=True)
class Choice:
    """What was asked, and what was chosen: for what lasts, and for each finger with a pulse.

    is_limited: whether what lasts has only what pulses leave that play beside it; steps: to what
    lasts otherwise, one after the other.
    """

    requested: ChoiceRequest
    lasting: Selection | None
    short: Mapping[ContactKey, Selection]
    is_limited: bool = False
    steps: tuple[Selection, ...] = ()


@dataclass(frozen=True)
class Chooser:
    """Chooses by a table; shape: adds envelopes to what is joint."""

    table: LocalizationTable
    shape: Shape | None = None

    def choose(self, requested: ChoiceRequest, capabilities: PlaybackCapabilities) -> Choice:
        """Choose what is asked for, what lasts first."""
        if requested.is_rested:
            return Choice(requested, None, {}, steps=self._steps(requested, capabilities))
        kept, lasting, is_limited = [*requested.kept], None, False
        if requested.intended.lasting:
            lasting, is_limited = self._lasting(requested, capabilities)
            kept.append(lasting)
        short: dict[ContactKey, Selection] = {}
        for each in requested.intended.short:
            beside = [*kept, requested.fading]
            left = self._left_by(_contents(beside), capabilities)
            found = self._chosen(requested, (each,), left, beside)
            kept.append(found)
            short[each[0].key] = found.beside([requested.fading], self.table)
        return Choice(requested, lasting, short, is_limited)

    def _lasting(
        self, requested: ChoiceRequest, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, bool]:
        """Choose what lasts, and whether it is limited by pulses that play.

        Beside these what it replaces fades, too.
        """
        targets = requested.intended.lasting
        free = self._chosen(requested, targets, capabilities)
        pulses = _contents(requested.kept) if requested.kept else []
        if not pulses:
            return free, False
        fading = [
            one
            for (finger, _), one in requested.before.items()
            if finger in free.target_keys and one not in pulses
        ]
        left = self._left_by([*pulses, *fading], capabilities)
        total = [each.layer for each in free.contents]
        if left.limits.factor_within(total, self.table) >= 1 - NEARLY:
            return free, False
        limited = self._chosen(requested, targets, left)
        if not limited.contents:
            limited = silent(requested.intended, targets, _USED_UP)
        return limited, True

    def _steps(
        self, requested: ChoiceRequest, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, ...]:
        """Choose the steps from what plays to what promises more; none on any failure."""
        intended = requested.intended
        targets, quiet = intended.lasting, intended.quiet_beside(intended.lasting)
        given = self.table, targets, quiet, capabilities, requested.before, intended.protected
        try:
            return Crossfades(*given, shape=self.shape).steps()
        except Exception as error:
            _logger.error("loop: table failed, keeping what plays", exc_info=error)
            return ()

    def _left_by(
        self, contents: Sequence[Content], capabilities: PlaybackCapabilities
    ) -> PlaybackCapabilities:
        """Return what contents leave of the amplifiers' limits."""
        if not contents:
            return capabilities
        return capabilities.left_by([each.layer for each in contents], self.table)

    def _chosen(
        self,
        requested: ChoiceRequest,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection] = (),
    ) -> Selection:
        """Choose for targets within what is left; any failure is their reason for silence.

        beside: what a pulse is felt beside.
        """
        table, intended, before = self.table, requested.intended, requested.before
        raised = tuple([(contact, _over(target, contact, beside)) for contact, target in targets])
        excitations = [content.layer.excitation.values() for content in _contents(beside)]
        avoided = [*{tone.frequency for tones in excitations for tone in tones}]
        quiet, protected = intended.quiet_beside(targets), intended.protected
        is_long = requested.takes_long and not targets[0][1].is_short
        try:
            answer = answered(
                table,
                raised,
                quiet,
                capabilities,
                before=before,
                protected=protected,
                keeps=is_long or _is_step(targets, before),
                now=requested.now if is_long else math.inf,
                avoided_hz=avoided,
            )
            if not is_long:
                answer = _alike(answer, raised[0][1])
            found = selection_of(
                table,
                answer,
                targets,
                quiet,
                before=before,
                shape=self.shape if is_long else None,
                protected=protected,
                is_in_phase=is_long,
            )
            if avoided:
                found = _among(intended, found, avoided)
        except Exception as error:
            if isinstance(error, InputError):
                reason = str(error)
            else:
                _logger.error("loop: table failed, silencing its targets", exc_info=error)
                reason = failure_text(error)
            found = silent(intended, targets, reason)
        return found


def is_alone(targets: Targets, protected: frozenset[ContactKey]) -> bool:
    """Whether what lasts is one steady content that no other finger must not notice."""
    if len(targets) != 1:
        return False
    ((contact, target),) = targets
    return protected <= {contact.key} and target.modulation_hz is None


def _is_step(targets: Targets, before: Mapping[tuple[ContactKey, int], Content]) -> bool:
    """Whether only the level of a target changes, which is not raised."""
    ((contact, new),) = targets
    then = before.get((contact.key, new.voice))
    if then is None or new.level_db_sl is None or (new.pulse and new.pulse.is_raised):
        return False
    old = then.targets[0][1]
    return new != old and new == replace(old, level_db_sl=new.level_db_sl)


def _alike(found: Answer, target: Target) -> Answer:
    """Return an answer whose level in a band is alike wherever the finger is.

    The margin for other plates, by which it is more than promised, differs from place to place.
    """
    is_level = target.level_db_sl is not None and not (target.pulse and target.pulse.is_raised)
    if not (is_level and target.band and found.layers):
        return found
    excess = found.fingers[0].level_db_sl - (target.level_db_sl or 0.0)
    return scaled(found, -excess) if excess > 0 else found


def _over(target: Target, contact: Contact, beside: Sequence[Selection]) -> Target:
    """Return the target of a short pulse as strong as it is to be above what lasts there."""
    level, above = target.level_db_sl, target.above_db
    if level is None or above is None:
        return target
    for each in _contents(beside):
        for felt in each.predictions:
            if felt.contact.key == contact.key and felt.nominal_db_sl is not None:
                level = max(level, felt.nominal_db_sl + above)
    return replace(target, level_db_sl=level)


def _among(intended: Intention, found: Selection, frequencies: Sequence[float]) -> Selection:
    """Return what was chosen for a pulse among vibrations, by their frequencies [Hz].

    Nearer than 30 Hz to one of them it is mixed.
    """
    if not found.contents:
        is_used_up = found.reason == LIMITS_LEAVE_NOTHING
        return silent(intended, found.targets, _USED_UP) if is_used_up else found
    (content,) = found.contents
    gap = min([abs((content.frequency or 0.0) - each) for each in frequencies])
    if gap >= APART_HZ - SAME_FREQUENCY:
        return found
    mixed = tuple([replace(each, is_apart=False).judged() for each in content.predictions])
    return replace(found, contents=(replace(content, predictions=mixed),))


def _contents(parts: Iterable[Selection]) -> list[Content]:
    return [content for part in parts for content in part.contents]


def unanswered(requested: ChoiceRequest, reason: str) -> Choice:
    """Return what stands in for an answer: nothing is felt, unless what plays would do, too."""
    intended = requested.intended
    none = silent(intended, intended.lasting, reason)
    return Choice(
        requested,
        None if requested.is_rested else none,
        {each[0].key: silent(intended, (each,), reason) for each in intended.short},
    )


def silent(intended: Intention, targets: Targets, reason: str) -> Selection:
    """Return the selection of targets that feel nothing, for a reason."""
    quiet = intended.quiet_beside(targets)
    skipped = tuple(not_served(contact, reason) for contact, _ in targets)
    return Selection(targets, quiet, (), reason, skipped, protected=intended.protected)
