"""What is chosen for fingers: one answer for all contents that last, and one for each short pulse.

A pulse is chosen beside what lasts: with the stroke and the power that this leaves, all other
fingers quiet. It is over before an answer for all would help, and never changed. What lasts and
does not fit beside a pulse that plays has what that leaves, until it has ended.
"""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

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
from model.answer.answer import Answer, amplitudes_of
from model.answer.strength import scaled
from model.choice import NEARLY
from model.errors import InputError
from model.table.table import LocalizationTable
from registry.plugins import failure_text

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
    would do, too, but may be led to what promises more; now [s].
    """

    intended: Intention
    before: Mapping[tuple[ContactKey, int], Content]
    kept: tuple[Selection, ...]
    takes_long: bool = False
    is_rested: bool = False
    now: float = math.inf


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
            left = self._left_by(_contents(kept), capabilities)
            found = self._chosen(requested, (each,), left, kept)
            kept.append(found)
            short[each[0].key] = found
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
        fading = [one for key, one in requested.before.items() if key[0] in free.target_keys]
        left = self._left_by([*pulses, *fading], capabilities)
        total = amplitudes_of([each.layer.excitation for each in free.contents])
        if left.limits.factor_within(total, self.table.strokes) >= 1 - NEARLY:
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
        taken = amplitudes_of([each.layer.excitation for each in contents])
        return capabilities.left_by(taken, self.table.strokes)

    def _chosen(
        self,
        requested: ChoiceRequest,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection] | None = None,
    ) -> Selection:
        """Choose for targets within what is left; any failure is their reason for silence.

        beside: what a pulse is felt beside; None for what lasts.
        """
        table, intended, before = self.table, requested.intended, requested.before
        quiet, protected = intended.quiet_beside(targets), intended.protected
        is_long = requested.takes_long and beside is None
        try:
            answer = answered(
                table,
                targets,
                quiet,
                capabilities,
                before=before,
                protected=protected,
                keeps=is_long or _is_step(targets, before),
                now=requested.now if is_long else math.inf,
            )
            if not is_long:
                answer = _alike(answer, targets[0][1])
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
            if beside:
                found = _beside(table, intended, found, beside)
        except Exception as error:
            if isinstance(error, InputError):
                reason = str(error)
            else:
                _logger.error("loop: table failed, silencing its targets", exc_info=error)
                reason = failure_text(error)
            found = silent(intended, targets, reason)
        return found


def sums_db(levels: Sequence[Sequence[float]]) -> list[float]:
    """Return the levels of powers that add up [dB], by set of thresholds."""
    powers = [sum([10 ** (level / 10) for level in each]) for each in zip(*levels, strict=True)]
    return [10 * math.log10(power) if power else -math.inf for power in powers]


def is_alone(targets: Targets, protected: frozenset[ContactKey]) -> bool:
    """Whether what lasts is one steady content that no other finger must not notice."""
    if len(targets) != 1:
        return False
    ((contact, target),) = targets
    return protected <= {contact.key} and target.modulation_hz is None


def _is_step(targets: Targets, before: Mapping[tuple[ContactKey, int], Content]) -> bool:
    """Whether only the level of a target changes, which is not raised."""
    ((contact, new),) = targets
    then = before.get((contact.key, 0))
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


def _beside(
    table: LocalizationTable, intended: Intention, found: Selection, beside: Sequence[Selection]
) -> Selection:
    """Return what was chosen for a pulse with what its finger feels of others besides."""
    ((contact, _),) = found.targets
    heard = [known for each in beside if (known := each.quiet_levels.get(contact.key))]
    if not found.contents:
        is_used_up = bool(_contents(beside)) and found.reason == LIMITS_LEAVE_NOTHING
        return silent(intended, found.targets, _USED_UP) if is_used_up else found
    if not heard:
        return found
    (content,), others = found.contents, np.array(sums_db(heard))
    (felt,) = content.predictions
    promised = felt.promised_contrast_db
    level = -math.inf if felt.level_db_sl is None else felt.level_db_sl
    levels = table.levels_by_set(level, content.layer.excitation)
    promised = min(math.inf if promised is None else promised, float((levels - others).min()))
    felt = replace(felt, promised_contrast_db=promised, foreign_level_db_sl=float(others.max()))
    return replace(found, contents=(replace(content, predictions=(felt.judged(),)),))


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
