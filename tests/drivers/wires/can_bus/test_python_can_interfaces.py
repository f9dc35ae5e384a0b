"""Every interface of python-can, by its name in the URL of an amplifier."""

from typing import Any

import can
import pytest
from can.interfaces import BACKENDS

from drivers.errors import CommandError, LinkError
from drivers.wires.can_bus import PythonCanAddress
from drivers.wires.known import address_of

OWN = ("slcan", "socketcan", "socketcand")
CHANNELS = {
    "etas": "ETAS://ETH/ES910:abcd/CAN:1",
    "nixnet": "CAN1",
    "pcan": "PCAN_USBBUS1",
    **dict.fromkeys(("robotell", "seeedstudio", "serial"), "/dev/no-such-port"),
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
INTERFACES = sorted(set(BACKENDS) - set(OWN))


def address(interface: str, query: str = "") -> PythonCanAddress:
    """Node 3 on a channel as the interface names it."""
    found = address_of(f"can+python-can://{interface}/{CHANNELS.get(interface, '0')}{query}#3")
    assert isinstance(found, PythonCanAddress)
    return found


@pytest.mark.parametrize("interface", INTERFACES)
async def test_interface_is_opened_by_its_name(
    interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its channel, a number as one, the bit rate and the options that tell adapters apart."""
    opened: dict[str, Any] = {}

    def open_bus(**how: object) -> None:
        opened.update(how)
        raise OSError("no adapter")

    monkeypatch.setattr(can, "Bus", open_bus)
    options = OPTIONS.get(interface, {})
    more = "".join(f"&{name}={value}" for name, value in options.items())
    found = address(interface, f"?bitrate=250000{more}")
    with pytest.raises(LinkError, match="no adapter"):
        await found.open_port(lambda data: None, lambda cause: None)
    assert found.number == 3
    assert (opened["interface"], opened["channel"]) == (interface, CHANNELS.get(interface, 0))
    assert (opened["bitrate"], opened["receive_own_messages"]) == (250_000, False)
    assert options.items() <= opened.items()


@pytest.mark.parametrize("interface", sorted(set(INTERFACES) - {"virtual", "udp_multicast"}))
async def test_missing_adapter_is_a_link_error(interface: str) -> None:
    """Whatever the driver of a vendor raises where it is missing."""
    with pytest.raises(LinkError, match="cannot be opened"):
        await address(interface).open_port(lambda data: None, lambda cause: None)


def test_frames_are_those_of_classic_can() -> None:
    """Version 3 has no CAN FD, and a node from 1 to 127."""
    for query in ("?fd=2000000#1", "#128", "?bitrate=3#1"):
        with pytest.raises(CommandError):
            address_of(f"can+socketcan://can0{query}")
