"""How the amplifiers of a rig are connected, and how closely their clocks are then held.

For `era config check`, by their URLs alone; a daemon counts what it sees on the lines themselves.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import CommandError, LinkError
from drivers.wires.address import WireAddress
from drivers.wires.known import address_of


@dataclass(frozen=True)
class _Line:
    """A kind of line; error [s]: rms of a clock that is read over it; remedy: what is better."""

    name: str
    error: float
    remedy: str = ""


_ONE_BUS = "one bus for all of them"
_USB = _Line("USB, full speed", 17e-6, f"a high-speed adapter, or {_ONE_BUS}")
_NETWORK = _Line("a network", 12e-6, _ONE_BUS)
_NATIVE = _Line("the board's own ports", 3e-6)
_BUS = _Line("one bus", 3e-6)
_CONNECTION = _Line("one connection", 12e-6, _ONE_BUS)
_KINDS = (
    (r"(modbus|serial)\+tcp://", _NETWORK),
    (r"can\+(socketcan|python-can)://", _NATIVE),
    (r".*/dev/tty(S|AMA|O|PS|mxc|THS|SC)\d", _NATIVE),
)
"""Kinds of separate lines by their URLs; what is unknown is taken for USB at full speed."""


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
    """Arrangement of the amplifiers that have ERAs; None of one alone, and of simulated ones.

    urls, channels: as of `check_links`; stated: of each clock, by how much it may be wrong [s],
    infinite for one that cannot be steered. URLs that are invalid have no arrangement.
    """
    used = {name: url for name, url in urls.items() if channels.get(name)}
    addresses: dict[str, WireAddress] = {}
    for name, url in used.items():
        try:
            if not url.startswith("sim://"):
                addresses[name] = address_of(url)
        except (CommandError, LinkError):
            return None
    if len(addresses) < 2:
        return None
    if len({address.line for address in addresses.values()}) == 1:
        is_network = any(re.match(_KINDS[0][0], used[name]) for name in addresses)
        kinds = dict.fromkeys(addresses, _CONNECTION if is_network else _BUS)
        lines = next(iter(kinds.values())).name
    else:
        kinds = {name: _kind_of(used[name]) for name in addresses}
        lines = f"separate lines ({', '.join(sorted({each.name for each in kinds.values()}))})"
    worst = max(kinds.values(), key=lambda each: each.error)
    errors = {
        name: math.hypot(stated[name] / math.sqrt(3), each.error) for name, each in kinds.items()
    }
    return Arrangement(lines, errors, worst.remedy)


def _kind_of(url: str) -> _Line:
    """The kind of a line that one amplifier has for itself."""
    return next((kind for pattern, kind in _KINDS if re.match(pattern, url)), _USB)
