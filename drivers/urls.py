"""URLs of amplifiers: their parts, and the synchronisation error of clocks over their lines.

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
"""By the name of a serial port without its number."""
KIND_OF_SCHEME: Mapping[str, str] = {
    **dict.fromkeys(("serial+tcp", "modbus+tcp", "can+socketcand"), "ethernet"),
    **dict.fromkeys(("can+socketcan", "can+python-can"), "can"),
    "can+slcan": "can-usb",
    "sim": SIMULATED,
}
"""By the scheme of a URL that names no serial port."""
SCHEMES_OF_PORTS: Final = ("serial", "modbus+rtu")
"""Schemes of URLs that name a serial port."""
UNKNOWN_KIND: Final = "usb-full-speed"
"""Assumed for a port of another name and for the scheme of a plug-in."""


def line_kind_of(url: str) -> str:
    """Return the kind of line of an amplifier's URL; a key of `CLOCK_ERRORS` if it is valid."""
    scheme, _, rest = url.partition("://")
    scheme = scheme.lower()
    query = rest.partition("?")[2].partition("#")[0]
    stated_kind = dict(parse_qsl(query)).get("line")
    if stated_kind:
        return stated_kind
    if scheme in SCHEMES_OF_PORTS:
        port = re.match(r"/dev/([a-zA-Z]+)\d", rest)
        return KIND_OF_PORT.get(port[1], UNKNOWN_KIND) if port else UNKNOWN_KIND
    return KIND_OF_SCHEME.get(scheme, UNKNOWN_KIND)


ADDRESS: Final = 1
"""Factory default of an amplifier's address, unit or node."""
BAUD: Final = 921_600
"""Default of a serial line [baud]; 8 data bits, no parity, 1 stop bit."""
RTU_BAUD: Final = 115_200
"""Of a Modbus line whose URL names none [baud]; 8 data bits, even parity, 1 stop bit."""
ADDRESS_MAX: Final = 247
"""Of a unit, and of an address on a serial line, so that one label serves both."""

_BAUD_MAX = 12_000_000  # the fastest USB adapters
_DIGITS_MAX = 9  # more are out of every range, and int() rejects thousands of digits


@dataclass(frozen=True)
class Endpoint:
    """What carries bytes: a serial device of this machine, or a port of the network.

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
        """How long a byte takes [s], with start, parity and stop bits; 0 if unknown."""
        return (9 + (self.parity != "N") + self.stop) / self.baud if self.baud else 0.0


class AmplifierUrl:
    """A URL, from which a wire takes its parts; CommandError for an invalid one.

    form: valid URLs, for messages; known: names of its options. Every URL can also have `line`: the
    kind of link between host and amplifier, a key of `CLOCK_ERRORS`.
    """

    def __init__(self, url: str, form: str, known: Collection[str] = ()) -> None:
        self._url, self._form = url, form
        scheme, _, rest = url.partition("://")
        self.scheme = scheme.lower()
        # In the path of a device # is a letter as any other, unless an address follows.
        letter = r"#(?!\d+$)" if self.scheme == "serial" else r"#(?=.*#)"
        try:
            parts = urlsplit(f"//{re.sub(letter, '%23', rest)}")
            self.host, self.port = parts.hostname or "", parts.port or 0
        except ValueError as error:
            raise self.refused(f"URL must be valid: {error}") from None
        self.place, self.number = parts.netloc, parts.fragment
        self.path = unquote(parts.path, errors="surrogateescape")  # names of files are bytes
        pairs = parse_qsl(parts.query, keep_blank_values=True, errors="surrogateescape")
        self.options = dict(pairs)
        known = (*known, "line")
        unknown = sorted(self.options.keys() - set(known))
        self.require(
            not unknown,
            f"option {', '.join(unknown)} is unknown; known: {', '.join(known)}",
        )
        self.require(len(pairs) == len(self.options), "an option must not be repeated")
        kind = self.options.get("line", "prompt")
        self.require(
            kind in CLOCK_ERRORS, f"line must be one of {', '.join(CLOCK_ERRORS)}, got {kind!r}"
        )

    def refused(self, why: str) -> CommandError:
        """Return the error for a URL that is invalid: why, as `X must be Y`."""
        return CommandError(f"{self._url!r}: {why}; use {self._form}")

    def require(self, is_right: bool, why: str) -> None:
        """Raise CommandError, and why as `refused`, unless the URL is right in something."""
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
        """Parse an option that is an integer of a range."""
        return self.whole(self.options.get(name, str(default)), name, high, low=low)

    def device(self, baud: int) -> Endpoint:
        """Return the serial device in the path; baud: default."""
        self.require(
            not self.place, f"path of the port must follow three slashes, got {self.place!r}"
        )
        self.require(bool(self.path.strip("/")), "path of the port must be given")
        return Endpoint(self.path, baud=self._baud(baud))

    def server(self, *, port: int = 0, number: str = "") -> Endpoint:
        """Return the port of the network; port: the default; number: see `check_path`."""
        if number:
            self.check_path(self.path, number)
        for name, value in (("host", self.host), ("port", self.port or port)):
            self.require(bool(value), f"{name} must be given, got {self.place!r}")
        return Endpoint(host=self.host, port=self.port or port, baud=self._baud(0))

    def check_path(self, rest: str, number: str) -> None:
        """Refuse the rest of a path; number: of an amplifier, as it must be given in its place."""
        rest = rest.strip("/")
        self.require(not rest, f"{number.format(rest)}, got /{rest} in the path")

    def _baud(self, default: int) -> int:
        return self.whole_option("baud", default, _BAUD_MAX) if "baud" in self.options else default


def with_address(url: str, address: int) -> str:
    """Return the URL with another address, unit or node; CommandError for a wire without any."""
    scheme = url.partition("://")[0]
    if scheme in ("serial", "serial+tcp"):
        kept = re.sub(r"(?<=[?&])address=\d+&?", "", url).rstrip("?&")
        return f"{kept}{'&' if '?' in kept else '?'}address={address}"
    if scheme == "modbus+tcp":
        place, _, options = url.partition("?")
        host = "/".join(place.split("/")[:3])
        return f"{host}/{address}" + (f"?{options}" if options else "")
    if scheme == "modbus+rtu" or scheme.startswith("can"):
        return f"{url.rpartition('#')[0] or url}#{address}"
    raise CommandError(f"amplifiers at {url} have no address that can be set")
