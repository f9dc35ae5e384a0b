"""What can be said of a rig's amplifiers by their URLs alone: nothing is opened.

An entry point of the group `era_haptics.rig_checks`, for `era config check`.
"""

import math
from collections.abc import Mapping, Sequence

from drivers.amplifier import WATCHDOG
from drivers.backend import Backend
from drivers.errors import CommandError
from drivers.operation.watchdog import (
    HEARTBEAT,
    MAX_MISSED_HEARTBEATS,
    check_watchdog,
    loss_detection_time,
)
from drivers.registry import open_backend

# s; how far apart commits on two links may arrive although they are sent together: USB adapters
# send in frames of 1 ms, networks and operating systems are no better. See
# docs/reference/several-amplifiers.md.
APART = 0.001


def check_links(
    urls: Mapping[str, str], *, channels: Mapping[str, int], frequency_max: float
) -> tuple[dict[str, str], list[str]]:
    """What is wrong, by the amplifier's name, and what to be warned of.

    urls by name; channels: how many of each are wired, none for those left out; frequency_max [Hz]:
    up to which ERAs are driven.
    """
    wrong: dict[str, str] = {}
    backends: dict[str, Backend] = {}
    by_url: dict[str, str] = {}
    for name, url in urls.items():
        other = by_url.setdefault(url, name)
        if other != name:
            wrong[name] = f"{url!r} is amplifier {other}'s already; each has an address of its own"
            continue
        try:
            backends[name] = open_backend(url)
            check_watchdog(WATCHDOG, backends[name].wire_times.round_trip(channels.get(name, 0)))
        except CommandError as error:
            wrong[name] = str(error)
    links = {
        backend.bus or urls[name]
        for name, backend in backends.items()
        if channels.get(name) and name not in wrong and not urls[name].startswith("sim://")
    }
    used = {
        name: backend
        for name, backend in backends.items()
        if channels.get(name) and name not in wrong
    }
    return wrong, [*_apart(sorted(links), frequency_max), *_told_late(used, channels)]


def phase_error(frequency: float, apart: float) -> float:
    """By how much [degrees] ERAs are out of phase whose amplifiers begin so far apart [s]."""
    return 360.0 * frequency * apart


def contrast_left(frequency: float, apart: float) -> float:
    """Contrast [dB] that is left at a null of two equal halves that begin so far apart [s].

    Of exp(i phase) - 1 against one half, so none is left from 60 degrees on.
    """
    phase = min(math.radians(phase_error(frequency, apart)), math.pi)
    return max(0.0, -20.0 * math.log10(2.0 * math.sin(phase / 2.0)))


def _told_late(backends: Mapping[str, Backend], channels: Mapping[str, int]) -> list[str]:
    """Lines on which a loss cannot be told within three heartbeats, by arithmetic."""
    lines: dict[str, list[str]] = {}
    for name, backend in backends.items():
        lines.setdefault((backend.takes_turns and backend.bus) or name, []).append(name)
    bound = MAX_MISSED_HEARTBEATS * HEARTBEAT
    warnings = []
    for names in lines.values():
        took = loss_detection_time(
            backends[name].wire_times.round_trip(channels[name]) for name in names
        )
        if took > bound:
            warnings.append(
                f"{', '.join(names)}: loss of the amplifiers may be detected only after "
                f"{took * 1e3:.0f} ms, got a limit of {MAX_MISSED_HEARTBEATS} heartbeats, "
                f"{bound * 1e3:.0f} ms; the watchdog stops them regardless: use a faster line, or "
                "one line per amplifier, if that is too late"
            )
    return warnings


def _apart(links: Sequence[str], frequency_max: float) -> list[str]:
    if len(links) < 2:
        return []
    low = 100.0
    return [
        f"the ERAs hang on {len(links)} links ({', '.join(links)}), whose amplifiers may begin "
        f"{APART * 1e3:g} ms apart: ERAs of different links are then {phase_error(low, APART):.0f} "
        f"degrees out of phase at {low:g} Hz and {phase_error(frequency_max, APART):.0f} at "
        f"{frequency_max:g} Hz, and where they shall cancel each other "
        f"{contrast_left(low, APART):.0f} and {contrast_left(frequency_max, APART):.0f} dB of "
        "contrast are left; put ERAs that play one frequency together on one amplifier or one bus"
    ]
