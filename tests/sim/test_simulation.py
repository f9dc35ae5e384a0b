"""A simulation as a process: command, run loop, control socket."""

import asyncio
import contextlib
import json
import signal
import socket
import stat
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
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
from processes.daemons import playing
from sim.bench.bench import Bench
from sim.control import LINE_MAX, SimulationContext, control_socket, execute

TIMEOUT = 120  # s; for a loaded machine, not an expectation


@dataclass
class FarEndProcess:
    """What was started: the URL by the amplifier's name, and its streams."""

    urls: Mapping[str, str]
    control: Path
    process: asyncio.subprocess.Process
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def ask(self, op: str, **request: Any) -> dict[str, Any]:
        """Return the reply to a line of control, errors among them."""
        self.writer.write(json.dumps({"op": op, **request}).encode() + b"\n")
        line = await asyncio.wait_for(self.reader.readline(), TIMEOUT)
        reply: dict[str, Any] = json.loads(line)
        return reply

    async def end(self) -> tuple[int | None, str]:
        """Terminate it; return its exit status and the rest of its standard output."""
        self.process.terminate()
        out, _ = await asyncio.wait_for(self.process.communicate(), TIMEOUT)
        return self.process.returncode, out.decode()


@asynccontextmanager
async def far_end_process(rig: Path, *options: str) -> AsyncIterator[FarEndProcess]:
    """`era sim` of a rig file with these options; it ends with the context at the latest."""
    with tempfile.TemporaryDirectory() as folder:  # a short path, as sockets need
        control = Path(folder) / "control"
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "sim", str(rig), "--control", str(control), *options),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            cwd=example_rig_path().parent.parent,
        )
        try:
            line = (await asyncio.wait_for(process.stdout.readline(), TIMEOUT)).decode()
            name, _, url = line.strip().partition(": ")
            reader, writer = await asyncio.open_unix_connection(control, limit=1 << 24)
            try:
                yield FarEndProcess({name: url}, control, process, reader, writer)
            finally:
                writer.close()
                with contextlib.suppress(ConnectionError):
                    await writer.wait_closed()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()


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
