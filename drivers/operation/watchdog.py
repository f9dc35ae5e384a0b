"""Shortest watchdog and loss detection time of a wire, computed when a configuration is read."""

from collections.abc import Iterable

from drivers.errors import CommandError
from drivers.link.link import REPLY_TIMEOUT, retries_on
from drivers.protocol.definition import PROTOCOL

HEARTBEAT = 0.05  # s; interval of the control loop's heartbeats
MIN_HEARTBEATS_PER_WATCHDOG = 3  # a watchdog must outlast this many intervals
MAX_LOSS_DETECTION_TIME = 3 * HEARTBEAT  # s; `era config check` warns of slower lines


def shortest_watchdog(round_trip: float) -> float:
    """Return the shortest watchdog [s] for a wire with this round trip [s]."""
    return MIN_HEARTBEATS_PER_WATCHDOG * HEARTBEAT + round_trip


def check_watchdog(watchdog: float, round_trip: float) -> None:
    """Raise CommandError for a watchdog [s] shorter than three heartbeats and one round trip [s].

    round_trip: of the longest exchange on the link (`Amplifier.round_trip`).
    """
    shortest = shortest_watchdog(round_trip)
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"watchdog must be at least {shortest * 1e3:.0f} ms ({MIN_HEARTBEATS_PER_WATCHDOG} "
            f"heartbeats of {HEARTBEAT * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms), "
            f"got {watchdog * 1e3:g} ms; lengthen it, or use a faster line"
        )


def loss_detection_time(round_trips: Iterable[float]) -> float:
    """Return the longest time [s] until silent amplifiers on one line count as degraded, or lost.

    Worst case: all fall silent right after a reply, and each is sent a set next, one after the
    other, with the repetitions of `drivers.link`. round_trips [s]: of the longest exchange of each.
    """
    return HEARTBEAT + sum(
        (1 + retries_on(round_trip)) * max(REPLY_TIMEOUT, round_trip + PROTOCOL.reaction)
        for round_trip in round_trips
    )
