"""What the wire allows: how short a watchdog, and how soon a loss is told of.

Worked out when a configuration is read.
"""

from collections.abc import Iterable

from drivers.errors import CommandError
from drivers.link.link import REPLY_TIMEOUT, retries_on
from drivers.protocol.definition import PROTOCOL
from drivers.registry import open_backend

HEARTBEAT = 0.05  # s; the control loop's own
HEARTBEATS_BORNE = 3  # two may be lost or late before the amplifier falls silent


def round_trip_of(url: str, *, channels: int) -> float:
    """Time [s] that an apply of so many channels and its answer take on the wire of a URL.

    0 for wires whose speed is not in their URL: inside one process, or over a network. Raises
    CommandError for a URL that no backend understands.
    """
    return open_backend(url).round_trip(channels)


def shortest_watchdog(round_trip: float, *, heartbeat: float = HEARTBEAT) -> float:
    """The shortest watchdog [s] that a wire with this round trip [s] allows."""
    return HEARTBEATS_BORNE * heartbeat + round_trip


def check_watchdog(watchdog: float, round_trip: float, *, heartbeat: float = HEARTBEAT) -> None:
    """Refuse a watchdog [s] shorter than three heartbeats and one round trip [s] on the wire.

    round_trip: of the longest exchange on the link (see `round_trip_of`). Raises CommandError that
    says what the wire allows.
    """
    shortest = shortest_watchdog(round_trip, heartbeat=heartbeat)
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"a watchdog of {watchdog * 1e3:g} ms is too short: {HEARTBEATS_BORNE} heartbeats of "
            f"{heartbeat * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms need at least "
            f"{shortest * 1e3:.0f} ms; lengthen it, or use a faster line"
        )


def told_after(round_trips: Iterable[float], *, heartbeat: float = HEARTBEAT) -> float:
    """How long [s] it takes at most until amplifiers on one line that fall silent count as lost.

    All of them at once, right after an answer, and each is asked for a set next: one after the
    other, as often as `drivers.link` repeats it. round_trips [s]: of the longest exchange with
    each, see `round_trip_of`.
    """
    return heartbeat + sum(
        (1 + retries_on(round_trip)) * max(REPLY_TIMEOUT, round_trip + PROTOCOL.reaction)
        for round_trip in round_trips
    )
