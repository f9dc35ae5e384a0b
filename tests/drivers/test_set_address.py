"""Addresses of amplifiers on a shared line, given by their serial number."""

import pytest

from drivers.amp_actions import identify, set_address
from drivers.amplifier import Amplifier
from drivers.errors import CommandError, CommandRefused, LinkError, LinkTimeout
from drivers.registry import open_backend
from drivers.urls.address import with_address
from memory_machine import live_in_memory
from model.rig.rig import Rig
from virtual_loop import in_virtual_time
from wires import SHARED_WIRES, far_side, on_two_amplifiers, patient

NEW = 9


@pytest.mark.parametrize("wire", SHARED_WIRES)
@in_virtual_time
async def test_amplifier_takes_another_address(wire: str, coarse_rig: Rig) -> None:
    """It replies there, nobody where it was, and the other amplifier where it is."""
    live_in_memory()
    async with far_side(SHARED_WIRES[wire], on_two_amplifiers(coarse_rig)) as far:
        east, west = (patient(far.urls[name]) for name in ("east", "west"))
        moved = await set_address(east, NEW, None)
        assert moved["serial_number"] == "SIM-east"
        assert (await identify(moved["url"]))["serial_number"] == "SIM-east"
        assert (await identify(west))["serial_number"] == "SIM-west"
        with pytest.raises(LinkTimeout):
            await identify(far.urls["east"])


@pytest.mark.parametrize("wire", ["serial", "modbus+tcp", "modbus+rtu"])
@in_virtual_time
async def test_two_of_one_address_are_told_apart(wire: str, coarse_rig: Rig) -> None:
    """One of the serial number moves, whatever the other replies."""
    live_in_memory()
    async with far_side(SHARED_WIRES[wire], on_two_amplifiers(coarse_rig)) as far:
        east, west = far.urls["east"], far.urls["west"]
        moved = await set_address(east, NEW, "SIM-east")
        assert moved["url"] != east
        back = await set_address(west, NEW + 1, "SIM-west")
        assert (await identify(back["url"]))["serial_number"] == "SIM-west"
        assert (await identify(moved["url"]))["serial_number"] == "SIM-east"
        with pytest.raises(LinkError):
            await set_address(back["url"], 20, "SIM-nobody")


@in_virtual_time
async def test_two_at_one_serial_address_are_refused_until_one_moves(coarse_rig: Rig) -> None:
    """As they come from the factory."""
    live_in_memory()
    async with far_side(SHARED_WIRES["serial"], on_two_amplifiers(coarse_rig)) as far:
        east, west = far.urls["east"], far.urls["west"]
        amplifier = Amplifier(open_backend(east))
        await amplifier.connect()
        await amplifier.set_address(2, "SIM-east")  # where the other one is
        await amplifier.close()
        with pytest.raises(LinkError, match="several amplifiers"):
            await identify(west)
        moved = await set_address(west, NEW, "SIM-east")
        assert (await identify(moved["url"]))["serial_number"] == "SIM-east"
        assert (await identify(west))["serial_number"] == "SIM-west"


@pytest.mark.parametrize(
    ("url", "moved"),
    [
        ("serial:///dev/x", "serial:///dev/x?address=9"),
        ("serial:///dev/x?address=3&baud=9600", "serial:///dev/x?baud=9600&address=9"),
        ("modbus+tcp://h:502", "modbus+tcp://h:502/9"),
        ("modbus+tcp://h/1?baud=9600", "modbus+tcp://h/9?baud=9600"),
        ("modbus+rtu:///dev/x?baud=9600#1", "modbus+rtu:///dev/x?baud=9600#9"),
        ("can+slcan:///dev/x#1", "can+slcan:///dev/x#9"),
    ],
)
def test_url_of_another_address(url: str, moved: str) -> None:
    """The rest of it stays."""
    assert with_address(url, NEW) == moved


async def test_armed_amplifier_keeps_its_address(coarse_rig: Rig) -> None:
    """So does one on a wire without addresses."""
    async with far_side(SHARED_WIRES["serial"], coarse_rig) as far:
        amplifier = Amplifier(open_backend(far.url))
        await amplifier.open()
        await amplifier.arm(2.0)
        await amplifier.close()
        with pytest.raises(CommandRefused, match="disarm"):
            await set_address(far.url, NEW, None)
    with pytest.raises(CommandError, match="address"):
        await set_address("sim://rig.yaml", NEW, None)
