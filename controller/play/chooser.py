"""What is chosen for fingers: one answer for all contents that last, and one for each short pulse.

A pulse is chosen beside what lasts: with the stroke and the power that this leaves, all other
fingers quiet. It is over before an answer for all would help, and never changed. What lasts and
does not fit beside a pulse that plays has what that leaves, until it has ended.
"""

import contextlib
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from controller.play.capabilities import PlaybackCapabilities, amplitudes_of
from controller.play.content import Content, Prediction, Selection, Targets, not_served
from controller.play.intent import Target
from controller.play.joint_answer import (
    LIMITS_LEAVE_NOTHING,
    Shape,
    query_jointly,
    unshaped,
)
from controller.play.table_query import TableAnswer, query_table
from controller.sources.contacts import Contact, ContactKey
from model.answer.effect_level import EffectLevels
from model.answer.pattern import IMPERCEPTIBLE_DB_SL
from model.answer.request import verdict_of
from model.choice import NEARLY
from model.errors import InputError
from model.finger.perception import decibels
from model.table.table import LocalizationTable
from registry.plugins import failure_text

# A step of a ramp or texture may be this far [dB] below its level before its frequency changes.
_STEP_SHORT_OF = 1.0

_USED_UP = "the contents of other fingers use the whole stroke; lift a finger"
_QUIETER = "lower its level, or lift that finger"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Requested:
    """What is to be chosen among contacts: for short pulses, and what lasts, None where it is kept.

    protected: contacts that must not notice the contents of others; before: what is felt now, by
    finger and voice; kept: what plays on beside it; takes_long: whether what lasts takes longer
    than the control loop may wait; is_moving: whether only places have changed; is_rested: whether
    what plays would do, too, but kept its frequencies while a finger moved.
    """

    short: Targets
    contacts: tuple[Contact, ...]
    protected: frozenset[ContactKey]
    before: Mapping[tuple[ContactKey, int], Content]
    kept: tuple[Selection, ...]
    lasting: Targets | None = None
    takes_long: bool = False
    is_moving: bool = False
    is_rested: bool = False

    def quiet_beside(self, targets: Targets) -> tuple[Contact, ...]:
        """Return the contacts that are to feel nothing of what these targets feel."""
        keys = {contact.key for contact, _ in targets}
        return tuple([each for each in self.contacts if each.key not in keys])


@dataclass(frozen=True)
class Chosen:
    """What was asked, and what was chosen: for what lasts, and for each finger with a pulse.

    is_limited: whether what lasts has only what pulses leave that play beside it.
    """

    requested: Requested
    lasting: Selection | None
    short: Mapping[ContactKey, Selection]
    is_limited: bool


