"""Every interface of python-can, by its name in the URL of a backend."""

import ast
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces import BACKENDS

from drivers.backends.can_bus.adapter import open_adapter
from drivers.backends.can_bus.interfaces import open_bus
from drivers.errors import LinkError
from drivers.urls.can_bus import CanUrl

OWN = ("slcan", "socketcan", "socketcand")
CHANNELS = {
    "etas": "ETAS://ETH/ES910:abcd/CAN:1",
    "nixnet": "CAN1",
    "pcan": "PCAN_USBBUS1",
    "robotell": "/dev/no-such-port",
    "seeedstudio": "/dev/no-such-port",
    "serial": "/dev/no-such-port",
    "slcan": "/dev/no-such-port",
    "socketcan": "nosuchcan0",
    "socketcand": "127.0.0.1:1/can0",
    "udp_multicast": "239.74.163.2",
    "usb2can": "ED000200",
}
OPTIONS = {
    "canalystii": {"device": 1},
    "ixxat": {"unique_hardware_id": "HW107711"},
    "neousys": {"device": 1},
    "neovi": {"serial": 4711},
    "pcan": {"device_id": 5},
    "systec": {"device_number": 2},
    "udp_multicast": {"port": 43114},
    "vector": {"app_name": "plate", "serial": 4711},
}


def url_of(interface: str, query: str = "") -> CanUrl:
    """The URL of node 3 on a channel as the interface names it."""
    scheme = interface if interface in OWN else f"python-can://{interface}"
    joint = "://" if interface in OWN else "/"
    return CanUrl.parse(f"can+{scheme}{joint}{CHANNELS.get(interface, '0')}{query}#3")


@pytest.mark.parametrize("interface", sorted(set(BACKENDS) - set(OWN)))
@pytest.mark.parametrize("fd", [0, 2_000_000])
def test_interface_is_opened_by_its_name(
    interface: str, fd: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its channel, a number as one, the bit rates and the options that tell adapters apart."""
    opened: dict[str, Any] = {}
    monkeypatch.setattr(can, "Bus", lambda **how: opened.update(how))
    options = OPTIONS.get(interface, {})
    asked = "".join(f"&{name}={value}" for name, value in options.items())
    asked += f"&fd={fd}" if fd else ""
    url = url_of(interface, f"?bitrate=250000{asked}")
    open_bus(url.bus)
    assert url.node == 3
    assert opened["interface"] == interface
    channel = CHANNELS.get(interface, 0)
    assert opened["channel"] == channel
    assert opened["bitrate"] == 250_000
    assert not opened["receive_own_messages"]
    assert options.items() <= opened.items()
    if interface == "pcan" and fd:
        timing = opened["timing"]
        assert (timing.nom_bitrate, timing.data_bitrate) == (250_000, fd)
    elif fd:
        assert opened["fd"]
        assert opened["fd_bitrate" if interface == "nixnet" else "data_bitrate"] == fd


@pytest.mark.parametrize("interface", OPTIONS)
def test_interface_knows_its_options(interface: str) -> None:
    """python-can reads each, as a parameter or by its name."""
    spec = find_spec(BACKENDS[interface][0])
    assert spec is not None
    assert spec.origin is not None
    package = spec.submodule_search_locations
    files = [*Path(package[0]).glob("*.py")] if package else [Path(spec.origin)]
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    known = {node.arg for node in nodes if isinstance(node, ast.arg)}
    known |= {node.value for node in nodes if isinstance(node, ast.Constant)}
    assert OPTIONS[interface].keys() <= known


@pytest.mark.parametrize("interface", sorted(set(BACKENDS) - {"virtual", "udp_multicast"}))
async def test_missing_adapter_is_a_link_error(interface: str) -> None:
    """Whatever the driver of a vendor raises where it is missing."""
    url = url_of(interface).bus
    with pytest.raises(LinkError, match="cannot be opened"):
        await open_adapter(url, on_frame=lambda frame: None, on_loss=lambda cause: None)
