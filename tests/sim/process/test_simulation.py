"""A whole simulation in this process: wires, control, faults, recording, view."""

import asyncio
import io
import json
import os
import signal
from collections.abc import Mapping
from pathlib import Path

import pytest
from rich.console import Console

from drivers.errors import CommandRefused
from drivers.host.group import Group
from drivers.opening import Lines
from model.rig.file import load_rig
from recordings import read_recording
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.control.context import SimulationContext
from sim.far_ends.wires import Wire
from sim.plant.accelerometer import Accelerometer
from sim.process.simulation import Simulation, run_simulation
from sim.process.view import PlateView, draw
from words_bench import LIMITS, layer


async def test_simulation_serves_amplifiers_on_two_wires(tmp_path: Path) -> None:
    """One on a pseudo-terminal, one on TCP: both play on one plate, a fault stops them."""
    rig = load_rig(write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS))
    simulation = Simulation(
        rig,
        {"main": Wire("serial"), "side": Wire("modbus-tcp", address=7)},
        fingers={"1": (0.1, 0.1)},
        sensors=[Accelerometer("P1", 0.1, 0.1)],
        control=tmp_path / "control",
        record=tmp_path / "run.csv",
    )
    ready: asyncio.Future[Mapping[str, str]] = asyncio.get_running_loop().create_future()
    contexts: list[SimulationContext] = []
    running = asyncio.create_task(
        run_simulation(simulation, ready=ready.set_result, view=contexts.append)
    )
    urls, lines = await ready, Lines()
    amplifiers = {name: await lines.amplifier(urls[name], LIMITS, name=name) for name in urls}
    group = Group(amplifiers, watchdog=2.0)
    await group.open()
    await group.arm()
    await group.apply({name: [layer((1, 150.0, 0.5), ramp=0.0)] for name in urls})
    await asyncio.sleep(0.3)
    reader, writer = await asyncio.open_unix_connection(tmp_path / "control")

    async def ask(op: str, **values: object) -> dict[str, object]:
        writer.write(json.dumps({"op": op, **values}).encode() + b"\n")
        reply: dict[str, object] = json.loads(await reader.readline())
        return reply

    state = (await ask("state"))["amplifiers"]
    assert isinstance(state, dict)
    for name in urls:
        assert state[name]["state"] == "OPERATION_ENABLED"
        assert state[name]["levels"][1] == 0.5
    await group.beat()
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(draw(contexts[0], PlateView(contexts[0].bench)))
    assert console.export_text().count("OPERATION_ENABLED") == 2
    assert (await ask("inject_fault", fault="arc", amplifier="side"))["ok"]
    with pytest.raises(CommandRefused):
        await group.beat()
    state = (await ask("state"))["amplifiers"]
    assert isinstance(state, dict)
    assert [state[name]["fault"] for name in ("main", "side")] == ["NONE", "ARC"]
    assert [state[name]["levels"] for name in ("main", "side")] == [[0.0] * 2] * 2
    writer.close()
    await writer.wait_closed()
    await lines.close()
    os.kill(os.getpid(), signal.SIGTERM)
    assert str(tmp_path / "run.csv") in str(await running)
    recording = read_recording(tmp_path / "run.csv")
    assert recording.names == ("P1", "finger_1")
    assert abs(recording.samples).max() > 1.0  # m/s²
