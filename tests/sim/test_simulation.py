"""A simulation as a process: command, run loop, control socket."""

import asyncio
import contextlib
import json
import signal
import socket
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cases import shortly
from drivers.errors import LinkError
from drivers.playing import AmplifierTone
from drivers.protocol.definition import QUANTITIES, STATES
from kit.plates import write_rig
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from processes.daemons import SESSION as DAEMONS_SESSION
from processes.daemons import FarEndProcess, far_end_process, playing
from registry.limits import GuardLimits
from sim.bench.bench import Bench
from sim.control import LINE_MAX, SimulationContext, control_socket, execute

LIMITS = GuardLimits(40.0, 500.0, 1.0)
TIMEOUT = 120  # s; for a loaded machine, not an expectation


@pytest.mark.parametrize("is_interrupted", shortly([True, False], [True]))
async def test_sim_serves_until_interrupted_or_eof(is_interrupted: bool) -> None:
    """It prints a URL, serves the amplifier, and exits with status 0 and no files left."""
    with tempfile.TemporaryDirectory() as folder:
        control, link = Path(folder) / "control", Path(folder) / "amp"
        options = ["--serial", "--link", str(link), "--control", str(control), "--until-eof"]
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "sim", str(example_rig_path()), *options),
            **dict.fromkeys(("stdin", "stdout", "stderr"), asyncio.subprocess.PIPE),
            cwd=example_rig_path().parent.parent,
        )
        try:
            line = (await asyncio.wait_for(process.stdout.readline(), TIMEOUT)).decode()
            assert line == f"main: serial://{link}?baud=921600\n"
            assert link.readlink().is_char_device()
            assert control.is_socket()
            tone = AmplifierTone(2, 110.0, 0.25)
            async with playing(line.split()[1], tone, watchdog=2.0) as amplifier:
                status = await amplifier.read_status()
            assert (status["state"], status["token"]) == (STATES["OPERATION_ENABLED"], 1)
            assert status["levels"] == [0, 0, QUANTITIES["level"].to_wire(0.25), 0]
        finally:
            if is_interrupted:
                process.send_signal(signal.SIGINT)
            else:
                process.stdin.close()
            out, err = await asyncio.wait_for(process.communicate(), TIMEOUT)
        assert (process.returncode, out, err) == (0, b"", b"")
        assert not control.exists()
        assert not link.is_symlink()


async def test_simulation_in_virtual_time_advances_only_by_steps(tmp_path: Path) -> None:
    """The watchdog of 0.5 s and faults follow the steps of the control socket."""
    rig = write_rig(tmp_path / "rig.yaml")
    tone = AmplifierTone(0, 110.0, 0.5)
    async with far_end_process(rig, "--serial", "--virtual-time", "--finger", "0.1,0.1") as far_end:
        greeting = await far_end.ask("hello")
        assert greeting["protocol"] == "era-sim-control"
        assert greeting["version"] == 3
        assert greeting["clock"] == "virtual"
        assert greeting["urls"] == far_end.urls
        assert (await far_end.ask("state"))["time_s"] == 0
        async with playing(far_end.urls["main"], tone, watchdog=0.5) as amplifier:
            assert await far_end.ask("step", seconds=0.4) == {"ok": True, "time_s": 0.4}
            assert (await amplifier_state(far_end))["levels"][0] == 0.5
            assert await far_end.ask("step", seconds=0.09) == {"ok": True, "time_s": 0.49}
            assert (await amplifier_state(far_end))["fault"] == "NONE"
            await far_end.ask("step", seconds=0.51)
            assert (await amplifier_state(far_end))["fault"] == "WATCHDOG"

            await amplifier.read_status()
            await amplifier.clear()
            await amplifier.arm(DAEMONS_SESSION + 1, 0.5)
            await far_end.ask("inject_fault", fault="arc", amplifier="main")
            assert (await amplifier_state(far_end))["fault"] == "ARC"
            fault = {"fault": "arc", "begin_s": 1.0, "end_s": None, "is_on": True}
            assert (await far_end.ask("faults"))["faults"] == {"main": [fault]}
            await far_end.ask("recover")
            assert (await far_end.ask("faults"))["faults"] == {"main": []}
        assert (await far_end.end())[0] == 0


async def amplifier_state(far_end: FarEndProcess) -> dict[str, Any]:
    """Return the state of the amplifier main."""
    state = await far_end.ask("state")
    return dict(state["amplifiers"]["main"])


