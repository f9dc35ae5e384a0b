"""A rig's amplifiers by their URLs alone, for `era config check`: what is wrong, how they connect.

Nothing is opened. A daemon counts how closely clocks are held by what it sees on the lines.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import CommandError, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.bounds import FREQUENCY_FLOOR
from drivers.protocol.definition import (
    MAX_LOSS_DETECTION_TIME,
    QUANTITIES,
    check_watchdog,
    loss_detection_time,
)
from drivers.urls import BUS_ERROR, CLOCK_ERRORS, line_kind_of
from drivers.wires.known import address_of
from drivers.wires.wire import WireAddress, reply_words, request_words
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
    addresses: dict[str, WireAddress] = {}
    round_trips: dict[str, float] = {}
    by_place: dict[tuple[str, int], str] = {}
    lines: dict[str, WireAddress] = {}
    for name, url in urls.items():
        try:
            address = address_of(url)
            words = request_words("Set"), reply_words("Set")
            round_trips[name] = address.make_wire().exchange_time(*words)
            check_watchdog(WATCHDOG, round_trips[name])
            address.check_agrees(lines.setdefault(address.line, address).settings)
        except (CommandError, LinkError) as error:
            errors[name] = str(error)
            continue
        other = by_place.setdefault((address.line, address.number), name)
        if other != name:
            errors[name] = f"URL must be unique, got {url!r}, where amplifier {other} is"
            continue
        addresses[name] = address
    used = {name: address for name, address in addresses.items() if channels.get(name)}
    warnings = [
        *_ceiling_warnings(limits),
        *_late_loss_warnings(used, round_trips),
    ]
    return errors, warnings


def _ceiling_warnings(limits: GuardLimits) -> list[str]:
    """Warn of limits beyond what is played whatever the configuration says."""
    low, high = limits.frequency_min, limits.frequency_max
    if low >= FREQUENCY_FLOOR and high <= _CEILING:
        return []
    return [
        f"limits.frequency should be within {FREQUENCY_FLOOR:g} to {_CEILING:g} Hz, got {low:g} to "
        f"{high:g} Hz; frequencies beyond are never played"
    ]


def _late_loss_warnings(
    addresses: Mapping[str, WireAddress], round_trips: Mapping[str, float]
) -> list[str]:
    """Warn of lines on which a loss may be detected later than MAX_LOSS_DETECTION_TIME.

    round_trips [s]: of a set to each.
    """
    lines: dict[str, list[str]] = {}
    for name, address in addresses.items():
        lines.setdefault(address.line, []).append(name)
    limit = MAX_LOSS_DETECTION_TIME
    warnings = []
    for names in lines.values():
        took = loss_detection_time(map(round_trips.__getitem__, names))
        if took > limit:
            warnings.append(
                f"{', '.join(names)}: loss of the amplifiers may be detected only after "
                f"{took * 1e3:.0f} ms, later than {limit * 1e3:.0f} ms; the watchdog stops them "
                "regardless: use a faster line, or one line per amplifier, if that is too late"
            )
    return warnings


_ONE_BUS = "one bus for all of them"
_REMEDIES = {
    **dict.fromkeys(("usb-full-speed", "ftdi-low-latency"), f"a high-speed adapter, or {_ONE_BUS}"),
    "ftdi": "the latency timer of the FTDI chip at 1 ms, or a high-speed adapter",
    "can-usb": "an adapter of high speed",
    "ethernet": _ONE_BUS,
}
"""What is better than lines of a kind, each its own; nothing much for others."""
_CLOCKS = "clocks of a smaller clock_error"


@dataclass(frozen=True)
class Arrangement:
    """Amplifiers with ERAs; lines: over which they are reached; errors: of their clocks, rms [s].

    By name; remedy: how they would be held closer, empty where they are as close as it gets.
    """

    lines: str
    errors: Mapping[str, float]
    remedy: str


def arrangement_of(
    urls: Mapping[str, str], *, channels: Mapping[str, int], stated: Mapping[str, float]
) -> Arrangement | None:
    """Arrangement of the amplifiers that have ERAs; None of one alone.

    urls, channels: as of `check_links`; stated: of each clock, by how much it may be wrong [s],
    infinite for one that cannot be steered. URLs that are invalid have no arrangement.
    """
    addresses: dict[str, WireAddress] = {}
    for name, url in urls.items():
        try:
            if channels.get(name):
                addresses[name] = address_of(url)
        except (CommandError, LinkError):
            return None
    if len(addresses) < 2:
        return None
    kinds = {name: line_kind_of(urls[name]) for name in addresses}
    is_one = len({address.line for address in addresses.values()}) == 1
    lines = f"{'one line' if is_one else 'separate lines'} ({', '.join(sorted({*kinds.values()}))})"
    is_bus = is_one and "ethernet" not in kinds.values()  # behind which each has its connection
    highest = BUS_ERROR if is_bus else math.inf
    by_line = {name: min(CLOCK_ERRORS[kind], highest) for name, kind in kinds.items()}
    by_clock = {name: stated[name] / math.sqrt(3) for name in kinds}
    errors = {name: math.hypot(by_clock[name], by_line[name]) for name in kinds}
    worst = max(errors, key=errors.__getitem__)
    remedy = "" if is_bus else _REMEDIES.get(kinds[worst], "")
    return Arrangement(lines, errors, _CLOCKS if by_clock[worst] > by_line[worst] else remedy)
