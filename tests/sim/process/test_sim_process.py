"""`python -m sim` as a process: output, shutdown and errors."""

import asyncio
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.cli.main import run
from drivers.contents import Tone
from drivers.protocol.table import QUANTITIES, STATES
from model.rig.file import example_rig_path
from playing import playing

ROOT = example_rig_path().parent.parent
TIMEOUT = 30  # s; for a loaded machine, not an expectation


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
