"""Shortest watchdog and time to detect a loss on a wire, by arithmetic; times in s."""

from collections.abc import Iterable

from drivers.errors import CommandError
from drivers.protocol.table import MESSAGES, REACTION

BOOT_TIME = 6.0
"""For the first reply on a line [s], of a board that restarts when its port is opened."""
REPLY_TIMEOUT = 0.030
"""For a reply [s], on a wire that is fast; a heartbeat and three of these are less than 150 ms."""
FAST = REPLY_TIMEOUT - REACTION
"""Longest exchange [s] whose reply is here by then."""
ATTEMPTS = 3
"""Of a request; one less where the wire is slow."""
STOP_RAMP = 0.005
"""Shortest ramp without a step [s]."""
HEARTBEAT = 0.05
"""Interval of heartbeats [s]."""
MAX_LOSS_DETECTION_TIME = 3 * HEARTBEAT
"""Longest time to detect a loss without a warning [s]."""
_HEARTBEATS = 3  # a watchdog must outlast this many intervals

SET_WORDS = MESSAGES["Set"].request.words
"""Of a part of a set, before its stream."""


def shortest_watchdog(round_trip: float) -> float:
    """Return the shortest watchdog for a wire with this round trip of a set."""
    return _HEARTBEATS * HEARTBEAT + round_trip


def check_watchdog(watchdog: float, round_trip: float) -> None:
    """Raise CommandError for a watchdog shorter than three heartbeats and one round trip."""
    shortest = shortest_watchdog(round_trip)
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"watchdog must be at least {shortest * 1e3:.0f} ms ({_HEARTBEATS} heartbeats of "
            f"{HEARTBEAT * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms), got "
            f"{watchdog * 1e3:g} ms; use a faster line"
        )


def loss_detection_time(round_trips: Iterable[float]) -> float:
    """Return the longest time until silent amplifiers on one line are known to be so.

    At the worst all fall silent right after a reply, and each is sent a set next, one after the
    other, with all attempts: one less where it takes long. round_trips: of the longest set to each.
    """
    detected = HEARTBEAT
    for round_trip in round_trips:
        slow = (ATTEMPTS - 1) * (REPLY_TIMEOUT + round_trip - FAST)
        detected += max(ATTEMPTS * REPLY_TIMEOUT, slow)
    return detected