async def test_simulation_moves_fingers_and_rejects_invalid_operations(tmp_path: Path) -> None:
    """Errors name the finger, the amplifier or the value."""
    rig = write_rig(tmp_path / "rig.yaml")
    async with far_end_process(rig, "--serial", "--virtual-time", "--finger", "0.1,0.1") as far_end:
        await far_end.ask("move", finger="1", at_m=[0.05, 0.05])
        await far_end.ask("touch", finger="2", at_m=[0.2, 0.2])
        assert "2" in (await far_end.ask("touch", finger="2", at_m=[0.2, 0.2]))["error"]
        assert (await far_end.ask("state"))["fingers"] == {"1": [0.05, 0.05], "2": [0.2, 0.2]}
        await far_end.ask("lift", finger="1")
        assert "1" in (await far_end.ask("move", finger="1"))["error"]
        assert (await far_end.ask("state"))["fingers"] == {"2": [0.2, 0.2]}

        unknown = await far_end.ask("inject_fault", fault="arc", amplifier="x")
        assert "amplifier" in unknown["error"]
        impossible = await far_end.ask("inject_fault", fault="drop", share=2)
        assert "share" in impossible["error"]
        backward = await far_end.ask("step", seconds=-1)
        assert "seconds" in backward["error"]
        assert (await far_end.end())[0] == 0


@pytest.mark.long
async def test_simulation_applies_a_fault_within_a_step_at_its_time(tmp_path: Path) -> None:
    """Half a second into a step of 0.8 s the fault silences the amplifier, not before."""
    async with (
        far_end_process(
            write_rig(tmp_path / "rig.yaml"), "--serial", "--virtual-time", "--finger", "0.01,0.01"
        ) as far_end,
        playing(far_end.urls["main"], AmplifierTone(0, 110.0, 0.5), watchdog=2.0),
    ):
        await far_end.ask("inject_fault", fault="over_temperature", lasts=1.0)
        await far_end.ask("step", seconds=0.8)
        assert (await far_end.ask("state"))["amplifiers"]["main"]["fault"] == "OVER_TEMPERATURE"
        strength = []
        for since in (0.3, 0.4, 0.6):
            felt = await far_end.ask("felt", since_s=since, until_s=since + 0.1)
            strength.append(felt["fingers"]["1"]["peak_m_s2"][0])
    assert strength[1] == pytest.approx(strength[0], rel=0.1)
    assert strength[2] < 0.5 * strength[1]  # it only rings down


@pytest.mark.parametrize("number", shortly([signal.SIGTERM, signal.SIGHUP], [signal.SIGTERM]))
async def test_simulation_ends_on_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    """SIGTERM and SIGHUP end it with status 0, and its control socket goes."""
    async with far_end_process(write_rig(tmp_path / "rig.yaml"), "--modbus-tcp", "0") as far_end:
        assert "--virtual-time" in (await far_end.ask("step", seconds=1))["error"]
        status, _ = await far_end.end(number)
    assert status == 0
    assert not far_end.control.exists()


@pytest.mark.parametrize("after", [0.1, 0.4])
async def test_simulation_exits_on_a_signal_while_it_starts(tmp_path: Path, after: float) -> None:
    """It exits without a traceback."""
    for command in (["-m", "sim"], ["-c", "from era_haptics.command import main; main()", "sim"]):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", *command, str(write_rig(tmp_path / "rig.yaml")), "--serial"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        await asyncio.sleep(after)
        process.terminate()
        _, err = await asyncio.wait_for(process.communicate(), 30)
        # -SIGINT: CPython exits so if the signal interrupts an exec(), for instance in dataclasses.
        assert process.returncode in (0, 130, -signal.SIGTERM, -signal.SIGINT)
        assert err == b""


async def test_sim_reports_a_package_that_is_missing() -> None:
    """The error names the package, although the exit statuses are in a module that needs it."""
    program = "import sys; sys.modules['typer'] = None; from sim.__main__ import main; main()"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-c", program),
        stderr=asyncio.subprocess.PIPE,
    )
    _, err = await asyncio.wait_for(process.communicate(), TIMEOUT)
    assert err.decode().splitlines()[-1].startswith("ModuleNotFoundError: import of typer")


