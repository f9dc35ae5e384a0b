"""The firmware on this machine, behind real lines, under the conformance suite."""

from pathlib import Path

import pytest

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, raw_line, run_check
from drivers.registry import open_backend
from firmware_programs import UARTS, running_firmware, running_machine

REPLY_TIMEOUT = 2.0  # s; a busy machine delays replies

pytestmark = pytest.mark.real_time


async def problems(url: str) -> list[tuple[str, str]]:
    """The checks that fail, with what happened."""
    amplifier = Amplifier(open_backend(url), reply_timeout=REPLY_TIMEOUT)
    await amplifier.open()
    raw = raw_line(url)
    results = [await run_check(check, amplifier, raw, url=url) for check in CHECKS]
    await amplifier.close()
    return [(one.check.name, one.problem) for one in results if one.problem is not None]


@pytest.mark.parametrize(
    "line", [["--serial"], ["--modbus-rtu"], ["--modbus-tcp", "0"], ["--slcan"]], ids=" ".join
)
async def test_firmware_conforms_on_this_machine(firmware: Path, line: list[str]) -> None:
    """It passes every check."""
    with running_firmware(firmware, *line) as url:
        assert await problems(url) == []


@pytest.mark.parametrize("scheme", UARTS)
async def test_firmware_conforms_on_a_cortex_m3(bare_metal: Path, scheme: str) -> None:
    """It passes every check in QEMU, without an operating system."""
    with running_machine(bare_metal, scheme) as url:
        assert await problems(url) == []
