"""Selection: from a haptic intent to the pattern of the table that realises it."""

import contextlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.intent import HapticIntent, Target
from controller.loop.table_query import TableAnswer, is_short, query_table, why_held_back
from controller.sources.contacts import Contact
from model.errors import InputError
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import contrast_db, mean_level_db_sl
from model.table.effect_level import EffectLevels
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.vibration.excitation import peak_acceleration
from registry.plugins import failure_text

# Bending wavelengths are 17 cm and more below 500 Hz; a fingertip that has moved by about its own
# radius is still within the disc that the pattern was chosen for.
MOVE_TOLERANCE = 0.008

# A step of a ramp or texture may be this far [dB] below its level before its frequency changes.
_STEP_SHORT_OF = 1.0

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prediction:
    """Predicted vibration at a target.

    contact: as it was when the pattern was chosen; level_db_sl: over the duration of the effect,
    onset included, or the steady one where it has none; contrast_db: of the steady vibration to the
    loudest quiet point, None without quiet contacts. held_back: why another vibration than that of
    its own effect plays; None if its own does.
    """

    contact: Contact
    level_db_sl: float
    contrast_db: float | None
    held_back: str | None = None


@dataclass(frozen=True)
class Selection:
    """The pattern for some contacts, or None and the reason for silence.

    targets, quiet: contacts as they were when the pattern was chosen, targets with their
    intents; question: the query as sent; predictions: one per target.
    """

    targets: tuple[tuple[Contact, Target], ...]
    quiet: tuple[Contact, ...]
    pattern: Pattern | None
    reason: str | None
    question: Question | None = None
    predictions: tuple[Prediction, ...] = ()


