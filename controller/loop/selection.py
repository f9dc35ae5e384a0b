"""Selection: from a haptic intent to the pattern of the table that realises it."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.intent import HapticIntent, Target
from controller.sources.contacts import Contact
from model.errors import InputError
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import FELT_DB_SL, decibels
from model.table.pattern import IMPERCEPTIBLE_DB_SL, Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.vibration.peak import peak_acceleration
from registry.plugins import failure_text

# Bending wavelengths are 17 cm and more below 500 Hz; a fingertip that has moved by about its own
# radius is still within the disc that the pattern was chosen for.
MOVE_TOLERANCE = 0.008

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbours allow`: twice a strong vibration."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prediction:
    """Predicted steady vibration at a target.

    contact: as it was when the pattern was chosen; contrast_db: to the loudest quiet point, None
    without quiet contacts.
    """

    contact: Contact
    level_db_sl: float
    contrast_db: float | None


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

    A pattern stays as long as its targets and their levels do and no contact has moved more than
    8 mm. A quiet contact that lifts leaves it as it is: a change would be felt.
    """

    def __init__(self, table: LocalizationTable) -> None:
        self._table = table
        self._current = Selection((), (), None, None)

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
        then = {each.key: each for each in (*(c for c, _ in current.targets), *current.quiet)}
        now = {each.key: each for each in (*(c for c, _ in targets), *quiet)}
        same = now.keys() <= then.keys() if current.pattern else now.keys() == then.keys()
        return same and all(
            math.dist((contact.x, contact.y), (then[key].x, then[key].y)) <= MOVE_TOLERANCE
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
            question, pattern = self._query(
                _question(targets, quiet, capabilities),
                [target for _, target in targets],
                max_amplitudes=capabilities.max_amplitudes,
            )
            predictions = self._predict(targets, quiet, pattern)
        except InputError as error:
            return Selection(targets, quiet, None, str(error))
        except Exception as error:
            _logger.exception("loop: table failed, silencing all channels")
            return Selection(targets, quiet, None, failure_text(error))
        return Selection(targets, quiet, pattern, None, question, predictions)

    def _query(
        self,
        question: Question,
        targets: Sequence[Target],
        *,
        max_amplitudes: Mapping[str, float],
    ) -> tuple[Question, Pattern]:
        """Return the pattern and the question that it finally answers; raises InputError."""
        if all(target.level_db_sl is None for target in targets):
            return question, strongest(self._table.query(question), max_amplitudes)
        try:
            return question, self._table.query(question)
        except InputError:
            if not all(target.allow_weaker for target in targets):
                raise
        level = question.level_db_sl
        question = replace(question, level_db_sl=min(level, FELT_DB_SL))
        return question, strongest(self._table.query(question), max_amplitudes, max_db_sl=level)

    def _predict(
        self,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
        pattern: Pattern,
    ) -> tuple[Prediction, ...]:
        """Predict what each target will feel; a pattern states it for a single target."""
        if len(targets) == 1:
            ((contact, _),) = targets
            return (Prediction(contact, pattern.level_db_sl, pattern.contrast_db),)
        fingers = [*(contact for contact, _ in targets), *quiet]
        discs = [fingertip_points(each.x, each.y, self._table.plate) for each in fingers]
        frequencies, all_fields = self._table.amplitudes(pattern.excitation, np.concatenate(discs))
        ends = np.cumsum([len(disc) for disc in discs])[: len(targets)]
        *fields, at_quiet = np.split(all_fields, ends, axis=1)
        loudest = peak_acceleration(at_quiet)
        predictions = []
        for (contact, _), field in zip(targets, fields, strict=True):
            weights = fingertip_weights(contact.x, contact.y, self._table.plate)
            level = mean_level_db_sl(frequencies, field, weights)
            contrast = (
                contrast_db([peak_acceleration(field)], loudest, [weights]) if quiet else None
            )
            predictions.append(
                Prediction(contact, level, None if contrast is None else float(contrast))
            )
        return tuple(predictions)


def _question(
    targets: tuple[tuple[Contact, Target], ...],
    quiet: tuple[Contact, ...],
    capabilities: PlaybackCapabilities,
) -> Question:
    """Return the question that puts an intent to the table."""
    given = [target.level_db_sl for _, target in targets if target.level_db_sl is not None]
    level = max(given, default=FELT_DB_SL)
    levels = [level if t.level_db_sl is None else t.level_db_sl for _, t in targets]
    return Question(
        targets=tuple((contact.x, contact.y) for contact, _ in targets),
        quiet=tuple((contact.x, contact.y) for contact in quiet),
        level_db_sl=level,
        softer_db=tuple(level - each for each in levels),
        drive_mode=capabilities.drive_mode,
        playable=capabilities.playable,
        frequencies=capabilities.frequencies,
        envelopes=capabilities.envelope_support.onsets,
    )


def strongest(
    pattern: Pattern, max_amplitudes: Mapping[str, float], *, max_db_sl: float = MAX_DB_SL
) -> Pattern:
    """Scale a pattern to as strong as the neighbours allow.

    Quiet fingers do not feel it then, no ERA exceeds its largest amplitude [m], by name, and no
    target exceeds max_db_sl [dB SL]. Raises InputError if nothing remains to be felt.
    """
    headroom = [
        float(decibels(max_amplitudes[name] / tone.amplitude))
        for name, tone in pattern.excitation.items()
        if tone.amplitude > 0
    ]
    gain = min([max_db_sl - pattern.level_db_sl, *headroom])
    quiet = pattern.quiet_level_db_sl
    if quiet is not None:
        gain = min(gain, IMPERCEPTIBLE_DB_SL - quiet)
    level = pattern.level_db_sl + gain
    if level <= 0:
        raise InputError(
            "a quiet finger must not feel the pattern, but every one that reaches the target does; "
            "lift or move that finger away"
        )
    factor = 10 ** (gain / 20)
    return replace(
        pattern,
        excitation={
            name: replace(tone, amplitude=tone.amplitude * factor)
            for name, tone in pattern.excitation.items()
        },
        level_db_sl=level,
        quiet_level_db_sl=None if quiet is None else quiet + gain,
    )
