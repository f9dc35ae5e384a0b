"""Addresses of the firmware, set over each wire, and kept without supply."""

from pathlib import Path

import pytest

from drivers.amp_actions import identify, set_address
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused, FrameError, LinkError
from drivers.registry import open_backend
from firmware_programs import running_firmware
from patient_daemon import REPLY_TIMEOUT, wait_long
from wires import patient

NEW = 9
LINES = {
    "--serial": "?address=9",
    "--modbus-rtu": "#9",
    "--modbus-tcp": "/9",
    "--slcan": "#9",
}


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hosts that wait for the firmware, another process, as long as a busy machine takes."""
    wait_long(monkeypatch)
    monkeypatch.setattr("drivers.backends.can_bus.backend._BROADCAST_TIMEOUT", REPLY_TIMEOUT)


def options(line: str, kept: Path) -> list[str]:
    """Options of the program with a line, and a file for its addresses."""
    return ["--addresses", str(kept), line, *(["0"] if line == "--modbus-tcp" else [])]


@pytest.mark.real_time
@pytest.mark.parametrize("line", LINES)
async def test_address_is_taken_and_kept_without_supply(
    line: str, firmware: Path, tmp_path: Path
) -> None:
    """It replies there at once, and there alone after a restart of the program."""
    kept = tmp_path / "addresses"
    with running_firmware(firmware, *options(line, kept)) as (url, _):
        moved = await set_address(patient(url), NEW, None)
        assert moved["serial_number"] == "FW-1"
        assert (await identify(moved["url"]))["serial_number"] == "FW-1"
    with running_firmware(firmware, *options(line, kept)) as (url, _):
        assert url.endswith(LINES[line])
        assert (await identify(patient(url)))["serial_number"] == "FW-1"


@pytest.mark.real_time
@pytest.mark.parametrize("line", LINES)
async def test_address_of_another_or_while_armed_is_not_taken(line: str, firmware: Path) -> None:
    """The amplifier stays where it is, by the serial number of another and while armed."""
    with running_firmware(firmware, *options(line, Path("/dev/null"))) as (url, _):
        with pytest.raises((LinkError, CommandRefused, FrameError)):
            await set_address(patient(url), NEW, "FW-2")
        amplifier = Amplifier(open_backend(patient(url)))
        await amplifier.open()
        await amplifier.arm(2.0)
        await amplifier.close()
        with pytest.raises(CommandRefused):
            await set_address(patient(url), NEW, None)
        assert (await identify(patient(url)))["serial_number"] == "FW-1"
