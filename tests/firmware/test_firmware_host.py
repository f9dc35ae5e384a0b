"""The firmware as a program, on terminals and TCP, and the host of protocol 4."""

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from drivers.errors import CommandRefused
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line, Priority
from drivers.opening import Lines
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Values
from firmware_machine import running_firmware
from real_wires import MASTERS, drive
from registry.limits import GuardLimits

LIMITS = GuardLimits(20.0, 1000.0, 1.0)
REPLY_TIMEOUT = 5.0  # s; the firmware is another process, on a busy machine
NEW = 9
LINES = {
    "--serial": "?address=9",
    "--modbus-rtu": "#9",
    "--modbus-tcp": "/9",
    "--slcan": "#9",
}
"""Options of the program, and how the URL of each line ends with the new address."""

pytestmark = pytest.mark.real_time


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    for method in (Amplifier.request, Line.submit):
        monkeypatch.setitem(method.__kwdefaults__, "timeout", REPLY_TIMEOUT)


def options(line: str, *others: str) -> list[str]:
    """Options of the program with a line."""
    return [*others, line, *(["0"] if line == "--modbus-tcp" else [])]


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Amplifier]:
    """The amplifier of a URL, identified."""
    lines = Lines()
    amplifier = await lines.amplifier(url, LIMITS, name="a")
    try:
        await amplifier.open()
        yield amplifier
    finally:
        await lines.close()


@pytest.mark.parametrize("name", MASTERS)
def test_foreign_master_drives_it(name: str, firmware: Path) -> None:
    """Reads by both functions, writes, a set, and an exception; none of the host takes part."""
    line, make = MASTERS[name]
    with running_firmware(firmware, *options(f"--modbus-{line}")) as (url, _):
        assert drive(make, url) == "ERA haptics"


@pytest.mark.parametrize("line", LINES)
async def test_address_is_taken_and_kept_without_supply(
    line: str, firmware: Path, tmp_path: Path
) -> None:
    """It replies there after a restart; not to the name of another, and not while armed."""
    kept = tmp_path / "addresses"
    with running_firmware(firmware, *options(line, "--addresses", str(kept))) as (url, _):
        async with opened(url) as amplifier:
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-2")
            await amplifier.arm(7, 2.0)
            with pytest.raises(CommandRefused):
                await move(amplifier, "FW-1")
            await amplifier.disarm(0.0)
            await move(amplifier, "FW-1")
            async with asyncio.timeout(60):  # it is kept behind its reply
                while not (kept.is_file() and kept.stat().st_size):  # noqa: ASYNC110 - another process writes it
                    await asyncio.sleep(0.01)
    with running_firmware(firmware, *options(line, "--addresses", str(kept))) as (url, _):
        assert url.endswith(LINES[line])
        async with opened(url) as amplifier:
            assert amplifier.identity["serial_number"] == "FW-1"


async def move(amplifier: Amplifier, serial_number: str) -> Values:
    """Send SetAddress for an amplifier of a serial number."""
    values = {"address": NEW, "serial_number": serial_number}
    return await amplifier.line.submit(amplifier, Priority.OTHER, "SetAddress", values)


async def test_open_interlock_is_a_fault_until_it_is_closed(firmware: Path) -> None:
    """It silences an armed amplifier, keeps it from being armed, and is cleared once closed."""
    with running_firmware(firmware, "--serial") as (url, process):
        async with opened(url) as amplifier:
            await amplifier.arm(7, 2.0)
            os.kill(process, signal.SIGUSR1)
            status = await status_with(amplifier, state=STATES["FAULT"])
            assert (status["fault"], status["flags"]) == (FAULTS["INTERLOCK"], 2)
            assert (await amplifier.clear())["state"] == STATES["FAULT"]
            os.kill(process, signal.SIGUSR1)
            await status_with(amplifier, flags=0)
            assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
            os.kill(process, signal.SIGUSR1)
            await status_with(amplifier, flags=2)
            with pytest.raises(CommandRefused):
                await amplifier.arm(8, 2.0)


async def status_with(amplifier: Amplifier, **values: int) -> Values:
    """Read the status until it has these values."""
    async with asyncio.timeout(60):
        status = await amplifier.read_status()
        while any(status[name] != value for name, value in values.items()):
            status = await amplifier.read_status()
    return status
