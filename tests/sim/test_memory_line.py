"""A host of protocol 3 on a simulated rig in this process: what fingers feel, faults, URLs."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from drivers import clock
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.protocol.table import FAULTS, STATES
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.finger.fingertip import fingertip_points
from model.rig.file import example_rig_path
from model.rig.rig import Rig
from model.structure.fingertip import Fingertip, FingertipLoad
from plate_in_time import apart
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.faults.fault_window import FaultKind, FaultWindow
from virtual_loop import in_virtual_time
from wires import on_two_amplifiers
from words_bench import LIMITS, layer, memory_line, rig_in_memory


@in_virtual_time
async def test_finger_feels_what_the_layers_of_a_group_are_to_the_model(coarse_rig: Rig) -> None:
    """Two layers on two amplifiers that start at one moment, against the sparse direct solve.

    ERAs 0 and 2 in two layers of one amplifier, ERA 3 at another frequency on the other; 1 %.
    """
    at = (0.08, 0.06)
    async with rig_in_memory(on_two_amplifiers(coarse_rig)) as rig:
        rig.bench.place_fingers({"a": at}, now=clock.now())
        await rig.group.arm()
        await rig.group.apply(
            {
                "east": [layer((0, 110.0, 1.0)), layer((1, 110.0, 0.5), number=3)],
                "west": [layer((1, 230.0, 0.7), number=1)],
            }
        )
        start = clock.now()
        await rig.beat_until(start + 4.0)
        rig.bench.advance(start + 4.0)
        felt = rig.bench.felt(start + 3.5, start + 4.0)["a"]
    unit = direct_acceleration(
        assemble(coarse_rig.plate, coarse_rig.mesh),
        coarse_rig.eras,
        np.array([110.0, 230.0]),
        fingertip_points(*at, coarse_rig.plate),
        loads=[FingertipLoad(*at, Fingertip())],
    )
    expected = np.abs([unit[0, 0] + 0.5 * unit[0, 2], 0.7 * unit[1, 3]])
    assert felt.frequencies == (110.0, 230.0)
    assert apart(felt.amplitude, expected) < 0.01


@pytest.mark.parametrize(
    ("kind", "state", "fault"),
    [
        ("over_voltage", "FAULT", "OVER_VOLTAGE"),
        ("arc", "FAULT", "ARC"),
        ("over_current", "FAULT", "OVER_CURRENT"),
        ("channel", "FAULT", "CHANNEL"),
        ("interlock", "FAULT", "INTERLOCK"),
        ("over_temperature", "FAULT", "OVER_TEMPERATURE"),
        ("reboot", "QUICK_STOP_ACTIVE", "NONE"),  # its supply is back, the host still stops
        ("hang", "FAULT", "WATCHDOG"),
        ("nak_storm", "FAULT", "WATCHDOG"),
    ],
)
def test_fault_of_an_amplifier_ends_its_tone(
    kind: FaultKind, state: str, fault: str, coarse_rig: Rig
) -> None:
    """Half a second of it: silent meanwhile, then latched.

    The host hears of it by its next heartbeats, which stop the group.
    """

    @in_virtual_time
    async def run() -> None:
        watchdog = 0.25 if fault == "WATCHDOG" else 2.0
        async with rig_in_memory(coarse_rig, watchdog=watchdog) as rig:
            await rig.group.arm()
            await rig.group.apply({"main": [layer((0, 110.0, 1.0))]})
            await rig.beat_until(clock.now() + 0.1)
            assert rig.levels("main")[0] == 1.0
            rig.devices["main"].inject_fault(FaultWindow(kind, lasts=0.5))
            await asyncio.sleep(0.3)
            assert not any(rig.levels("main"))
            with pytest.raises((CommandRefused, LinkError)):
                await rig.group.beat()
            await asyncio.sleep(0.5)
            with pytest.raises((CommandRefused, LinkError)):  # of a mute one: when it is back
                await rig.beat_until(clock.now() + 0.3)
            assert not rig.group.is_armed
            status = await rig.group.amplifiers["main"].read_status()
            assert status["state"] == STATES[state]
            assert status["fault"] == FAULTS[fault]

    run()


@in_virtual_time
async def test_hot_amplifier_is_derated_and_stopped(coarse_rig: Rig) -> None:
    """To half its level, at first; the second status that shows it stops the group."""
    async with rig_in_memory(coarse_rig) as rig:
        await rig.group.arm()
        await rig.group.apply({"main": [layer((0, 110.0, 0.8))]})
        await rig.beat_until(clock.now() + 0.1)
        rig.devices["main"].inject_fault(FaultWindow("over_temperature", lasts=1.0))
        await asyncio.sleep(0.05)
        assert rig.levels("main")[0] == pytest.approx(0.4)
        with pytest.raises(CommandRefused, match="level of channel 0 must be 8000"):
            await rig.beat_until(clock.now() + 0.2)
        assert not any(rig.levels("main"))


@in_virtual_time
async def test_unplugged_line_is_lost_and_opens_again_once_plugged_in(coarse_rig: Rig) -> None:
    """Requests fail at once, the watchdog silences; no line while it is out, a new one after."""
    async with rig_in_memory(coarse_rig) as rig:
        device = rig.devices["main"]
        await rig.group.arm()
        await rig.group.apply({"main": [layer((0, 110.0, 1.0))]})
        device.inject_fault(FaultWindow("unplug", lasts=1.0))
        with pytest.raises(LinkError, match="unplugged"):
            await rig.group.beat()
        with pytest.raises(LinkError, match="unplugged"):
            memory_line([device], "main")
        await asyncio.sleep(1.01)
        assert not any(rig.levels("main"))
        line = memory_line([device], "main")
        host = Host(line, device.address, LIMITS, name="main")
        await host.open()
        assert (await host.read_status())["fault"] == FAULTS["WATCHDOG"]


@in_virtual_time
async def test_lost_frames_are_asked_again(coarse_rig: Rig) -> None:
    """A tenth of the frames each way is lost for two seconds: the tone lasts all the same."""
    async with rig_in_memory(coarse_rig, watchdog=1.0) as rig:
        await rig.group.arm()
        await rig.group.apply({"main": [layer((0, 110.0, 1.0))]})
        rig.devices["main"].inject_fault(FaultWindow("drop", share=0.1))
        await rig.beat_until(clock.now() + 2.0)
        assert rig.levels("main")[0] == 1.0
        assert rig.group.amplifiers["main"].statistics.retries > 0


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
    await group.apply({name: [played] for name in names})
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
