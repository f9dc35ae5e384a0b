"""What is asked of the table for an intent: fingers, each with its stimulus."""

import math
from collections.abc import Sequence

from controller.play.capabilities import PlaybackCapabilities
from controller.play.intent import Target, band_of_table
from controller.sources.contacts import Contact, ContactKey
from model.answer.answer import IMPERCEPTIBLE_DB_SL, OWN_CONTRAST_DB
from model.answer.fingers import ANY, BY_NAME, NEVER, Finger, Stimulus
from model.arrays import FloatArray
from model.table.table import LocalizationTable

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbours allow`: twice a strong vibration."""


def fingers_of(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    protected: frozenset[ContactKey] = frozenset(),
) -> list[Finger]:
    """Return the fingers of targets, then the quiet ones.

    protected: contacts that must not notice the vibrations of others. The duration counts of a
    single target, and of what ends before an onset would have settled.
    """
    found = []
    for contact, target in targets:
        is_over = len(targets) == 1 or target.is_short
        duration = None
        if is_over and target.pulse is not None and target.pulse.is_raised:
            duration = target.pulse.duration
        stimulus = Stimulus(
            MAX_DB_SL if target.level_db_sl is None else target.level_db_sl,
            playable_band(target.band, table.frequencies, capabilities.frequencies),
            duration,
            None if duration is not None else target.modulation_hz,
            is_limit=target.level_db_sl is None,
            name=target.content,
        )
        sharing = NEVER if target.is_own else ANY if target.may_share else BY_NAME
        found.append(
            Finger(
                (contact.x, contact.y),
                stimulus,
                contact.load,
                target.priority,
                sharing,
                min_contrast_db=OWN_CONTRAST_DB if target.is_own else -math.inf,
                max_foreign_db_sl=_bound(contact, protected),
            )
        )
    return found + [
        Finger((each.x, each.y), load=each.load, max_foreign_db_sl=_bound(each, protected))
        for each in quiet
    ]


def _bound(contact: Contact, protected: frozenset[ContactKey]) -> float:
    """The level [dB SL] of others' vibrations that a finger may feel."""
    return IMPERCEPTIBLE_DB_SL if contact.key in protected else math.inf


def playable_band(
    band: tuple[float, float] | None, frequencies: FloatArray, playable: tuple[float, float]
) -> tuple[float, float]:
    """Return the lowest and highest frequency [Hz] of a band that can be played.

    A band that shares no frequency of a table with what is playable is ignored.
    """
    low, high = playable
    if band is not None:
        of_table = band_of_table(band, frequencies)
        together = max(low, of_table[0]), min(high, of_table[1])
        if ((frequencies >= together[0]) & (frequencies <= together[1])).any():
            low, high = together
    return low, high
