"""URLs of amplifiers: their parts, and the synchronization error of clocks over their lines.

A URL is SCHEME://PLACE?NAME=VALUE&...#NUMBER. Each wire (`drivers.wires`) takes the parts that it
has. The kinds of lines have the names of the simulated ones (`sim.transport.simulated_line`).
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, unquote, urlsplit

from drivers.errors import CommandError

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
"""RMS error of a clock that is steered over a line, by kind of line [s].

The largest error that `python -m benchmarks.clocks` prints for the kind, from 1 s after arming. Not
valid for a bus without Marks, whose clocks are known less accurately at first.
"""

BUS_ERROR: Final = 7e-6
"""Maximum RMS error on one bus of any kind with Marks, which compare its clocks [s]."""

SIMULATED: Final = "usb-high-speed"
"""Kind of line of a simulated amplifier without a stated kind, in a rig with several."""
KIND_OF_PORT: Mapping[str, str] = {
    "ttyUSB": "ftdi-low-latency",
    "ttyACM": "usb-full-speed",
    "ttyS": "native",
    "ttyAMA": "native",
    "ttyO": "native",
    "ttyPS": "native",
    "ttymxc": "native",
    "ttyTHS": "native",
    "ttySC": "native",
}
"""Kind of line by the name of a serial port without its number."""
UNKNOWN_KIND: Final = "usb-full-speed"
"""Kind of line assumed for other port names and for schemes of plug-ins."""


def kind_of_device(path: str) -> str:
    """Return the kind of line of a serial port."""
    port = re.match(r"/dev/([a-zA-Z]+)\d", path)
    return KIND_OF_PORT.get(port[1], UNKNOWN_KIND) if port else UNKNOWN_KIND


def stated_kind(url: str) -> str:
    """Return the kind of line that an amplifier's URL states; empty if it states none."""
    query = url.partition("?")[2].partition("#")[0]
    return dict(parse_qsl(query)).get("line", "")


ADDRESS: Final = 1
"""Factory default of an amplifier's address, unit or node."""
BAUD: Final = 921_600
"""Default of a serial line [baud]; 8 data bits, no parity, 1 stop bit."""
RTU_BAUD: Final = 115_200
"""Default of a Modbus line [baud]; 8 data bits, even parity, 1 stop bit."""
ADDRESS_MAX: Final = 247
"""Maximum unit, and maximum address on a serial line, so that one label serves both."""

_BAUD_MAX = 12_000_000  # the fastest USB adapters
_DIGITS_MAX = 9  # more are out of every range, and int() rejects thousands of digits


@dataclass(frozen=True)
class Endpoint:
    """A serial device of this machine, or a network port.

    baud, parity (as named by pyserial) and stop bits belong to the device, or to the line behind a
    gateway; baud is 0 if unknown.
    """

    device: str = ""
    host: str = ""
    port: int = 0
    baud: int = 0
    parity: str = "N"
    stop: int = 1

    @property
    def name(self) -> str:
        """Name of the line in messages."""
        return self.device or f"{self.host}:{self.port}"

    @property
    def byte_time(self) -> float:
        """Duration of a byte [s] with start, parity and stop bits; 0 if unknown."""
        if not self.baud:
            return 0.0
        parity_bits = 0 if self.parity == "N" else 1
        return (9 + parity_bits + self.stop) / self.baud


class AmplifierUrl:
    """A URL, from which a wire takes its parts; CommandError for an invalid one.

    form: valid URLs, for messages; known: names of its options. Every URL can also have `line`: the
    kind of link between host and amplifier, a key of `CLOCK_ERRORS`.
    """

    def __init__(self, url: str, form: str, known: Collection[str] = ()) -> None:
        self._url = url
        self._form = form
        scheme, _, location = url.partition("://")
        self.scheme = scheme.lower()
        # In the path of a device, # is an ordinary character unless an address follows.
        ordinary = r"#(?!\d+$)" if self.scheme == "serial" else r"#(?=.*#)"
        try:
            parts = urlsplit("//" + re.sub(ordinary, "%23", location))
            self.host = parts.hostname or ""
            self.port = parts.port or 0
        except ValueError as error:
            raise self.refused(f"URL must be valid: {error}") from None
        self.place = parts.netloc
        self.number = parts.fragment
        self.path = unquote(parts.path, errors="surrogateescape")  # file names are bytes
        pairs = parse_qsl(parts.query, keep_blank_values=True, errors="surrogateescape")
        self.options = dict(pairs)
        self._check_options((*known, "line"))
        self.require(len(pairs) == len(self.options), "an option must not be repeated")
        kind = self.options.get("line", "prompt")
        kinds = ", ".join(CLOCK_ERRORS)
        self.require(kind in CLOCK_ERRORS, f"line must be one of {kinds}, got {kind!r}")

    def _check_options(self, names: Collection[str]) -> None:
        """Raise CommandError for an option with another name."""
        unknown = sorted(self.options.keys() - set(names))
        self.require(
            not unknown, f"option {', '.join(unknown)} is unknown; known: {', '.join(names)}"
        )

    def refused(self, why: str) -> CommandError:
        """Return the error for an invalid URL; why: as `X must be Y`."""
        return CommandError(f"{self._url!r}: {why}; use {self._form}")

    def require(self, is_right: bool, why: str) -> None:
        """Raise CommandError unless a condition is met; why: see `refused`."""
        if not is_right:
            raise self.refused(why)

    def whole(self, text: str, name: str, high: int, *, low: int = 1) -> int:
        """Parse a part of the URL as an integer in a range."""
        is_number = text.isascii() and text.isdigit() and len(text) <= _DIGITS_MAX
        self.require(
            is_number and low <= int(text) <= high,
            f"{name} must be an integer of {low} to {high}, got {text!r}",
        )
        return int(text)

    def whole_option(self, name: str, default: int, high: int, *, low: int = 1) -> int:
        """Parse an option that is an integer in a range."""
        return self.whole(self.options.get(name, str(default)), name, high, low=low)

    def device(self, baud: int) -> Endpoint:
        """Return the serial device in the path; baud: default."""
        self.require(
            not self.place, f"path of the port must follow three slashes, got {self.place!r}"
        )
        self.require(bool(self.path.strip("/")), "path of the port must be given")
        return Endpoint(self.path, baud=self._baud(baud))

    def server(self, *, port: int = 0, number: str = "") -> Endpoint:
        """Return the network port; port: default; number: see `check_path`."""
        if number:
            self.check_path(self.path, number)
        port = self.port or port
        self.require(bool(self.host), f"host must be given, got {self.place!r}")
        self.require(bool(port), f"port must be given, got {self.place!r}")
        return Endpoint(host=self.host, port=port, baud=self._baud(0))

    def check_path(self, rest: str, number: str) -> None:
        """Reject anything in the rest of a path; number: how an amplifier's number is given."""
        rest = rest.strip("/")
        self.require(not rest, f"{number.format(rest)}, got /{rest} in the path")

    def _baud(self, default: int) -> int:
        if "baud" not in self.options:
            return default
        return self.whole_option("baud", default, _BAUD_MAX)


def with_fragment(url: str, number: int) -> str:
    """Return the URL with another number behind `#`."""
    without_number = url.rpartition("#")[0] or url
    return f"{without_number}#{number}"
