"""How short a watchdog the wire allows, worked out when a configuration is read."""

from urllib.parse import urlsplit

from drivers.backends.serial_url import SerialUrl
from drivers.errors import CommandError
from drivers.protocol.serial_timing import round_trip_time

HEARTBEAT = 0.05  # s; the control loop's own
HEARTBEATS_BORNE = 3  # two may be lost or late before the amplifier falls silent


def round_trip_of(url: str, *, channels: int) -> float:
    """Time [s] that an apply of so many channels and its answer take on the wire of a URL.

    0 for wires whose speed is not in their URL: inside one process, or over a network.
    """
    if urlsplit(url).scheme != "serial" or urlsplit(url).netloc:
        return 0.0
    return round_trip_time(channels, baud=SerialUrl.parse(url).baud)


def check_watchdog(watchdog: float, round_trip: float, *, heartbeat: float = HEARTBEAT) -> None:
    """Refuse a watchdog [s] shorter than three heartbeats and one round trip [s] on the wire.

    round_trip: of the longest exchange on the link (see `round_trip_of`). Raises CommandError that
    says what the wire allows.
    """
    shortest = HEARTBEATS_BORNE * heartbeat + round_trip
    if not watchdog >= shortest - 1e-9:  # sums of floats
        raise CommandError(
            f"a watchdog of {watchdog * 1e3:g} ms is too short: {HEARTBEATS_BORNE} heartbeats of "
            f"{heartbeat * 1e3:g} ms and a round trip of {round_trip * 1e3:.1f} ms need at least "
            f"{shortest * 1e3:.0f} ms; lengthen it, or use a faster line"
        )
