"""What the wire allows: how short a watchdog, and how soon a loss is told of.

Worked out when a configuration is read.
"""

from collections.abc import Iterable

from drivers.errors import CommandError
from drivers.link.link import REPLY_TIMEOUT, retries_on
from drivers.protocol.definition import PROTOCOL

HEARTBEAT = 0.05  # s; the control loop's own
MAX_MISSED_HEARTBEATS = 3  # two may be lost or late before the amplifier falls silent


def shortest_watchdog(round_trip: float) -> float:
    """The shortest watchdog [s] that a wire with this round trip [s] allows."""
    return MAX_MISSED_HEARTBEATS * HEARTBEAT + round_trip


def check_watchdog(watchdog: float, round_trip: float) -> None:
    """Refuse a watchdog [s] shorter than three heartbeats and one round trip [s] on the wire.

    round_trip: of the longest exchange on the link (`Backend.round_trip`). Raises CommandError that
    says what the wire allows.
    """
    shortest = shortest_watchdog(round_trip)
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"watchdog must be at least {shortest * 1e3:.0f} ms ({MAX_MISSED_HEARTBEATS} "
            f"heartbeats of {HEARTBEAT * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms), "
            f"got {watchdog * 1e3:g} ms; lengthen it, or use a faster line"
        )


def loss_detection_time(round_trips: Iterable[float]) -> float:
    """How long [s] it takes at most until amplifiers on one line that fall silent count as lost.

    All of them at once, right after an answer, and each is asked for a set next: one after the
    other, as often as `drivers.link` repeats it. round_trips [s]: of the longest exchange with
    each, see `Backend.round_trip`.
    """
    return HEARTBEAT + sum(
        (1 + retries_on(round_trip)) * max(REPLY_TIMEOUT, round_trip + PROTOCOL.reaction)
        for round_trip in round_trips
    )
