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
_URL = re.compile(
    r"(?P<scheme>[a-z+]+)://(?P<place>/[^?#]*|[^/?#]+)(?P<path>/[^?#]*)?(?P<query>\?[^#]*)?"
    r"(?P<fragment>#.*)?"
)


@dataclass(frozen=True)
class Place:
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


def place_of(url: str) -> Place:
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
    speed = options.get("baud", str(_BAUD.get(kind, 0)))
    if not (number.isdecimal() and speed.isdecimal()):
        raise InputError(f"{url}: the number of the amplifier, or the speed, is no whole number")
    if not (found["place"].startswith("/") or found["place"].rpartition(":")[2].isdecimal()):
        raise InputError(f"{url}: {found['place']} is neither a device nor HOST:PORT")
    return Place(url, kind, found["place"], int(number), int(speed))
