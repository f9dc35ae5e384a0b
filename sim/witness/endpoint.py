"""The wire endpoint of an amplifier's URL, for a relay in front of it."""

from dataclasses import dataclass

from drivers.codec.can_bus.segments import NODE_MAX
from drivers.errors import CommandError
from drivers.urls import ADDRESS, ADDRESS_MAX, BAUD, RTU_BAUD, AmplifierUrl
from model.errors import InputError

_KINDS = {
    "serial": ("serial", BAUD, ADDRESS_MAX),
    "serial+tcp": ("serial", 0, ADDRESS_MAX),
    "modbus+tcp": ("modbus-tcp", 0, 255),  # where there is only one unit it may be 255
    "modbus+rtu": ("modbus-rtu", RTU_BAUD, ADDRESS_MAX),
    "can+socketcand": ("socketcand", 0, NODE_MAX),
    "can+slcan": ("slcan", 115_200, NODE_MAX),
}
"""By scheme: kind of wire, speed of a device [baud], highest address."""
_FORM = f"one of {', '.join(_KINDS)} with a device or HOST:PORT, as era sim prints it"
_OPTIONS = ("address", "baud", "bitrate", "parity", "stop")


@dataclass(frozen=True)
class WireEndpoint:
    """A parsed URL. kind: of wire; location: device or HOST:PORT; address: on the wire.

    baud: of a serial device, 0 for a port of the network.
    """

    url: str
    kind: str
    location: str
    address: int
    baud: int

    def url_via(self, other: str) -> str:
        """The URL with another location."""
        return self.url.replace(self.location, other, 1)


def parse_endpoint(url: str) -> WireEndpoint:
    """Parse a URL; raises InputError where no relay is possible."""
    try:
        parsed = AmplifierUrl(url, _FORM, known=_OPTIONS)
        if parsed.scheme not in _KINDS:
            raise parsed.refused("scheme must be of a wire that can be relayed")
        kind, baud, highest = _KINDS[parsed.scheme]
        place = parsed.server(has_path=True) if parsed.place else parsed.device(baud)
        text = parsed.options.get("address", parsed.number)
        if kind == "modbus-tcp":
            text = parsed.path.strip("/")
        number = parsed.whole(text, "address", highest) if text else ADDRESS
    except CommandError as problem:
        raise InputError(str(problem)) from problem
    return WireEndpoint(url, kind, place.name, number, place.baud if place.device else 0)
