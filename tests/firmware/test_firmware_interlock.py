"""The interlock of the firmware, which the signal USR1 opens and closes."""

import asyncio
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.protocol.messages import AmplifierState, Fault, Status
from drivers.registry import open_backend
from firmware_programs import running_firmware

REPLY_TIMEOUT = 2.0  # s; a busy machine delays replies


@pytest.mark.real_time
async def test_open_interlock_is_a_fault_until_it_is_closed(firmware: Path) -> None:
    """It silences an armed amplifier, keeps it from being armed, and is cleared once closed."""
    with running_firmware(firmware, "--serial") as (url, process):
        amplifier = Amplifier(open_backend(url), reply_timeout=REPLY_TIMEOUT)
        await amplifier.open()
        await amplifier.arm(2.0)
        os.kill(process, signal.SIGUSR1)
        status = await until(amplifier, lambda status: status.state is AmplifierState.FAULT)
        assert (status.fault, status.interlock_open) == (Fault.INTERLOCK, True)
        assert not status.high_voltage
        assert (await amplifier.clear()).state is AmplifierState.FAULT
        os.kill(process, signal.SIGUSR1)
        await until(amplifier, lambda status: not status.interlock_open)
        assert (await amplifier.clear()).state is AmplifierState.SWITCH_ON_DISABLED
        os.kill(process, signal.SIGUSR1)
        await until(amplifier, lambda status: status.interlock_open)
        with pytest.raises(CommandRefused):
            await amplifier.arm(2.0)
        await amplifier.close()


async def until(amplifier: Amplifier, reached: Callable[[Status], bool]) -> Status:
    """Poll until a status is reached."""
    async with asyncio.timeout(60):
        status = await amplifier.status()
        while not reached(status):
            status = await amplifier.status()
    return status
