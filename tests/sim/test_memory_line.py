"""A host of protocol 4 on a simulated rig in this process: what fingers feel, faults, URLs."""

import asyncio
import json
from pathlib import Path

import pytest

from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.opening import Lines
from drivers.protocol.definition import FAULTS
from drivers.wires.serial_line import SerialWire
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from plates import TWO_AMPLIFIERS, write_rig
from real_wires import LIMITS, layer, make_bench
from registry import threads
from sim.bench.amplifier_device import AmplifierDevice
from sim.faults import FaultWindow
from sim.memory_line import MemoryPort
from virtual_lines import in_virtual_time


def line_to(device: AmplifierDevice) -> Line:
    """The host's line to a device of this process."""
    line = Line(SerialWire(0, sequence=0), "main")
    line.open(MemoryPort([device], line.received, line.lose))
    return line


@in_virtual_time
async def test_unplugged_line_is_lost_and_opens_again_once_plugged_in(coarse_rig: Rig) -> None:
    """Requests fail at once, the watchdog silences; no line while it is out, a new one after."""
    bench, devices = make_bench(coarse_rig)
    device = devices["main"]
    group = await opened_group(line_to(device))
    await group.arm()
    await group.apply({"main": [layer((0, 110.0, 1.0))]})
    device.inject_fault(FaultWindow(fault="unplug", lasts=1.0))
    with pytest.raises(LinkError, match="unplugged"):
        await group.beat()
    with pytest.raises(LinkError, match="unplugged"):
        line_to(device)
    await asyncio.sleep(1.01)
    bench.advance(threads.now())
    assert not any(bench.amplifiers["main"].summary(bench.time).levels)
    again = await opened_group(line_to(device))
    assert (await again.amplifiers["main"].read_status())["fault"] == FAULTS["WATCHDOG"]


async def opened_group(line: Line) -> Group:
    """The group of the only amplifier of a line, open."""
    group = Group({"main": Host(line, 1, LIMITS, name="main")})
    await group.open()
    return group


ROUND_TRIPS = {"&line=prompt": (0.0, 0.0), "": (28e-6, 1e-3), "&line=ftdi": (10e-3, 12e-3)}
"""Medians of an exchange without bits, 5 ms after the one before [s].

Two frames of 125 us at most and the operating system; 16 ms after an FTDI chip's last packet.
"""


@pytest.mark.parametrize("option", ROUND_TRIPS)
@in_virtual_time
async def test_line_is_that_of_its_url_and_of_usb_where_a_rig_has_several(
    option: str, tmp_path: Path
) -> None:
    """By default as a USB adapter of high speed delays, and not at all as `prompt`."""
    rig = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS)
    lines = Lines()
    main = await lines.amplifier(f"sim://{rig}?amplifier=main{option}", LIMITS, name="main")
    await main.open()
    taken = []
    for _ in range(51):
        await asyncio.sleep(0.005)
        await main.read_status()
        taken.append(main.counts.last_round_trip)
    await lines.close()
    shortest, longest = ROUND_TRIPS[option]
    assert shortest <= sorted(taken)[25] <= longest


@pytest.mark.parametrize("option", ["line=usb", "line="])
async def test_url_of_an_unknown_line_is_refused(option: str) -> None:
    """As any other option that is invalid."""
    with pytest.raises(CommandError, match="line must be one of"):
        await Lines().amplifier(f"sim://rig.yaml?amplifier=a&{option}", LIMITS, name="a")


async def test_amplifiers_of_one_rig_share_its_simulation(tmp_path: Path) -> None:
    """By URLs with names: the control socket sees both play, and ends with them."""
    rig, control = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS), tmp_path / "control"
    lines = Lines()
    names = ("main", "side")
    group = Group(
        {
            name: await lines.amplifier(
                f"sim://{rig}?control={control}&amplifier={name}", LIMITS, name=name
            )
            for name in names
        },
        watchdog=2.0,
    )
    await group.open()
    await group.arm()
    played = layer((0, 110.0, 0.5), ramp=0.0)
    applied = await group.apply({name: [played] for name in names})
    await asyncio.sleep(applied.starts_at + 0.005 - threads.now())  # by clocks that are just armed
    reader, writer = await asyncio.open_unix_connection(control)
    writer.write(b'{"op": "state"}\n{"op": "inject_fault", "fault": "arc", "amplifier": "side"}\n')
    state = json.loads(await reader.readline())["amplifiers"]
    assert [state[name]["levels"] for name in names] == [[0.5, 0.0]] * 2
    assert [state[name]["state"] for name in names] == ["OPERATION_ENABLED"] * 2
    assert json.loads(await reader.readline())["ok"]
    with pytest.raises(CommandRefused):
        await group.beat()
    writer.close()
    await writer.wait_closed()
    await lines.close()
    assert not control.exists()
    assert not [task for task in asyncio.all_tasks() if "simulated plate" in task.get_name()]


@pytest.mark.parametrize(
    "url",
    [
        *("sim://", "sim://?control=x", "sim:///no/such/rig.yaml"),
        *(f"sim://{example_rig_path()}?{rest}" for rest in ("speed=2", "amplifier=aux", "seed=x")),
    ],
)
async def test_invalid_url_is_refused(url: str) -> None:
    """No rig, an unknown option or amplifier, a seed that is no number."""
    with pytest.raises(CommandError, match="sim://"):
        await Lines().amplifier(url, LIMITS, name="a")