@dataclass(frozen=True)
class Chooser:
    """Chooses by a table; levels: over durations; shape: adds envelopes to what is joint."""

    table: LocalizationTable
    levels: EffectLevels
    shape: Shape = unshaped

    def choose(self, requested: Requested, capabilities: PlaybackCapabilities) -> Chosen:
        """Choose what is asked for, what lasts first."""
        kept, lasting, is_limited = [*requested.kept], None, False
        if requested.lasting is not None:
            lasting, is_limited = self._lasting(requested, requested.lasting, capabilities)
            kept.append(lasting)
        short: dict[ContactKey, Selection] = {}
        for each in requested.short:
            left = self._left_by(_contents(kept), capabilities)
            found = self._chosen(requested, (each,), left, kept)
            kept.append(found)
            short[each[0].key] = found
        return Chosen(requested, lasting, short, is_limited)

    def _lasting(
        self, requested: Requested, targets: Targets, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, bool]:
        """Choose what lasts, and whether it is limited by pulses that play.

        Beside these what it replaces fades, too.
        """
        free, pulses = self._chosen(requested, targets, capabilities), _contents(requested.kept)
        if not pulses:
            return free, False
        fading = [one for key, one in requested.before.items() if key[0] in free.target_keys]
        left = self._left_by([*pulses, *fading], capabilities)
        total = amplitudes_of([each.pattern.excitation for each in free.contents])
        if left.factor_within(total, self.table.strokes) >= 1 - NEARLY:
            return free, False
        limited = self._chosen(requested, targets, left)
        return limited if limited.contents else silent(requested, targets, _USED_UP), True

    def _left_by(
        self, contents: Sequence[Content], capabilities: PlaybackCapabilities
    ) -> PlaybackCapabilities:
        """Return what contents leave of the amplifiers' limits."""
        if not contents:
            return capabilities
        taken = amplitudes_of([each.pattern.excitation for each in contents])
        return capabilities.left_by(taken, self.table.strokes)

    def _chosen(
        self,
        requested: Requested,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection] | None = None,
    ) -> Selection:
        """Choose for targets within what is left; any failure is their reason for silence.

        beside: what a pulse is felt beside; None for what lasts.
        """
        try:
            if requested.takes_long and beside is None:
                found = query_jointly(
                    self.table,
                    targets,
                    requested.quiet_beside(targets),
                    capabilities,
                    before=requested.before,
                    shape=self.shape,
                    protected=requested.protected,
                    is_moving=requested.is_moving,
                )
            else:
                found = self._alone(requested, targets, capabilities, beside or ())
        except Exception as error:
            if isinstance(error, InputError):
                reason = str(error)
            else:
                _logger.error("loop: table failed, silencing its targets", exc_info=error)
                reason = failure_text(error)
            found = silent(requested, targets, reason)
        return replace(found, protected=requested.protected)

    def _alone(
        self,
        requested: Requested,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection],
    ) -> Selection:
        """Choose for the only target beside others; raises InputError."""
        ((contact, target),) = targets
        key, quiet = contact.key, requested.quiet_beside(targets)
        heard = [each.quiet_levels[key] for each in beside if key in each.quiet_levels]
        before = requested.before.get((key, 0))
        answer = self._query(contact, target, quiet, capabilities, before)
        pattern = answer.pattern
        total = amplitudes_of([pattern.excitation])
        change = float(decibels(capabilities.factor_within(total, self.table.strokes)))
        felt, promised = answer.felt_db_sl + change, answer.promised_contrast_db
        leak = -math.inf if promised is None else felt - promised
        if requested.protected - {key} and leak > IMPERCEPTIBLE_DB_SL:
            reason = f"a protected finger would notice it, up to {leak:.1f} dB SL; {_QUIETER}"
            return silent(requested, targets, reason)
        if felt < 0:
            is_beside = bool(_contents(beside))
            is_heard = target.level_db_sl is not None and target.level_db_sl < 0  # as it shall be
            if change < 0 or (is_beside and not is_heard):
                reason = _USED_UP if is_beside else LIMITS_LEAVE_NOTHING
                return silent(requested, targets, reason)
        others = sum_db(heard) if heard else None
        if others is not None:
            promised = min(math.inf if promised is None else promised, felt - others)
        content = Content(targets, answer.question, pattern.scaled(change) if change else pattern)
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
            quiet_levels=dict.fromkeys([each.key for each in quiet], leak),
        )

    def _query(
        self,
        contact: Contact,
        target: Target,
        quiet: Sequence[Contact],
        capabilities: PlaybackCapabilities,
        before: Content | None,
    ) -> TableAnswer:
        """Query the table; a level that changes keeps its frequency where that reaches it."""
        table, levels = self.table, self.levels
        kept = None if before is None else before.frequency
        if before is not None and kept is not None and _is_step(target, before.targets[0][1]):
            tuned = replace(target, band=(kept, kept))
            with contextlib.suppress(InputError):
                answer = query_table(table, contact, tuned, quiet, capabilities, levels)
                if answer.felt_db_sl >= (target.level_db_sl or 0.0) - _STEP_SHORT_OF:
                    return answer
        return query_table(table, contact, target, quiet, capabilities, levels)


def sum_db(levels: Iterable[float]) -> float:
    """Return the level of powers that add up [dB]."""
    power = sum([10 ** (level / 10) for level in levels])
    return 10 * math.log10(power) if power else -math.inf


def is_alone(targets: Targets, protected: frozenset[ContactKey]) -> bool:
    """Whether what lasts is one steady content that no other finger must not notice."""
    if len(targets) != 1:
        return False
    ((contact, target),) = targets
    return protected <= {contact.key} and target.modulation_hz is None


def _is_step(new: Target, old: Target) -> bool:
    """Whether only the level of a target changes, which is not raised."""
    is_step = new != old and new == replace(old, level_db_sl=new.level_db_sl)
    return is_step and new.level_db_sl is not None and not (new.pulse and new.pulse.is_raised)


def _contents(parts: Iterable[Selection]) -> list[Content]:
    return [content for part in parts for content in part.contents]


def unanswered(requested: Requested, reason: str) -> Chosen:
    """Return what stands in for an answer: nothing is felt, unless what plays would do, too."""
    none = silent(requested, requested.lasting or (), reason)
    return Chosen(
        requested,
        None if requested.is_rested else none,
        {each[0].key: silent(requested, (each,), reason) for each in requested.short},
        is_limited=False,
    )


def silent(requested: Requested, targets: Targets, reason: str) -> Selection:
    """Return the selection of targets that feel nothing, for a reason."""
    quiet = requested.quiet_beside(targets)
    skipped = tuple(not_served(contact, reason) for contact, _ in targets)
    return Selection(targets, quiet, (), reason, skipped, protected=requested.protected)
