"""How short a watchdog the wire allows, worked out when a configuration is read."""

from drivers.errors import CommandError

HEARTBEAT = 0.05  # s; the control loop's own
HEARTBEATS_BORNE = 3  # two may be lost or late before the amplifier falls silent


def check_watchdog(watchdog: float, round_trip: float, *, heartbeat: float = HEARTBEAT) -> None:
    """Refuse a watchdog [s] shorter than three heartbeats and one round trip [s] on the wire.

    round_trip: of the longest exchange on the link; `round_trip_time` for serial lines, 0 in one
    process. Raises CommandError that says what the wire allows.
    """
    shortest = HEARTBEATS_BORNE * heartbeat + round_trip
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"a watchdog of {watchdog * 1e3:g} ms is too short: {HEARTBEATS_BORNE} heartbeats of "
            f"{heartbeat * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms need at least "
            f"{shortest * 1e3:.0f} ms; lengthen it, or use a faster line"
        )
