"""A simulation as a process: its command, its run loop, and its view on a terminal."""

import asyncio
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bench_driving import play
from controller.cli.main import run
from drivers.contents import Tone
from drivers.protocol.table import QUANTITIES, STATES
from far_end_process import playing
from model.rig.file import example_rig_path
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.control.context import SimulationContext
from sim.process.view import PlateView, draw

ROOT = example_rig_path().parent.parent
TIMEOUT = 120  # s; for a loaded machine, not an expectation


async def start(arguments: Sequence[str]) -> asyncio.subprocess.Process:
    """Start a simulation as users do."""
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", "sim", *arguments),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )


async def wait(process: asyncio.subprocess.Process) -> tuple[int, str, str]:
    """Exit status and the rest of both outputs."""
    out, err = await asyncio.wait_for(process.communicate(), TIMEOUT)
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


@pytest.mark.parametrize("is_interrupted", [True, False])
async def test_sim_serves_until_interrupted_or_eof(is_interrupted: bool) -> None:
    """It prints a URL, serves the amplifier, and exits with status 0 and no files left."""
    with tempfile.TemporaryDirectory() as folder:
        control, link = Path(folder) / "control", Path(folder) / "amp"
        options = ["--serial", "--link", str(link), "--control", str(control), "--until-eof"]
        process = await start([str(example_rig_path()), *options])
        try:
            assert process.stdout is not None
            line = (await asyncio.wait_for(process.stdout.readline(), TIMEOUT)).decode()
            assert line == f"main: serial://{link}?baud=921600\n"
            assert link.readlink().is_char_device()
            assert control.is_socket()
            tone = Tone(2, 110.0, 0.25)
            async with playing(line.split()[1], tone, watchdog=2.0) as amplifier:
                status = await amplifier.read_status()
            assert (status["state"], status["token"]) == (STATES["OPERATION_ENABLED"], 1)
            assert status["levels"] == [0, 0, QUANTITIES["level"].to_wire(0.25), 0]
        finally:
            if is_interrupted:
                process.send_signal(signal.SIGINT)
            elif process.stdin is not None:
                process.stdin.close()
            ending = await wait(process)
        assert ending == (0, "", "")
        assert not control.exists()
        assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([str(example_rig_path())], 2, "--serial"),
        (["no_such_rig.yaml", "--serial"], 2, "no_such_rig.yaml"),
        ([str(example_rig_path()), "--serial", "--finger", "0.1"], 2, "--finger"),
        ([str(example_rig_path()), "--serial", "--finger", "9,9"], 2, "finger"),
        ([str(example_rig_path()), "--serial", "--exact", "--seed", "1"], 2, "--seed"),
        ([str(example_rig_path()), "--serial", "--control", "/no/where"], 3, "/no/where"),
        ([str(example_rig_path()), "--serial", "--link", "side=/tmp/x"], 2, "--link"),
        ([str(example_rig_path()), "--serial", "--link", "/no/where"], 2, "/no/where"),
        ([str(example_rig_path()), "--modbus-tcp", "0", "--link", "/tmp/x"], 2, "--link"),
    ],
)
def test_sim_refuses_bad_usage_in_one_line(
    arguments: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 2 for input, 3 for the link; one line that names the option or file."""
    assert run(["sim", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert err.count("\n") == 1


def shown(context: SimulationContext, plate: PlateView) -> str:
    """The view as text on a usual terminal."""
    console = Console(width=80, force_terminal=False)
    with console.capture() as capture:
        console.print(draw(context, plate))
    return capture.get()


def rows_of(text: str) -> list[str]:
    """The plate's rows, the top one first."""
    return [line[1:-1] for line in text.splitlines() if line.startswith("|")]


def test_view_shows_eras_fingers_and_peaks_in_place(coarse_rig: Rig) -> None:
    """y points upwards; peaks are darkest near the driven ERA; nothing at rest."""
    bench = Bench(coarse_rig, now=0.0)
    context = SimulationContext(bench, urls={"main": "serial:///dev/pts/7?baud=921600"})
    plate = PlateView(bench)
    bench.probes.append(plate)
    untouched = shown(context, plate).splitlines()
    assert len(untouched) < 24
    assert max(map(len, untouched)) <= 80
    bench.place_fingers({"1": (0.25, 0.05)}, now=0.0)
    still = shown(context, plate)
    rows = rows_of(still)
    assert [row[0] + row[-1] for row in (rows[0], rows[-1])] == ["EE", "EE"]
    # 0.25 of 0.3048 m from the left, 0.05 of 0.2286 m from below.
    assert rows[-1 - int(0.05 / 0.2286 * len(rows))].index("O") == int(0.25 / 0.3048 * 28)
    assert set("".join(rows)) == {"E", "O", " "}
    play(bench, Tone(0, 40.0, 0.5), now=0.1, watchdog=2.0)
    bench.advance(1.0)
    bench.advance(1.3)
    moving = shown(context, plate)
    assert "OPERATION_ENABLED" in moving
    assert " 50%    0%    0%    0%" in moving
    assert "1.3 s" in moving
    shades = " ·-+*#@"
    depth = np.array([[max(shades.find(c), 0) for c in row] for row in rows_of(moving)])
    # SW, where the drive is, is below on the left.
    assert depth[-3:, :8].mean() > depth[:3, -8:].mean()
