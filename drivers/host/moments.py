"""Moments at which sets start, as a Commit names them to the clocks of several amplifiers.

A clock that is steered shows the host's time. One that is not has its own, by its readings: the
word that names a moment to it is another, and what has passed for others may be ahead for it.
"""

from collections.abc import Sequence
from typing import TypeVar

from drivers.host.dialogue import COMMITTING, Dialogue
from drivers.protocol.definition import (
    AHEAD_MAX,
    HIGH_TIME,
    HIGH_WORDS,
    clock_at,
    high_word,
    moment_of,
    word_passed,
)

_Amplifier = TypeVar("_Amplifier", bound=Dialogue)
_STEP = AHEAD_MAX // 2  # from a high word that is tried to the next


def words_of(moment: float, amplifiers: Sequence[_Amplifier]) -> dict[_Amplifier, int]:
    """Return the high words of the clocks of amplifiers at a moment [s], the nearest ones."""
    word = high_word(clock_at(moment + HIGH_TIME / 2))
    return {
        each: word if each.clock.can_be_steered else high_word(clock_at(_shown(each, moment)))
        for each in amplifiers
    }


def word_passed_by_all(now: float, amplifiers: Sequence[Dialogue]) -> int:
    """Return a high word that is no moment ahead for amplifiers, now [s] and a little later."""
    at = word_passed(now)
    others = [each for each in amplifiers if not each.clock.can_be_steered]
    times = [_shown(each, now + later) for each in others for later in (0.0, COMMITTING)]
    for _ in range(HIGH_WORDS // _STEP):
        if all(moment_of(at, time) is None for time in times):
            break
        at = (at - _STEP) % HIGH_WORDS
    return at


def _shown(amplifier: Dialogue, time: float) -> float:
    """Return what the clock of an amplifier shows at a time [s], to the nearest high word."""
    return time + amplifier.clock.lead(time) + HIGH_TIME / 2
