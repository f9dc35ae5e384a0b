"""The wire endpoint of an amplifier's URL, for a relay in front of it."""

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
# Addresses by kind of wire, from docs/reference/wire-*.md; over TCP 255 is the only unit.
_ADDRESSES = {
    "serial": range(1, 248),
    "modbus-tcp": range(1, 256),
    "modbus-rtu": range(1, 248),
    "socketcand": range(1, 64),
    "slcan": range(1, 64),
}
_PORTS = range(1, 65536)
_URL = re.compile(
    r"(?P<scheme>[a-z+]+)://(?P<location>/[^?#]*|[^/?#]+)(?P<path>/[^?#]*)?(?P<query>\?[^#]*)?"
    r"(?P<fragment>#.*)?"
)


@dataclass(frozen=True)
class WireEndpoint:
    """A parsed URL. kind: of wire; location: device or HOST:PORT; address: on the wire."""

    url: str
    kind: str
    location: str
    address: int
    baud: int

    @property
    def is_device(self) -> bool:
        """Whether it is a serial port."""
        return self.location.startswith("/")

    def url_via(self, other: str) -> str:
        """The URL with another location."""
        return self.url.replace(self.location, other, 1)


def parse_endpoint(url: str) -> WireEndpoint:
    """Parse a URL; raises InputError where no relay is possible."""
    found = _URL.fullmatch(url)
    kind = _KINDS.get(found["scheme"]) if found else None
    if found is None or kind is None:
        raise InputError(
            f"{url}: scheme must be one of {', '.join(_KINDS)}; write a URL as era sim prints it"
        )
    options = dict(re.findall(r"([a-z]+)=([^&#]*)", found["query"] or ""))
    if kind == "serial":
        number = options.get("address", "1")
    elif kind == "modbus-tcp":
        number = (found["path"] or "/1")[1:]
    else:
        number = (found["fragment"] or "#1")[1:]
    location, speed = found["location"], options.get("baud", str(_BAUD.get(kind, 0)))
    if not (number.isdecimal() and int(number) in _ADDRESSES[kind]):
        among = _ADDRESSES[kind]
        raise InputError(
            f"{url}: address must be {among[0]} to {among[-1]} on this kind of wire, got {number!r}"
        )
    if not speed.isdecimal():
        raise InputError(f"{url}: baud must be whole bit/s, as in baud=115200, got {speed!r}")
    port = location.rpartition(":")[2]
    if not (location.startswith("/") or (port.isdecimal() and int(port) in _PORTS)):
        raise InputError(
            f"{url}: location must be a device, as in /dev/ttyUSB0, or HOST:PORT with a port of "
            f"{_PORTS[0]} to {_PORTS[-1]}, got {location}"
        )
    return WireEndpoint(url, kind, location, int(number), int(speed))
