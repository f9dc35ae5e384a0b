"""The firmware on bare metal: a Cortex-M3 in QEMU, driven by the host on its serial line.

QEMU's clock is the clock of this machine, with which conformance compares the amplifier's.
`make qemu-test` runs full conformance.
"""

import asyncio
import json
import subprocess
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.set_admission import StagedSet
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Values
from emulated_board import ERA, PROGRAMS, Board, emulated_board
from processes.installed import installed_program
from registry.limits import GuardLimits
from sim.far_ends import firmware as sim_firmware

pytestmark = pytest.mark.real_time

PACKAGES = {
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
    "make": "make",
}
LEVEL = 0.2
LEVEL_WORD = 2000
HIGH_VOLTAGE = 1800  # V
WATCHDOG = 2.0  # s


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the firmware; skip the tests without the programs that build and run it."""
    for program in PROGRAMS:
        installed_program(program, package=PACKAGES[program])
    return tmp_path_factory.mktemp("mps2")


@pytest.fixture(scope="module")
def board(folder: Path) -> Iterator[Board]:
    """A running board."""
    with emulated_board(folder) as running:
        yield running


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let replies take 5 s: the processor is emulated, on a busy machine."""
    for method in (Amplifier.request, Line.submit):
        monkeypatch.setitem(method.__kwdefaults__, "timeout", 5.0)


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Amplifier]:
    """The amplifier of a URL, identified."""
    lines = Lines()
    amplifier = await lines.amplifier(url, GuardLimits(20.0, 1000.0, 1.0), name="a")
    try:
        await amplifier.open()
        yield amplifier
    finally:
        await lines.close()


async def status_in(amplifier: Amplifier, state: str) -> Values:
    """Read the status until it has this state."""
    async with asyncio.timeout(20):
        status = await amplifier.read_status()
        while status["state"] != STATES[state]:
            status = await amplifier.read_status()
    return status


async def play(amplifier: Amplifier, session: int) -> None:
    """Arm it under a new session, and play a tone on channel 1."""
    await amplifier.arm(session, WATCHDOG)
    layer = AmplifierLayer(0, (AmplifierTone(1, 150.0, LEVEL),), ramp=0.0)
    await amplifier.stage(StagedSet([layer]), 1, now=True)
    status = await amplifier.read_status()
    assert status["state"] == STATES["OPERATION_ENABLED"]
    assert status["levels"] == [0, LEVEL_WORD, 0, 0]
    assert status["high_voltage"] == HIGH_VOLTAGE


async def test_set_plays_until_stop_which_is_cleared(board: Board) -> None:
    """A set shows its level; a stop silences and latches until Clear, without high voltage."""
    async with opened(board.serial) as amplifier:
        assert amplifier.identity["serial_number"] == "MPS2-1"
        await play(amplifier, 7)
        await amplifier.stop(0.0)
        status = await status_in(amplifier, "QUICK_STOP_ACTIVE")
        assert status["levels"] == [0, 0, 0, 0]
        assert status["high_voltage"] == 0
        await amplifier.clear()
        await status_in(amplifier, "SWITCH_ON_DISABLED")


async def test_silent_host_trips_the_watchdog(board: Board) -> None:
    """After its watchdog time without a Ping it is silent in a fault, without high voltage."""
    async with opened(board.serial) as amplifier:
        await play(amplifier, 8)
        status = await status_in(amplifier, "FAULT")  # reading the status does not feed
        assert status["fault"] == FAULTS["WATCHDOG"]
        assert status["levels"] == [0, 0, 0, 0]
        assert status["high_voltage"] == 0
        await amplifier.clear()
        await status_in(amplifier, "SWITCH_ON_DISABLED")


async def test_simulation_runs_a_board_for_each_amplifier_until_it_ends(
    board: Board, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An amplifier of `era sim --cortex-m` arms, plays and stops; its port is closed afterwards."""
    monkeypatch.setattr(sim_firmware, "FIRMWARE_FOLDER", folder)
    firmware = sim_firmware.find_firmware(is_emulated=True)
    async with sim_firmware.running_firmware(firmware, "a") as url, opened(url) as amplifier:
        await play(amplifier, 9)
        await amplifier.stop(0.0)
        await status_in(amplifier, "QUICK_STOP_ACTIVE")
    port = urlsplit(url).port
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection("127.0.0.1", port)


def test_short_conformance_passes(board: Board) -> None:
    """No check that only reads fails."""
    command = [ERA, "amp", "conformance", board.serial, "--json"]

    completed = subprocess.run(command, check=False, capture_output=True, text=True)

    report = json.loads(completed.stdout)
    failures = [check for check in report["checks"] if check["result"] == "failed"]
    assert failures == []
    assert report["passed"] > 0