class Selector:
    """Chooses the pattern of a table that realises an intent for the contacts on its plate.

    A pattern stays as long as its targets and their levels do, no contact has moved more than 8 mm,
    and none has another load, which changes by a factor of 1.5 or more. A quiet contact that lifts
    leaves it as it is: a change would be felt. So does any move, any load and any new quiet contact
    while a short pulse plays. levels: None for steady levels only.
    """

    def __init__(self, table: LocalizationTable, levels: EffectLevels | None = None) -> None:
        self._table = table
        self._levels = levels
        self._current = Selection((), (), None, None)

    def replace(self, table: LocalizationTable, levels: EffectLevels | None) -> None:
        """Answer by another table of this plate; the selection stays until its contacts change."""
        self._table, self._levels = table, levels

    def select(
        self,
        contacts: Sequence[Contact],
        intent: HapticIntent,
        capabilities: PlaybackCapabilities,
    ) -> Selection:
        """Return the selection for contacts in their order of arrival; the same object if kept."""
        by_key = {target.key: target for target in intent.targets}
        targets = tuple((each, by_key[each.key]) for each in contacts if each.key in by_key)
        quiet = tuple(each for each in contacts if each.key not in by_key)
        if not self._still_fits(intent, targets, quiet):
            self._current = self._choose(intent, targets, quiet, capabilities)
        return self._current

    def _still_fits(
        self,
        intent: HapticIntent,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
    ) -> bool:
        """Whether the current selection also serves these contacts."""
        current = self._current
        if not targets or not current.targets:
            return not targets and not current.targets and current.reason == intent.reason
        if {target for _, target in targets} != {target for _, target in current.targets}:
            return False
        if current.pattern and is_short(current.targets):
            return True
        then = {each.key: each for each in (*(c for c, _ in current.targets), *current.quiet)}
        now = {each.key: each for each in (*(c for c, _ in targets), *quiet)}
        same = now.keys() <= then.keys() if current.pattern else now.keys() == then.keys()
        return same and all(
            math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
            and contact.load == then[key].load
            for key, contact in now.items()
        )

    def _choose(
        self,
        intent: HapticIntent,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
        capabilities: PlaybackCapabilities,
    ) -> Selection:
        """Query the table; any failure there selects silence until the intent changes."""
        if not targets:
            return Selection((), quiet, None, intent.reason)
        try:
            answer = self._query(targets, quiet, capabilities)
            predictions = self._held_back(targets, self._predict(targets, quiet, answer), answer)
        except InputError as error:
            return Selection(targets, quiet, None, str(error))
        except Exception as error:
            _logger.exception("loop: table failed, silencing all channels")
            return Selection(targets, quiet, None, failure_text(error))
        return Selection(targets, quiet, answer.pattern, None, answer.question, predictions)

    def _query(
        self,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
        capabilities: PlaybackCapabilities,
    ) -> TableAnswer:
        """Query the table; a level that changes keeps its frequency where that reaches it."""
        kept = self._continued(targets)
        if kept is not None:
            tuned = [(contact, replace(each, band=(kept, kept))) for contact, each in targets]
            with contextlib.suppress(InputError):
                answer = query_table(self._table, tuned, quiet, capabilities, self._levels)
                levels = [each.level_db_sl or 0.0 for _, each in targets]
                if answer.felt_db_sl >= max(levels) - _STEP_SHORT_OF:
                    return answer
        return query_table(self._table, targets, quiet, capabilities, self._levels)

    def _continued(self, targets: tuple[tuple[Contact, Target], ...]) -> float | None:
        """Return the frequency [Hz] that plays if only levels of its targets change; else None."""
        current = self._current
        if current.pattern is None or len(targets) != len(current.targets):
            return None
        for (_, new), (_, old) in zip(targets, current.targets, strict=True):
            is_step = new != old and new == replace(old, level_db_sl=new.level_db_sl)
            if not is_step or new.level_db_sl is None or (new.pulse and new.pulse.is_raised):
                return None
        frequencies = {tone.frequency for tone in current.pattern.excitation.values()}
        return frequencies.pop() if len(frequencies) == 1 else None

    def _held_back(
        self,
        targets: tuple[tuple[Contact, Target], ...],
        predictions: tuple[Prediction, ...],
        answer: TableAnswer,
    ) -> tuple[Prediction, ...]:
        """Say of each target whether the vibration of its own effect plays."""
        played = [tone.frequency for tone in answer.pattern.excitation.values()]
        band = min(played), max(played)
        return tuple(
            replace(each, held_back=why_held_back(target.band, band, self._table.frequencies))
            for each, (_, target) in zip(predictions, targets, strict=True)
        )

    def _predict(
        self,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
        answer: TableAnswer,
    ) -> tuple[Prediction, ...]:
        """Predict what each target will feel; a pattern states it for a single target."""
        pattern = answer.pattern
        if len(targets) == 1:
            ((contact, _),) = targets
            return (Prediction(contact, answer.felt_db_sl, pattern.contrast_db),)
        onset_gain = answer.felt_db_sl - pattern.level_db_sl
        fingers = [*(contact for contact, _ in targets), *quiet]
        discs = [fingertip_points(each.x, each.y, self._table.plate) for each in fingers]
        points, question = np.concatenate(discs), answer.question
        frequencies, all_fields = self._table.amplitudes(
            pattern.excitation, points, contacts=question.contacts, loads=question.loads
        )
        ends = np.cumsum([len(disc) for disc in discs])[: len(targets)]
        *fields, at_quiet = np.split(all_fields, ends, axis=1)
        loudest = peak_acceleration(at_quiet)
        predictions = []
        for (contact, _), field in zip(targets, fields, strict=True):
            weights = fingertip_weights(contact.x, contact.y, self._table.plate)
            level = mean_level_db_sl(frequencies, field, weights, self._table.threshold)
            level += onset_gain
            contrast = (
                contrast_db([peak_acceleration(field)], loudest, [weights]) if quiet else None
            )
            predictions.append(
                Prediction(contact, level, None if contrast is None else float(contrast))
            )
        return tuple(predictions)
