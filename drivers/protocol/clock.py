"""The clock of an amplifier as integers of the wire: 32 bits that go round once in 20 s.

A voice of frequency word n has the angle n times clock modulo 2^32, in turns of 2^-32.
"""

from drivers.protocol.table import AHEAD_MAX, CLOCK_TURN

SPAN = 1 << 32
HIGH_STEPS = 1 << 16
"""Steps of the clock in one of its high word, of which shifts and moments are whole numbers."""
HIGH_WORDS = SPAN // HIGH_STEPS
HIGH_TIME = CLOCK_TURN / HIGH_WORDS
"""Seconds of a step of the high word."""
MAX_AHEAD = AHEAD_MAX * HIGH_TIME
"""Seconds by which a Commit may name a moment ahead."""
_PER_SECOND = SPAN / CLOCK_TURN
_PASSED = 0.25  # s


def clock_at(seconds: float) -> int:
    """Return what a clock shows that many seconds after it showed 0."""
    return round(seconds % CLOCK_TURN * _PER_SECOND) % SPAN


def ahead(clock: int, of: int) -> float:
    """Return by how much [s] a clock is ahead of another, at most half a turn either way."""
    return ((clock - of + SPAN // 2) % SPAN - SPAN // 2) / _PER_SECOND


def word_passed(seconds: float) -> int:
    """Return a high word that is no moment ahead at a time [s], by a clock near `clock_at`.

    A quarter of a second behind: before it is steered, a clock may be some steps behind.
    """
    return high_word(clock_at(seconds - _PASSED))


def moment_behind(seconds: float) -> float:
    """Return when [s] a clock of `clock_at` next begins a high word, from a time [s] on."""
    return seconds + (-clock_at(seconds) % HIGH_STEPS) / _PER_SECOND


def moment_of(at: int, seconds: float) -> float | None:
    """Return the moment [s] that a Commit names which is sent at a time; None for at once.

    at: the high word of a clock of `clock_at`.
    """
    now = clock_at(seconds)
    left = (at * HIGH_STEPS - now) % SPAN
    return seconds + left / _PER_SECOND if 0 < left <= AHEAD_MAX * HIGH_STEPS else None


def high_word(clock: int) -> int:
    """Return the high word of a clock, as a Commit names a moment."""
    return clock // HIGH_STEPS
