"""What is chosen for fingers: one answer for all contents that last, and one for each short pulse.

A pulse is chosen beside what lasts: with the stroke and the power that this leaves, all other
fingers quiet. It is over before an answer for all would help, and never changed.
"""

import contextlib
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.content import Content, Prediction, Selection, Targets, not_served
from controller.loop.intent import Target
from controller.loop.joint_answer import (
    LIMITS_LEAVE_NOTHING,
    Shape,
    amplitudes_of,
    factor_within,
    query_jointly,
    unshaped,
)
from controller.loop.table_query import TableAnswer, query_table
from controller.sources.contacts import Contact, ContactKey
from model.errors import InputError
from model.finger.perception import decibels
from model.table.effect_level import EffectLevels
from model.table.pattern import IMPERCEPTIBLE_DB_SL
from model.table.request import verdict_of
from model.table.table import LocalizationTable
from registry.plugins import failure_text

# A step of a ramp or texture may be this far [dB] below its level before its frequency changes.
_STEP_SHORT_OF = 1.0

_QUIETER = "lower its level, or lift that finger"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Requested:
    """What is to be chosen among contacts: for short pulses, and what lasts, None where it is kept.

    protected: contacts that must not notice the contents of others; before: what is felt now, by
    finger and voice; kept: what plays on beside it; triggered_at [s]: when the change arrived;
    takes_long: whether what lasts takes longer than the control loop may wait; is_moving: whether
    only places have changed; is_rested: whether what plays would do, too, but kept its frequencies
    while a finger moved.
    """

    short: Targets
    contacts: tuple[Contact, ...]
    protected: frozenset[ContactKey]
    before: Mapping[tuple[ContactKey, int], Content]
    kept: tuple[Selection, ...]
    triggered_at: float
    lasting: Targets | None = None
    takes_long: bool = False
    is_moving: bool = False
    is_rested: bool = False


@dataclass(frozen=True)
class Chosen:
    """What was asked, and what was chosen: for what lasts, and for each finger with a pulse."""

    requested: Requested
    lasting: Selection | None
    short: Mapping[ContactKey, Selection]


@dataclass(frozen=True)
class Chooser:
    """Chooses by a table; levels: over durations; shape: adds envelopes to what is joint."""

    table: LocalizationTable
    levels: EffectLevels
    shape: Shape = unshaped

    def choose(self, requested: Requested, capabilities: PlaybackCapabilities) -> Chosen:
        """Choose what is asked for, what lasts first."""
        kept, lasting = [*requested.kept], None
        if requested.lasting is not None:
            beside = None if requested.takes_long else ()
            lasting = self._chosen(requested, requested.lasting, capabilities, beside)
            kept.append(lasting)
        short: dict[ContactKey, Selection] = {}
        for each in requested.short:
            found = self._chosen(requested, (each,), capabilities, kept)
            kept.append(found)
            short[each[0].key] = found
        return Chosen(requested, lasting, short)

    def _chosen(
        self,
        requested: Requested,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection] | None,
    ) -> Selection:
        """Choose for a target beside others, or several; any failure is their reason for silence.

        beside: None for several together.
        """
        keys = {contact.key for contact, _ in targets}
        quiet = tuple([each for each in requested.contacts if each.key not in keys])
        try:
            if beside is not None:
                found = self._alone(requested, targets, quiet, capabilities, beside)
            else:
                found = query_jointly(
                    self.table,
                    targets,
                    quiet,
                    capabilities,
                    before=requested.before,
                    shape=self.shape,
                    protected=requested.protected,
                    is_moving=requested.is_moving,
                )
        except Exception as error:
            if isinstance(error, InputError):
                reason = str(error)
            else:
                _logger.error("loop: table failed, silencing its targets", exc_info=error)
                reason = failure_text(error)
            found = _silent(targets, quiet, reason)
        return replace(found, protected=requested.protected)

    def _alone(
        self,
        requested: Requested,
        targets: Targets,
        quiet: tuple[Contact, ...],
        capabilities: PlaybackCapabilities,
        beside: Sequence[Selection],
    ) -> Selection:
        """Choose for the only target beside others; raises InputError."""
        ((contact, target),) = targets
        strokes, left, heard = self.table.strokes, capabilities, list[float]()
        contents = list[Content]()
        for part in beside:
            contents += part.contents
            if contact.key in part.quiet_levels:
                heard.append(part.quiet_levels[contact.key])
        if contents:
            left = _left_by(contents, capabilities, strokes)
        before = requested.before.get((contact.key, 0))
        answer = self._query(contact, target, quiet, left, before)
        pattern = answer.pattern
        total = amplitudes_of([pattern.excitation])
        change = float(decibels(factor_within(total, left, strokes)))
        felt, promised = answer.felt_db_sl + change, answer.promised_contrast_db
        leak = -math.inf if promised is None else felt - promised
        if requested.protected - {contact.key} and leak > IMPERCEPTIBLE_DB_SL:
            reason = f"a protected finger would notice it, up to {leak:.1f} dB SL; {_QUIETER}"
            return _silent(targets, quiet, reason)
        is_heard = target.level_db_sl is not None and target.level_db_sl < 0  # as it shall be
        if felt < 0 and (change < 0 or (contents and not is_heard)):
            used_up = "the contents of other fingers use the whole stroke; lift a finger"
            return _silent(targets, quiet, used_up if contents else LIMITS_LEAVE_NOTHING)
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


def _silent(targets: Targets, quiet: tuple[Contact, ...], reason: str) -> Selection:
    """Return the selection of targets that feel nothing, for a reason."""
    skipped = tuple(not_served(contact, reason) for contact, _ in targets)
    return Selection(targets, quiet, (), reason, skipped)


def _left_by(
    contents: Sequence[Content],
    capabilities: PlaybackCapabilities,
    strokes: Mapping[str, float],
) -> PlaybackCapabilities:
    """Return what contents leave of the amplitudes and the power, their peaks together."""
    taken = amplitudes_of([each.pattern.excitation for each in contents])
    levels = [amplitude / strokes[name] for name, amplitude in taken.items()]
    return replace(
        capabilities,
        max_amplitudes={
            name: max(highest - taken[name], 1e-12)
            for name, highest in capabilities.max_amplitudes.items()
        },
        max_power=max(math.sqrt(capabilities.max_power) - math.hypot(*levels), 1e-9) ** 2,
    )
