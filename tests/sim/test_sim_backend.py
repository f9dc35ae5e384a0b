"""The in-process amplifier behind the backend interface."""

import asyncio
import json
import os
import tempfile
from pathlib import Path

import pytest

from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, LinkError
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import Achieved, Apply, Arm, Capabilities, GetCaps, Stage, Status
from model.rig.file import example_rig_path
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.backend import SimulatedBackend

URL = f"sim://{example_rig_path()}"
SET = CommandSet(1, (DriveCommand(0, 110.004, 0.5),), ramp=0.0, valid_for=0.0)


async def test_sim_backend_plays_a_checked_set() -> None:
    """Armed, a safe set is achieved as quantised, and felt by a finger through the control."""
    with tempfile.TemporaryDirectory() as folder:
        backend = SimulatedBackend(f"{URL}?control={folder}/control&amplifier=main")
        await backend.open()
        try:
            capabilities = await backend.exchange(GetCaps(), timeout=1)
            assert isinstance(capabilities, Capabilities)
            assert capabilities.channels == 4
            assert isinstance(await backend.exchange(Arm(1.0), timeout=1), Status)
            safe = Guard(GuardLimits(40, 500, 1), capabilities).check(SET)
            achieved = await backend.exchange(Apply(safe), timeout=1)
            assert achieved == Achieved(1, (DriveCommand(0, 110.0, 0.5),))
            reader, writer = await asyncio.open_unix_connection(f"{folder}/control")
            writer.write(b'{"op": "state"}\n')
            state = json.loads(await reader.readline())
            assert state["amplifiers"]["main"]["levels"] == [0.5, 0, 0, 0]
            assert state["time_s"] >= backend.last_sent_at
            writer.close()
            await writer.wait_closed()
        finally:
            await backend.close()
        assert os.listdir(folder) == []  # noqa: PTH208 - a string is what there is


async def test_sim_backends_of_one_control_are_under_one_plate(tmp_path: Path) -> None:
    """The control sees both play; the plate lasts until the last one closes, and none is left."""
    rig = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS)
    control = tmp_path / "control"
    backends = [
        SimulatedBackend(f"sim://{rig}?control={control}&amplifier={name}")
        for name in ("main", "side")
    ]
    await asyncio.gather(*(backend.open() for backend in backends))
    for backend in backends:
        capabilities = await backend.exchange(GetCaps(), timeout=1)
        assert isinstance(capabilities, Capabilities)
        await backend.exchange(Arm(1.0), timeout=1)
        safe = Guard(GuardLimits(40, 500, 1), capabilities).check(SET)
        await backend.exchange(Apply(safe), timeout=1)
    for playing in (["main", "side"], ["side"]):
        reader, writer = await asyncio.open_unix_connection(control)
        writer.write(b'{"op": "state"}\n')
        amplifiers = json.loads(await reader.readline())["amplifiers"]
        assert [amplifiers[name]["levels"] for name in playing] == [[0.5, 0]] * len(playing)
        writer.close()
        await writer.wait_closed()
        await backends.pop(0).close()
    assert not control.exists()
    assert not [task for task in asyncio.all_tasks() if "simulated plate" in task.get_name()]


async def test_sim_backends_of_named_amplifiers_are_under_one_plate(tmp_path: Path) -> None:
    """Without a control socket, too; closed, all can be opened again."""
    rig = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS)
    backends = [SimulatedBackend(f"sim://{rig}?amplifier={name}") for name in ("main", "side")]
    for _ in range(2):
        await asyncio.gather(*(backend.open() for backend in backends))
        assert backends[0]._bench is backends[1]._bench is not None
        await asyncio.gather(*(backend.close() for backend in backends))
    assert not [task for task in asyncio.all_tasks() if "simulated plate" in task.get_name()]


async def test_sim_backend_advances_the_plate_while_open() -> None:
    """Simulated time follows the clock without being asked, and the backend closes twice."""
    backend = SimulatedBackend(URL)
    await backend.open()
    try:
        await backend.exchange(Arm(0.1), timeout=1)
        task = next(t for t in asyncio.all_tasks() if "simulated plate" in t.get_name())
        assert not task.done()
    finally:
        await backend.close()
        await backend.close()
    assert task.done()


async def test_sim_backend_refuses_unchecked_sets() -> None:
    """A plain CommandSet is a mistake of the program, not of the user."""
    backend = SimulatedBackend(URL)
    for request in (Apply(SET), Stage(SET)):
        with pytest.raises(TypeError, match="SafeCommandSet"):
            await backend.exchange(request, timeout=1)


async def test_sim_backend_closed_raises_link_error() -> None:
    """Before open and after close."""
    backend = SimulatedBackend(URL)
    with pytest.raises(LinkError, match="not open"):
        await backend.exchange(GetCaps(), timeout=1)


@pytest.mark.parametrize("url", ["sim://", "sim://?control=x", "sim://rig.yaml?speed=2"])
def test_sim_backend_refuses_an_invalid_url(url: str) -> None:
    """No rig, or an unknown option: the error says what a good URL looks like."""
    with pytest.raises(CommandError, match=r"sim://RIG\.yaml"):
        SimulatedBackend(url)


@pytest.mark.parametrize("rest", ["/no/such/rig.yaml", f"{example_rig_path()}?amplifier=aux"])
async def test_sim_backend_refuses_an_invalid_rig(rest: str) -> None:
    """A missing file and an amplifier that the rig has not are named with the URL."""
    backend = SimulatedBackend(f"sim://{rest}")
    with pytest.raises(CommandError, match="sim://"):
        await backend.open()
