"""CAN through python-can: can+socketcan://can0#NODE, can+python-can://INTERFACE/CHANNEL#NODE."""

from collections.abc import Callable
from typing import Any

from drivers.hardware import Port
from drivers.urls import AmplifierUrl
from drivers.wires.can_address import CanAddress

_FORM = "can+socketcan://can0#NODE or can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE"
_OTHERS = ("slcan", "socketcan", "socketcand")
"""Interfaces with a URL scheme of their own."""
_OPTIONS = {  # of python-can, passed on as they are: which of several adapters it is
    "canalystii": ("device",),
    "ixxat": ("unique_hardware_id",),
    "neousys": ("device",),
    "neovi": ("serial",),
    "pcan": ("device_id",),
    "systec": ("device_number",),
    "udp_multicast": ("port",),
    "vector": ("app_name", "serial"),
}


class PythonCanAddress(CanAddress):
    """A node on a bus of one of python-can's interfaces.

    bus: arguments of `can.Bus`.
    """

    def __init__(self, url: str) -> None:
        interface = url.partition("://")[2].partition("/")[0]
        options = _OPTIONS.get(interface, ())
        parsed = AmplifierUrl(url, _FORM, known=("bitrate", *options))
        if parsed.scheme == "can+socketcan":
            interface, channel, rest = "socketcan", parsed.place, parsed.path.strip("/")
        else:
            channel, rest = parsed.path.removeprefix("/"), ""
            if not interface or interface in _OTHERS:
                raise parsed.refused("interface must be named")
        if rest or not channel.strip("/"):
            raise parsed.refused("bus must be named")
        chosen = {
            name: _number_or_text(parsed.options[name])
            for name in options
            if name in parsed.options
        }
        where = "/".join(part for part in (parsed.place, parsed.path.strip("/")) if part)
        super().__init__(parsed, f"{parsed.scheme}://{where}", settings=chosen)
        self.bus: dict[str, Any] = {
            "interface": interface,
            "channel": _number_or_text(channel),
            "bitrate": self.bitrate,  # not of SocketCAN: ip link set can0 type can bitrate 500000
            "receive_own_messages": False,
            **chosen,
        }

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the bus; raises LinkError."""
        from drivers.wires.bus_port import open_bus  # python-can takes a tenth of a second

        return await open_bus(self.line, self.bus, on_data, on_loss)


def _number_or_text(text: str) -> int | str:
    return int(text) if text.isdecimal() else text
