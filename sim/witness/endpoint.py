"""The wire endpoint of an amplifier's URL, for a relay in front of it."""

from dataclasses import dataclass

from drivers.urls.can_bus import CanUrl
from drivers.urls.modbus import ModbusUrl
from drivers.urls.serial_line import SerialUrl

from drivers.errors import CommandError
from model.errors import InputError

_FORMS = "serial://, modbus+tcp://, modbus+rtu://, can+socketcand:// or can+slcan://"


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
    try:
        endpoint = _endpoint(url)
    except CommandError as problem:
        raise InputError(str(problem)) from problem
    if endpoint is None or endpoint.location not in url:
        raise InputError(
            f"{url}: must be {_FORMS} with a device, or with HOST:PORT; write it as era sim prints "
            "it"
        )
    return endpoint


def _endpoint(url: str) -> WireEndpoint | None:
    scheme = url.partition("://")[0]
    if scheme == "serial":
        serial = SerialUrl.parse(url)
        return WireEndpoint(url, "serial", serial.port, serial.address, serial.baud)
    if scheme in ("modbus+tcp", "modbus+rtu"):
        modbus = ModbusUrl.parse(url)
        kind = scheme.replace("+", "-")
        return WireEndpoint(url, kind, modbus.endpoint, modbus.unit, modbus.baud)
    if scheme in ("can+socketcand", "can+slcan"):
        can = CanUrl.parse(url)
        place = f"{can.bus.host}:{can.bus.port}" if can.bus.host else can.bus.channel
        return WireEndpoint(url, scheme.removeprefix("can+"), place, can.node, can.bus.baud)
    return None
