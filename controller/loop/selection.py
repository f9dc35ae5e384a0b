"""From intents to a pattern: who feels it and how strongly, who must feel nothing, by what."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.intent import HapticIntent, Target
from controller.sources.contacts import Contact
from model.arrays import FloatArray
from model.errors import InputError
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.finger.fingertip import fingertip_points
from model.finger.perception import FELT_DB_SL
from model.structure.plate import Plate
from model.table.pattern import UNAWARE_DB_SL, Pattern
from model.table.question import Question
from model.vibration.excitation import Excitation
from model.vibration.peak import peak_acceleration
from registry.plugins import failure_text

# Fields vary over a good part of a bending wavelength, 17 cm and more below 500 Hz; a fingertip
# that moved by less than its own radius is still within the disc it was chosen for.
MOVE_TOLERANCE = 0.008

MOST_DB_SL = 26.0
"""Where `as strongly as the neighbours allow` ends: at twice what is strong, lest a finger without
neighbours be numbed."""

_logger = logging.getLogger(__name__)


class PatternTable(Protocol):
    """What selection needs of a localization table."""

    @property
    def plate(self) -> Plate:
        """The plate that it is for."""

    @property
    def frequencies(self) -> FloatArray:
        """What its patterns may use [Hz]."""

    def prepare(self, drive_mode: str) -> None:
        """Work out what the first question in a mode would have to wait for."""

    def query(self, question: Question) -> Pattern:
        """The best pattern; raises InputError where there is none."""

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Frequencies (f,) [Hz] and peak acceleration [m/s²] at points (p, 2) [m], (f, p)."""


@dataclass(frozen=True)
class Felt:
    """What a target is predicted to feel once the vibration is steady.

    contact: where it was when the pattern was chosen; wanted_db_sl: None for as strongly as the
    neighbours allow; contrast_db: to the loudest quiet point, None where nobody is to be quiet.
    """

    contact: Contact
    wanted_db_sl: float | None
    level_db_sl: float
    contrast_db: float | None


@dataclass(frozen=True)
class Selection:
    """What was chosen: for whom, who must feel nothing, and the pattern.

    Contacts stand where they were when it was chosen; targets: whom it was chosen for with what
    they want; felt: what each of them will feel. Without a pattern all is silent, and reason says
    why. question: what the table was asked.
    """

    targets: tuple[tuple[Contact, Target], ...]
    quiet: tuple[Contact, ...]
    pattern: Pattern | None
    reason: str | None
    question: Question | None = None
    felt: tuple[Felt, ...] = ()


class Selector:
    """Chooses the pattern of a table that does what is wished for the contacts on its plate.

    A pattern stays while its targets and their levels do and no contact has moved more than 8 mm
    from where it was chosen for; a quiet contact that lifts leaves it as it is, since less is asked
    of it then and a change would be felt.
    """

    def __init__(self, table: PatternTable) -> None:
        self._table = table
        self._current = Selection((), (), None, None)

    def select(
        self, contacts: Sequence[Contact], intent: HapticIntent, capabilities: PlaybackCapabilities
    ) -> Selection:
        """The selection for contacts in their order of arrival; the same object if it stays."""
        wanted = {target.key: target for target in intent.targets}
        targets = tuple((each, wanted[each.key]) for each in contacts if each.key in wanted)
        quiet = tuple(each for each in contacts if each.key not in wanted)
        if not self._holds(intent, targets, quiet):
            self._current = self._choose(intent, targets, quiet, capabilities)
        return self._current

    def _holds(
        self,
        intent: HapticIntent,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
    ) -> bool:
        """Whether what was chosen for contacts elsewhere still serves."""
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
        """Ask the table; whatever goes wrong there is silence until something else is wanted."""
        if not targets:
            return Selection((), quiet, None, intent.reason)
        try:
            question, pattern = self._ask(
                _question(targets, quiet, capabilities),
                [target for _, target in targets],
                largest=capabilities.largest,
            )
            felt = self._felt(targets, quiet, pattern)
        except InputError as error:
            return Selection(targets, quiet, None, str(error))
        except Exception as error:
            _logger.exception("the table failed, all channels fall silent")
            return Selection(targets, quiet, None, failure_text(error))
        return Selection(targets, quiet, pattern, None, question, felt)

    def _ask(
        self, question: Question, targets: Sequence[Target], *, largest: Mapping[str, float]
    ) -> tuple[Question, Pattern]:
        """The pattern, and what the table was asked in the end; raises InputError."""
        if all(target.level_db_sl is None for target in targets):
            return question, strongest(self._table.query(question), largest)
        try:
            return question, self._table.query(question)
        except InputError:
            if not all(target.or_less for target in targets):
                raise
        wanted = question.level_db_sl
        question = replace(question, level_db_sl=min(wanted, FELT_DB_SL))
        return question, strongest(self._table.query(question), largest, at_most=wanted)

    def _felt(
        self,
        targets: tuple[tuple[Contact, Target], ...],
        quiet: tuple[Contact, ...],
        pattern: Pattern,
    ) -> tuple[Felt, ...]:
        """What each target will feel; of a lone one the pattern says it."""
        if len(targets) == 1:
            ((contact, target),) = targets
            return (Felt(contact, target.level_db_sl, pattern.level_db_sl, pattern.contrast_db),)
        fingers = [*(contact for contact, _ in targets), *quiet]
        discs = [fingertip_points(each.x, each.y, self._table.plate) for each in fingers]
        frequencies, all_fields = self._table.amplitudes(pattern.excitation, np.concatenate(discs))
        ends = np.cumsum([len(disc) for disc in discs])[: len(targets)]
        *fields, at_quiet = np.split(all_fields, ends, axis=1)
        loudest = peak_acceleration(at_quiet)
        return tuple(
            Felt(
                contact,
                target.level_db_sl,
                mean_level_db_sl(frequencies, field),
                float(contrast_db([peak_acceleration(field)], loudest)) if quiet else None,
            )
            for (contact, target), field in zip(targets, fields, strict=True)
        )


def _question(
    targets: tuple[tuple[Contact, Target], ...],
    quiet: tuple[Contact, ...],
    capabilities: PlaybackCapabilities,
) -> Question:
    """What the table is to be asked."""
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
        envelopes=capabilities.shaping.onsets,
    )


def strongest(
    pattern: Pattern, largest: Mapping[str, float], *, at_most: float = MOST_DB_SL
) -> Pattern:
    """The pattern turned up or down to as strong as the neighbours allow.

    No quiet finger is aware of it then, no ERA exceeds its largest amplitude [m], by its name, and
    no target is beyond a level [dB SL]. Raises InputError where that leaves nothing to be felt.
    """
    room = [
        20 * math.log10(largest[name] / tone.amplitude)
        for name, tone in pattern.excitation.items()
        if tone.amplitude > 0
    ]
    gain = min([at_most - pattern.level_db_sl, *room])
    if pattern.quiet_level_db_sl is not None:
        gain = min(gain, UNAWARE_DB_SL - pattern.quiet_level_db_sl)
    level = pattern.level_db_sl + gain
    if level <= 0:
        raise InputError(
            "whatever can be felt there is felt by another finger too; lift it, or move it away"
        )
    factor = 10 ** (gain / 20)
    quiet = pattern.quiet_level_db_sl
    return replace(
        pattern,
        excitation={
            name: replace(tone, amplitude=tone.amplitude * factor)
            for name, tone in pattern.excitation.items()
        },
        level_db_sl=level,
        quiet_level_db_sl=None if quiet is None else quiet + gain,
    )
