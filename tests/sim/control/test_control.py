"""The control socket: operations and errors."""

import asyncio
import contextlib
import json
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import LinkError
from drivers.playing import Tone
from firmware_machine import play
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from sim.bench.bench import Bench
from sim.control import LINE_MAX, SimulationContext, carry_out, control_socket
from sim.plant.imperfections import Imperfections, PlateErrors


@pytest.fixture
def socket_path() -> Iterator[Path]:
    """A path short enough for a Unix socket, wherever tests keep their files."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "control"


def mode(path: Path) -> int | None:
    """Who may use a file, None where there is none."""
    return stat.S_IMODE(path.stat().st_mode) if path.exists() else None


async def ask(bench: Bench, now: float, **request: Any) -> dict[str, Any]:
    """One line of control."""
    return await carry_out(SimulationContext(bench), json.dumps(request).encode(), now=now)


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
        assert (await ask(bench, 1.0, **request))["ok"]
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
    ],
)
async def test_control_refuses_an_invalid_line(coarse_rig: Rig, line: bytes) -> None:
    """The response is a short error, and nothing changes."""
    bench = Bench(coarse_rig, now=1.0)
    await ask(bench, 1.0, op="fingers", fingers={"a": [0.1, 0.1]})
    reply = await carry_out(SimulationContext(bench), line, now=1.0)
    assert reply.keys() == {"error"}
    assert len(reply["error"]) < 300
    assert bench.fingers.layout.positions == {"a": (0.1, 0.1)}


async def test_control_socket_is_private_and_removed(coarse_rig: Rig, socket_path: Path) -> None:
    """Mode 0600; several lines per connection; no file is left."""
    bench = Bench(coarse_rig, now=0.0)
    async with control_socket(SimulationContext(bench), socket_path):
        assert mode(socket_path) == 0o600
        reader, writer = await asyncio.open_unix_connection(socket_path)
        writer.write(b'{"op": "state"}\nnonsense\n{"op": "state"}\n')
        replies = [json.loads(await reader.readline()) for _ in range(3)]
        assert ["error" in reply for reply in replies] == [False, True, False]
        with pytest.raises(LinkError, match=str(socket_path)):
            async with control_socket(SimulationContext(bench), socket_path):
                pass
        writer.close()
        await writer.wait_closed()
    assert mode(socket_path) is None


async def test_control_closes_on_an_endless_line(coarse_rig: Rig, socket_path: Path) -> None:
    """The client gets an error; other connections continue."""
    bench = Bench(coarse_rig, now=0.0)
    async with control_socket(SimulationContext(bench), socket_path):
        reader, writer = await asyncio.open_unix_connection(socket_path)
        writer.write(b" " * (2 * LINE_MAX))
        assert str(LINE_MAX) in json.loads(await reader.readline())["error"]
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()
        again, other = await asyncio.open_unix_connection(socket_path)
        other.write(b'{"op": "state"}\n')
        assert "amplifiers" in json.loads(await again.readline())
        other.close()
        await other.wait_closed()


async def test_control_replaces_a_stale_socket(coarse_rig: Rig, socket_path: Path) -> None:
    """A killed simulation leaves one behind."""
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(socket_path))
    async with control_socket(SimulationContext(Bench(coarse_rig, now=0.0)), socket_path):
        _, writer = await asyncio.open_unix_connection(socket_path)
        writer.close()
        await writer.wait_closed()


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


async def test_plate_operation_changes_what_is_felt_and_can_be_undone(coarse_rig: Rig) -> None:
    """A softer mount and 50 g change the amplitude under a finger; without keys it is as at first.

    Amplitudes of the changed plate are those of a bench that was built with these errors.
    """
    name = coarse_rig.eras[2].name
    mass = PointLoad(0.2, 0.06, mass=0.05)
    errors = PlateErrors(modulus=0.9, stiffness={name: 0.8}, masses=(mass,))
    changes = {"modulus": 0.9, "stiffness": {name: 0.8}, "masses": [[0.2, 0.06, 0.05]]}
    first = await felt_after(coarse_rig, Imperfections())
    built = await felt_after(coarse_rig, Imperfections(plate=errors))
    changed = await felt_after(coarse_rig, Imperfections(), changes)
    restored = await felt_after(coarse_rig, Imperfections(), changes, {})
    assert changed == pytest.approx(built, rel=1e-4)
    assert abs(changed / first - 1) > 0.05
    assert restored == pytest.approx(first, rel=1e-4)


async def felt_after(rig: Rig, imperfections: Imperfections, *changes: dict[str, Any]) -> float:
    """Amplitude under a finger [m/s²] of a vibration on the plate after some changes of it."""
    bench = Bench(rig, now=0.0, imperfections=imperfections)
    context = SimulationContext(bench)

    async def asked(now: float, **request: Any) -> dict[str, Any]:
        reply = await carry_out(context, json.dumps(request).encode(), now=now)
        assert "error" not in reply, reply
        return reply

    await asked(0.1, op="fingers", fingers={"1": [0.1, 0.08]})
    for change in changes:
        await asked(0.1, op="plate", **change)
    play(bench, Tone(0, 110.0, 0.5), now=0.2, token=9, watchdog=2.0)
    reply = await asked(2.0, op="felt", since_s=1.5, until_s=2.0)
    return float(reply["fingers"]["1"]["amplitude_m_s2"][0][0])


@pytest.mark.parametrize(
    "request_",
    [
        {"stiffness": {"nowhere": 1.0}},
        {"stiffness": {"NE": 0.0}},
        {"modulus": -1},
        {"masses": [[0.1, 0.1]]},
        {"masses": [[9.0, 0.1, 0.001]]},
        {"thickness": 1.0},
    ],
)
async def test_plate_operation_refuses_what_is_no_plate(
    coarse_rig: Rig, request_: dict[str, Any]
) -> None:
    """An error, and the plate stays."""
    bench = Bench(coarse_rig, now=5.0)
    assert "error" in await ask(bench, 5.1, op="plate", **request_)
    assert bench.imperfections == Imperfections()
