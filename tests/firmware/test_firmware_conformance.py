"""The firmware on this machine, behind real lines, under the conformance suite."""

from pathlib import Path

import pytest

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, run_check
from drivers.registry import open_backend
from firmware_programs import running_firmware

REPLY_TIMEOUT = 2.0  # s; a busy machine delays replies

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize(
    "line", [["--serial"], ["--modbus-rtu"], ["--modbus-tcp", "0"]], ids=" ".join
)
async def test_firmware_conforms(firmware: Path, line: list[str]) -> None:
    """It passes every check."""
    with running_firmware(firmware, *line) as url:
        amplifier = Amplifier(open_backend(url), reply_timeout=REPLY_TIMEOUT)
        await amplifier.open()
        results = [await run_check(check, amplifier) for check in CHECKS]
        await amplifier.close()
    assert [(one.check.name, one.problem) for one in results if one.problem] == []
