"""The firmware on this machine, behind a real line, under the conformance suite.

`make firmware-test` does the same on every wire, and on a Cortex-M3 in QEMU.
"""

from pathlib import Path

import pytest

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, Result, run_check
from drivers.registry import open_backend
from firmware_programs import running_firmware

REPLY_TIMEOUT = 2.0  # s; a busy machine delays replies


@pytest.mark.real_time
async def test_firmware_conforms(firmware: Path) -> None:
    """It fails no check, and passes most."""
    with running_firmware(firmware, "--serial") as (url, _):
        amplifier = Amplifier(open_backend(url), reply_timeout=REPLY_TIMEOUT)
        await amplifier.open()
        results = [await run_check(check, amplifier) for check in CHECKS]
        await amplifier.close()
    assert [one for one in results if one.result is Result.FAILED] == []
    assert sum(one.result is Result.PASSED for one in results) > len(CHECKS) / 2
