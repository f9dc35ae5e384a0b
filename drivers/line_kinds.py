"""Kinds of lines between a host and amplifiers, and how closely clocks are held over each.

They have the names of the lines that are simulated (`sim.transport.line_kinds`).
"""

import re
from collections.abc import Mapping
from typing import Final
from urllib.parse import parse_qsl

CLOCK_ERRORS: Mapping[str, float] = {
    "prompt": 0.0,
    "native": 3e-6,
    "usb-high-speed": 5e-6,
    "usb-full-speed": 27e-6,
    "ftdi": 54e-6,
    "ftdi-low-latency": 86e-6,
    "can": 2e-6,
    "can-usb": 3e-6,
    "ethernet": 4e-6,
}
"""Error of a clock that is held over a line of a kind, rms [s].

The largest that `python -m benchmarks.clocks` prints of a kind, from 1 s after arming on; not
of a bus without Marks, whose clocks are known less well at first.
"""

BUS_ERROR: Final = 7e-6
"""The same at most on one bus of any kind, whose Marks say how its clocks differ, rms [s]."""

SIMULATED: Final = "usb-high-speed"
"""Of a simulated amplifier whose URL names no kind, where a rig has several."""
KIND_OF_PORT: Mapping[str, str] = {
    "ttyUSB": "ftdi-low-latency",
    "ttyACM": "usb-full-speed",
    **dict.fromkeys(("ttyS", "ttyAMA", "ttyO", "ttyPS", "ttymxc", "ttyTHS", "ttySC"), "native"),
}
"""By the name of a serial port without its number; others are taken for USB at full speed."""
_KIND_OF_SCHEME = {
    **dict.fromkeys(("serial+tcp", "modbus+tcp", "can+socketcand"), "ethernet"),
    **dict.fromkeys(("can+socketcan", "can+python-can"), "can"),
    "can+slcan": "can-usb",
}


def line_kind_of(url: str) -> str:
    """Return the kind of line of an amplifier's URL, a key of `CLOCK_ERRORS` where it is valid."""
    scheme, _, rest = url.partition("://")
    if kind := dict(parse_qsl(rest.partition("?")[2].partition("#")[0])).get("line"):
        return kind
    if scheme == "sim":
        return SIMULATED
    port = re.match(r"/dev/([a-zA-Z]+)\d", rest)
    by_scheme = _KIND_OF_SCHEME.get(scheme, "usb-full-speed")
    return (
        KIND_OF_PORT.get(port[1], by_scheme)
        if port and by_scheme == "usb-full-speed"
        else by_scheme
    )