@pytest.fixture
def socket_path() -> Iterator[Path]:
    """Return a path short enough for a Unix socket."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "control"


def mode(path: Path) -> int | None:
    """Return the permissions of a file, or None if it is missing."""
    return stat.S_IMODE(path.stat().st_mode) if path.exists() else None


async def ask(context: SimulationContext, now: float, **request: Any) -> dict[str, Any]:
    """One line of control."""
    return await execute(context, json.dumps(request).encode(), now=now)


async def test_control_keeps_loads_of_fingers(coarse_rig: Rig) -> None:
    """Until they lift or get another one; a finger that touches has 1 where none is given."""
    bench = Bench(coarse_rig, now=0.0)
    loads = []
    for request in (
        {"op": "fingers", "fingers": {"a": [0.1, 0.08], "b": [0, 0]}, "loads": {"a": 2}},
        {"op": "touch", "finger": "c", "at_m": [0.2, 0.1], "load": 0.5},
        {"op": "move", "finger": "a", "at_m": [0.1, 0.09]},
        {"op": "move", "finger": "c", "at_m": [0.2, 0.1], "load": 3},
        {"op": "lift", "finger": "a"},
        {"op": "touch", "finger": "a", "at_m": [0.1, 0.08]},
        {"op": "fingers", "fingers": {"c": [0.1, 0.08]}},
    ):
        assert (await ask(SimulationContext(bench), 1.0, **request))["ok"]
        loads.append(dict(bench.loads))
    assert loads == [
        {"a": 2.0},
        {"a": 2.0, "c": 0.5},
        {"a": 2.0, "c": 0.5},
        {"a": 2.0, "c": 3.0},
        {"c": 3.0},
        {"c": 3.0},
        {},
    ]


@pytest.mark.parametrize(
    "line",
    [
        b'{"op": "fingers", "fingers": {"a": [0.1, 0.1]}, "loads": {"b": 1}}\n',
        b'{"op": "fingers", "fingers": {"a": [0.1, 0.1]}, "loads": {"a": 0}}\n',
        b'{"op": "fingers", "fingers": {"a": [0.1, 0.1]}, "loads": [1]}\n',
        b'{"op": "touch", "finger": "a", "at_m": [0.1, 0.1], "load": "much"}\n',
        b"\n",
        b"\xff\xfe\n",
        b"[1]\n",
        b"{}\n",
        b'{"op": "stop"}\n',
        b'{"op": "fingers"}\n',
        b'{"op": "fingers", "fingers": {"b": 3}}\n',
        b'{"op": "fingers", "fingers": {"b": [0.1]}}\n',
        b'{"op": "fingers", "fingers": {"b": [0.1, NaN]}}\n',
        b'{"op": "fingers", "fingers": {"b": [0.1, true]}}\n',
        b'{"op": "fingers", "fingers": {"b": [0.1, 0.5]}}\n',
        b'{"op": "fingers", "fingers": {"b": [0.1, 1' + b"0" * 400 + b"]}}\n",
        b'{"op": "felt", "since_s": 2, "until_s": 1}\n',
        b'{"op": "felt", "since_s": "0", "until_s": 1}\n',
        b"[" * 60_000 + b"\n",
        b'{"op": "felt", "since_s": ' + b"1" * 5000 + b"}\n",
    ],
)
async def test_control_refuses_an_invalid_line(coarse_rig: Rig, line: bytes) -> None:
    """The response is a short error, and nothing changes."""
    bench = Bench(coarse_rig, now=1.0)
    await ask(SimulationContext(bench), 1.0, op="fingers", fingers={"a": [0.1, 0.1]})
    reply = await execute(SimulationContext(bench), line, now=1.0)
    assert reply.keys() == {"error"}
    assert len(reply["error"]) < 300
    assert bench.sample_fingers().layout.positions == {"a": (0.1, 0.1)}


async def test_control_socket_is_private_and_removed(coarse_rig: Rig, socket_path: Path) -> None:
    """In place of a stale one of a killed simulation: mode 0600; several lines per connection.

    An endless line ends its connection with an error, others continue; no file is left.
    """
    context = SimulationContext(Bench(coarse_rig, now=0.0))
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(socket_path))
    async with control_socket(context, socket_path):
        assert mode(socket_path) == 0o600
        reader, writer = await asyncio.open_unix_connection(socket_path)
        writer.write(b'{"op": "state"}\nnonsense\n{"op": "state"}\n')
        replies = [json.loads(await reader.readline()) for _ in range(3)]
        assert ["error" in reply for reply in replies] == [False, True, False]
        with pytest.raises(LinkError, match=str(socket_path)):
            async with control_socket(context, socket_path):
                pass
        endless, deaf = await asyncio.open_unix_connection(socket_path)
        deaf.write(b" " * (2 * LINE_MAX))
        assert str(LINE_MAX) in json.loads(await endless.readline())["error"]
        writer.write(b'{"op": "state"}\n')
        assert "amplifiers" in json.loads(await reader.readline())
        for connection in (writer, deaf):
            connection.close()
            with contextlib.suppress(ConnectionError):
                await connection.wait_closed()
    assert mode(socket_path) is None


async def test_control_refuses_an_unusable_path(coarse_rig: Rig, socket_path: Path) -> None:
    """A missing folder, a long path and a plain file are refused by name."""
    bench = Bench(coarse_rig, now=0.0)
    plain = socket_path.parent / "plain"
    plain.write_text("kept")
    for path in (socket_path / "deeper", socket_path.parent / ("x" * 200), plain):
        with pytest.raises(LinkError, match=str(path)):
            async with control_socket(SimulationContext(bench), path):
                pass
    assert plain.read_text() == "kept"
