"""How the amplifiers of a rig are connected, and how closely their clocks are then held.

For `era config check`, by their URLs alone; a daemon counts what it sees on the lines themselves.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import CommandError, LinkError
from drivers.line_kinds import CLOCK_ERRORS, line_kind_of
from drivers.wires.address import WireAddress
from drivers.wires.known import address_of

_ONE_BUS = "one bus for all of them"
_REMEDIES = {
    **dict.fromkeys(("usb-full-speed", "ftdi-low-latency"), f"a high-speed adapter, or {_ONE_BUS}"),
    "ftdi": "the latency timer of the FTDI chip at 1 ms, or a high-speed adapter",
    "can-usb": "an adapter of high speed",
    "ethernet": _ONE_BUS,
}
"""What is better, by the kind of line; nothing much for others."""


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
    errors = {
        name: math.hypot(stated[name] / math.sqrt(3), CLOCK_ERRORS[kind])
        for name, kind in kinds.items()
    }
    worst = max(kinds.values(), key=CLOCK_ERRORS.__getitem__)
    return Arrangement(lines, errors, _REMEDIES.get(worst, ""))
