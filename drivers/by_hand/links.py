"""Checks of the amplifiers' URLs in a configuration, without opening them.

`check_links` finds errors and slow lines. `arrangement_of` estimates how closely the lines keep the
amplifiers' clocks.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import CommandError, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.rounding import FREQUENCY_FLOOR
from drivers.protocol.definition import (
    MAX_LOSS_DETECTION_TIME,
    QUANTITIES,
    check_watchdog,
    loss_detection_time,
)
from drivers.urls import BUS_ERROR, CLOCK_ERRORS
from drivers.wires.wire import (
    WireAddress,
    address_of,
    line_kind_of,
    reply_words,
    request_words,
)
from registry.limits import GuardLimits

_CEILING = QUANTITIES["frequency"].high


def check_links(
    urls: Mapping[str, str], *, channels: Mapping[str, int], limits: GuardLimits
) -> tuple[dict[str, str], list[str]]:
    """Return errors by amplifier name, and warnings.

    urls by name; channels: number of wired channels by name, missing if none; limits: of the
    rig.
    """
    errors: dict[str, str] = {}
    name_by_place: dict[tuple[str, int], str] = {}
    first_on_line: dict[str, WireAddress] = {}
    round_trips_by_line: dict[str, dict[str, float]] = defaultdict(dict)
    for name, url in urls.items():
        try:
            address = address_of(url)
            round_trip = address.make_wire().exchange_time(request_words("Set"), reply_words("Set"))
            check_watchdog(WATCHDOG, round_trip)
            first = first_on_line.setdefault(address.line, address)
            address.check_agrees(first.settings)
        except (CommandError, LinkError) as error:
            errors[name] = str(error)
            continue
        owner = name_by_place.setdefault((address.line, address.number), name)
        if owner != name:
            errors[name] = f"URL must be unique, got {url!r}, already used by amplifier {owner}"
        elif channels.get(name):
            round_trips_by_line[address.line][name] = round_trip
    warnings = _ceiling_warnings(limits)
    for round_trips in round_trips_by_line.values():
        warnings += _late_loss_warnings(round_trips)
    return errors, warnings


def _ceiling_warnings(limits: GuardLimits) -> list[str]:
    """Warn of limits beyond the fixed range of playback."""
    low = limits.frequency_min
    high = limits.frequency_max
    if low >= FREQUENCY_FLOOR and high <= _CEILING:
        return []
    return [
        f"limits.frequency should be within {FREQUENCY_FLOOR:g} to {_CEILING:g} Hz, got {low:g} to "
        f"{high:g} Hz; frequencies outside are never played"
    ]


def _late_loss_warnings(round_trips: Mapping[str, float]) -> list[str]:
    """Warn of a line on which a loss may be detected later than MAX_LOSS_DETECTION_TIME.

    round_trips [s]: of a set to each amplifier on the line, by name.
    """
    detection_time = loss_detection_time(round_trips.values())
    limit = MAX_LOSS_DETECTION_TIME
    if detection_time <= limit:
        return []
    return [
        f"{', '.join(round_trips)}: loss of the amplifiers may be detected only after "
        f"{detection_time * 1e3:.0f} ms, later than {limit * 1e3:.0f} ms; the watchdog stops them "
        "regardless: use a faster line, or one line per amplifier, if that is too late"
    ]


_ONE_BUS = "one bus for all amplifiers"
_HIGH_SPEED = f"a high-speed adapter, or {_ONE_BUS}"
_REMEDIES = {
    "usb-full-speed": _HIGH_SPEED,
    "ftdi-low-latency": _HIGH_SPEED,
    "ftdi": "the latency timer of the FTDI chip at 1 ms, or a high-speed adapter",
    "can-usb": "an adapter of high speed",
    "ethernet": _ONE_BUS,
}
"""Better alternatives to separate lines of a kind."""
_CLOCKS = "clocks of a smaller clock_error"


@dataclass(frozen=True)
class Arrangement:
    """Amplifiers with ERAs, by name; lines: their lines; errors: RMS errors of their clocks [s].

    remedy: how to synchronize them better; empty if that is impossible.
    """

    lines: str
    errors: Mapping[str, float]
    remedy: str


def arrangement_of(
    urls: Mapping[str, str], *, channels: Mapping[str, int], stated: Mapping[str, float]
) -> Arrangement | None:
    """Return the arrangement of the amplifiers with ERAs; None for a single one.

    urls, channels: see `check_links`; stated: specified error of each clock [s], infinite if it
    cannot be steered. Invalid URLs have no arrangement.
    """
    lines = set()
    kinds = {}
    for name, url in urls.items():
        if not channels.get(name):
            continue
        try:
            lines.add(address_of(url).line)
        except (CommandError, LinkError):
            return None
        kinds[name] = line_kind_of(url)
    if len(kinds) < 2:
        return None
    # Behind a serial server each amplifier has its own connection.
    is_bus = len(lines) == 1 and "ethernet" not in kinds.values()
    max_line_error = BUS_ERROR if is_bus else math.inf
    line_errors = {}
    clock_errors = {}
    errors = {}
    for name, kind in kinds.items():
        line_errors[name] = min(CLOCK_ERRORS[kind], max_line_error)
        clock_errors[name] = stated[name] / math.sqrt(3)
        errors[name] = math.hypot(clock_errors[name], line_errors[name])
    worst = max(errors, key=errors.__getitem__)
    remedy = "" if is_bus else _REMEDIES.get(kinds[worst], "")
    if clock_errors[worst] > line_errors[worst]:
        remedy = _CLOCKS
    count = "one line" if len(lines) == 1 else "separate lines"
    kind_names = ", ".join(sorted(set(kinds.values())))
    return Arrangement(f"{count} ({kind_names})", errors, remedy)
