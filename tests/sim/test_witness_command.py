"""`era witness`: captures, relays, and invalid input."""

import asyncio
import json
import math
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from resource import RLIM_INFINITY, RLIMIT_FSIZE, prlimit

import pytest
from typer.testing import CliRunner

from drivers.amplifier import Amplifier
from drivers.registry import open_backend
from model.errors import InputError
from model.rig.file import example_rig_path
from model.rig.rig import Rig
from sim.cli import app
from sim.witness.capture import read_capture
from sim.witness.config import parse_config
from wires import WIRES, far_side

URL = "serial:///dev/ttyUSB0"
# docs/reference/wire-protocol.md: Hello, Arm and Stop with their answers; then an Apply although
# stopped.
SESSION = """
0.000 wire1 > 00 02 01 03 01 07 05 5D 22 C1 B5 00   # Hello
0.002 wire1 < 0002810301070204180441636D65045175616404412D313703312E326EA37E2400
0.010 wire1 > 00 05 03 02 01 07 02 FA 02 09 05 90 59 CA 1E 00
0.012 wire1 < 000583020107020401010301FA02FA030807020401010101010101056DDF034300
"""
DAMAGED = "0.020 wire1 > 00 05 08 02 01 07 02 05 05 5E D5 8B 3F 00\n"
TIMEOUT = 30  # s; for a loaded machine, not an expectation
LIMITS = {0: {"frequency_hz": [40, 500], "level": 1.0}}
CONFIG = {"wires": {"a": "serial"}, "amplifiers": {"m": {"wire": "a", "channels": LIMITS}}}


def _replay(tmp_path: Path, text: str, *options: str) -> tuple[int, str]:
    capture = tmp_path / "capture.txt"
    capture.write_text(text, encoding="utf-8")
    arguments = ["witness", URL, "--replay", str(capture), "--json", *options]
    result = CliRunner().invoke(app, arguments)
    if isinstance(result.exception, InputError):
        return 2, str(result.exception)
    return result.exit_code, result.stdout


def test_witness_replay_reports_a_damaged_frame_only(tmp_path: Path) -> None:
    """Four good frames break no rule; a damaged one is named, with the frames before it."""
    status, out = _replay(tmp_path, SESSION)
    assert (status, json.loads(out)) == (0, {"frames": 4, "violations": []})
    status, out = _replay(tmp_path, SESSION + DAMAGED)
    (found,) = json.loads(out)["violations"]
    assert status == 1
    assert (found["invariant"], found["wire"], found["time_s"]) == ("garbage", "wire1", 0.02)
    assert len(found["frames"]) == 5


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", None),
        ("0.1 wire1 > 0Z\n", 1),
        ("0.1 wire1 = 00\n", 1),
        ("0.2 wire1 > 00\n0.1 wire1 > 00\n", 2),
        ("nan wire1 > 00\n", 1),
        ("# begin\n0.1 wire1 > 00\n0.1 other > 00\n", 3),
        ("0.1 wire1 > 00\n\udcff\n", 2),
        ("0.1 wire1 > 00 04\n", None),
    ],
)
def test_witness_replay_refuses_an_invalid_capture(
    tmp_path: Path, text: str, line: int | None
) -> None:
    """The error names file and line."""
    capture = tmp_path / "capture.txt"
    capture.write_bytes(text.encode("utf-8", errors="surrogateescape"))
    result = CliRunner().invoke(app, ["witness", URL, "--replay", str(capture)])
    assert isinstance(result.exception, InputError)
    place = str(capture) if line is None else f"{capture}:{line}:"
    assert str(result.exception).startswith(place)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--frequency", "500,40"], "--frequency"),
        (["--frequency", "nan,40"], "--frequency"),
        (["--level", "7"], "--level"),
        (["--level", "nan"], "--level"),
        (["--slew", "-1"], "--slew"),
        (["--slack", "-4"], "--slack"),
        (["--slack", "inf"], "--slack"),
        (["--replay", "missing.txt"], "missing.txt"),
        (["--replay", "capture.txt", "--record", "capture.txt"], "--record"),
        (["--replay", "."], "."),
        ([f"{URL}?address=1"], f"{URL}?address=1"),
        (["modbus+rtu:///dev/ttyUSB0"], "modbus+rtu:///dev/ttyUSB0"),
    ],
)
def test_witness_refuses_invalid_arguments(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The option, file or URL is named before anything is opened."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["witness", URL, *arguments])
    assert isinstance(result.exception, InputError)
    assert named in str(result.exception)


@pytest.mark.parametrize(
    ("plan", "named"),
    [
        ({}, "wires"),
        ({"wires": {"a": "smoke"}, "amplifiers": {}}, "wires.a"),
        (CONFIG | {"amplifiers": {"m": {"wire": "b", "channels": LIMITS}}}, "amplifiers.m.wire"),
        (
            CONFIG | {"amplifiers": {"m": {"wire": "a", "channels": {0: {}}}}},
            "channels.0.frequency_hz",
        ),
        (CONFIG | {"times_s": {"lift": math.inf}}, "times_s.lift"),
    ],
)
def test_witness_config_refuses_an_invalid_key(plan: dict[str, object], named: str) -> None:
    """The error names the key."""
    with pytest.raises(InputError) as refused:
        parse_config(plan)
    assert named in str(refused.value)


@pytest.mark.parametrize("room", [RLIM_INFINITY, 64])
async def test_witness_relays_a_wire_until_interrupted(
    coarse_rig: Rig, tmp_path: Path, room: int
) -> None:
    """A session through the relay passes; a full disk only makes the capture incomplete."""
    capture = tmp_path / "capture.txt"
    async with far_side(WIRES["serial"], coarse_rig) as far:
        options = ("--slack", "5000", "--record", str(capture))
        code = "import sys; from controller.cli.main import main; sys.exit(main())"
        process = await asyncio.create_subprocess_exec(
            # -B: bytecode would be cut off, too, and Python does not notice
            *(sys.executable, "-B", "-P", "-c", code, "witness", far.url, *options),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            cwd=example_rig_path().parent.parent,
        )
        assert process.stdout is not None
        line = await asyncio.wait_for(process.stdout.readline(), TIMEOUT)
        prlimit(process.pid, RLIMIT_FSIZE, (room, RLIM_INFINITY))
        url = line.decode().split(": ")[1].strip()
        amplifier = Amplifier(open_backend(url), reply_timeout=2.0)
        await amplifier.open()
        await amplifier.status()
        await amplifier.close()
        process.send_signal(signal.SIGINT)
        out, err = await asyncio.wait_for(process.communicate(), TIMEOUT)
    assert out.decode().split()[0] == "8"
    if room == RLIM_INFINITY:
        assert process.returncode == 0
        assert sum(len(piece.data) > 0 for piece in read_capture(capture)) >= 6
    else:
        assert process.returncode == 2
        (error,) = err.decode().splitlines()
        assert "capture.txt" in error


def test_witness_without_frames_has_checked_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A relay that nothing passed is an error, not "no rule was broken"."""

    @asynccontextmanager
    async def ended_at_once(*_: object) -> AsyncIterator[list[str]]:
        os.kill(os.getpid(), signal.SIGTERM)
        yield ["serial:///dev/pts/9"]

    monkeypatch.setattr("sim.witness_relay.relays", ended_at_once)
    result = CliRunner().invoke(app, ["witness", URL])
    assert isinstance(result.exception, InputError)
    assert "nothing was checked" in str(result.exception)
