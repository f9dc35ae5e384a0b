"""CAN amplifier URLs, such as can+socketcan://can0#NODE, with the node after the hash sign.

Interfaces of python-can other than these three are can+python-can://INTERFACE/CHANNEL#NODE.
"""

from dataclasses import dataclass
from typing import Final
from urllib.parse import unquote

from drivers.codec.can_bus.canopen import BITRATE
from drivers.codec.can_bus.segments import NODE_MAX
from drivers.errors import CommandError
from drivers.urls.options import device_of, options_of, split_url, whole_number

NODE: Final = 1
"""Of an amplifier as it is made."""

_FORMS = (
    "can+socketcan://can0#1, can+slcan:///dev/ttyACM0?bitrate=500000#1, "
    "can+slcan://HOST:PORT#1, can+socketcand://HOST:PORT/can0#1 or "
    "can+python-can://INTERFACE/CHANNEL#1"
)
_OPTIONS = {  # lowest and highest
    "bitrate": (10_000, 1_000_000),
    "baud": (9_600, 12_000_000),  # of the serial port of an slcan adapter
}
_ADAPTER_OPTIONS = {  # of python-can, passed on as they are: which of several adapters it is
    "canalystii": ("device",),
    "ixxat": ("unique_hardware_id",),
    "neousys": ("device",),
    "neovi": ("serial",),
    "pcan": ("device_id",),
    "systec": ("device_number",),
    "udp_multicast": ("port",),
    "vector": ("app_name", "serial"),
}


_OWN_SCHEMES = ("slcan", "socketcan", "socketcand")
"""Interfaces with a URL scheme of their own."""


@dataclass(frozen=True)
class CanBusUrl:
    """A bus: interface as named by python-can, channel, host and port of a server or an adapter.

    bitrate [bit/s]; baud of the adapter's serial port; options: of python-can, by name.
    """

    interface: str
    channel: str
    host: str
    port: int
    bitrate: int
    baud: int
    options: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        where = f"{self.host}:{self.port}" if self.host else ""
        scheme = self.interface
        if scheme not in _OWN_SCHEMES:
            scheme, where = "python-can", self.interface
        return f"can+{scheme}://{'/'.join(part for part in (where, self.channel) if part)}"


@dataclass(frozen=True)
class CanUrl:
    """A CAN amplifier: its bus and node."""

    bus: CanBusUrl
    node: int

    @classmethod
    def parse(cls, url: str) -> "CanUrl":
        """Parse a URL; CommandError names the invalid part."""
        scheme, _, rest = url.partition("://")
        interface = scheme.lower().removeprefix("can+")
        # An slcan adapter is a device, or behind a port of the network.
        is_server = interface == "socketcand" or (interface == "slcan" and rest[:1] not in "/")
        # The names of some interfaces are no schemes for urlsplit.
        parts = split_url(f"can://{rest}", kind="a CAN", forms=_FORMS, has_port=is_server)
        if interface == "python-can":
            interface = parts.netloc
            if not interface or interface in _OWN_SCHEMES:
                raise CommandError(f"{url!r} must name an interface; use {_FORMS}")
        adapter_options = _ADAPTER_OPTIONS.get(interface, ())
        known = (*_OPTIONS, *adapter_options)
        options = options_of(parts.query, known=known, url=url, kind="a CAN")
        host, port = "", None
        match interface:
            case "socketcan":
                channel, rest = parts.netloc, parts.path.strip("/")
            case "slcan" if not is_server:
                channel, rest = device_of(unquote(parts.path)), parts.netloc
            case "slcan" | "socketcand":
                port = parts.port
                channel, rest = parts.path.strip("/"), "" if port else "no port"
                host = parts.hostname or ""
            case _:
                channel, rest = unquote(parts.path[1:]), ""
        is_named = not channel if is_server and interface == "slcan" else channel.strip("/")
        if not is_named or rest or (is_server and not host):
            raise CommandError(f"{url!r} must name the bus; use {_FORMS}")
        bus = CanBusUrl(
            interface=interface,
            channel=channel,
            host=host,
            port=port or 0,
            bitrate=_whole(options, "bitrate", default=BITRATE, url=url),
            baud=_whole(options, "baud", default=115_200, url=url),
            options=tuple((name, options[name]) for name in adapter_options if name in options),
        )
        return cls(bus=bus, node=_node(parts.fragment, url))


def _node(text: str, url: str) -> int:
    if not text:
        return NODE
    return whole_number(text, "the node after #", high=NODE_MAX, url=url)


def _whole(options: dict[str, str], name: str, *, default: int, url: str) -> int:
    text = options.get(name)
    if text is None:
        return default
    low, high = _OPTIONS[name]
    return whole_number(text, name, low=low, high=high, url=url)
