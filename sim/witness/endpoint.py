"""Where a URL leads, so that a relay can stand in between, and what the witness calls that wire."""

import re
from dataclasses import dataclass

from model.errors import InputError

_KINDS = {
    "serial": "serial",
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+socketcand": "socketcand",
    "can+slcan": "slcan",
}
_BAUD = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 115_200}
# Of amplifiers, as docs/reference/wire-*.md have them; over TCP 255 is whoever is alone.
_NUMBERS = {
    "serial": range(1, 248),
    "modbus-tcp": range(1, 256),
    "modbus-rtu": range(1, 248),
    "socketcand": range(1, 64),
    "slcan": range(1, 64),
}
_PORTS = range(1, 65536)
_URL = re.compile(
    r"(?P<scheme>[a-z+]+)://(?P<place>/[^?#]*|[^/?#]+)(?P<path>/[^?#]*)?(?P<query>\?[^#]*)?"
    r"(?P<fragment>#.*)?"
)


@dataclass(frozen=True)
class WireEndpoint:
    """A URL taken apart. kind: of wire; place: a device or HOST:PORT; address: on the wire."""

    url: str
    kind: str
    place: str
    address: int
    baud: int

    @property
    def is_device(self) -> bool:
        """Whether it is a serial port of this machine."""
        return self.place.startswith("/")

    def through(self, other: str) -> str:
        """The URL that leads to another place instead, and is the same in all else."""
        return self.url.replace(self.place, other, 1)


def parse_endpoint(url: str) -> WireEndpoint:
    """Take a URL apart; raises InputError for one that no relay can stand in."""
    found = _URL.fullmatch(url)
    kind = _KINDS.get(found["scheme"]) if found else None
    if found is None or kind is None:
        raise InputError(
            f"{url}: no relay can stand in this wire; write a URL as era sim prints it, with one "
            f"of {', '.join(_KINDS)}"
        )
    options = dict(re.findall(r"([a-z]+)=([^&#]*)", found["query"] or ""))
    if kind == "serial":
        number = options.get("address", "1")
    elif kind == "modbus-tcp":
        number = (found["path"] or "/1")[1:]
    else:
        number = (found["fragment"] or "#1")[1:]
    place, speed = found["place"], options.get("baud", str(_BAUD.get(kind, 0)))
    if not (number.isdecimal() and int(number) in _NUMBERS[kind]):
        among = _NUMBERS[kind]
        raise InputError(
            f"{url}: {number!r} is no number of an amplifier; on this kind of wire they go from "
            f"{among[0]} to {among[-1]}"
        )
    if not speed.isdecimal():
        raise InputError(f"{url}: baud {speed!r} is no whole number of bit/s, as in baud=115200")
    port = place.rpartition(":")[2]
    if not (place.startswith("/") or (port.isdecimal() and int(port) in _PORTS)):
        raise InputError(
            f"{url}: {place} is neither a device, as in /dev/ttyUSB0, nor HOST:PORT with a port of "
            f"{_PORTS[0]} to {_PORTS[-1]}"
        )
    return WireEndpoint(url, kind, place, int(number), int(speed))
