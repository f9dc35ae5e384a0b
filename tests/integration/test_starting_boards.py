"""Amplifiers that need seconds to start: daemon and commands reach them all the same."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.by_hand import actions
from era_haptics.lab.conformance.connection import opened
from kit.clock import in_virtual_time
from kit.set_table import make_rig
from kit.wires import WIRES, far_side
from processes.daemons import (
    READY,
    daemon_at,
    far_end,
    until_state,
)
from registry import threads
from registry.limits import GuardLimits
from sim.faults import FaultWindow

RIG = make_rig("a", GuardLimits(20.0, 1000.0, 1.0))
SERIAL = ["serial", "modbus+rtu", "can+slcan"]


@pytest.mark.parametrize(
    ("boots", "openings"),
    [
        pytest.param(0.8, 1, marks=pytest.mark.long),
        pytest.param(5.0, 1, marks=pytest.mark.long),
        (9.0, 2),
    ],
)
@in_virtual_time
async def test_daemon_reaches_it_at_the_first_opening(
    boots: float, openings: int, tmp_path: Path
) -> None:
    """Within 6 s (docs/reference/urls.md), else while the port stays open; also after a loss."""
    async with far_end(tmp_path) as far:
        far.machine.boots = boots
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, READY)
            assert [*far.machine.attempts.values()] == [openings]
            far.device.inject_fault(FaultWindow(fault="unplug"))
            await until_state(era, "COMM_LOST")
            far.device.recover()
            await until_state(era, READY)


async def _conformance(url: str) -> Any:
    async with opened(url) as client:
        return await client.hello()


@pytest.mark.parametrize(
    "action", [actions.identify_amplifier, actions.status, actions.stop, _conformance]
)
@pytest.mark.parametrize("wire", SERIAL)
@in_virtual_time
async def test_command_reaches_it(wire: str, action: Callable[[str], Awaitable[Any]]) -> None:
    """Each opens the port for itself; a stop is confirmed as soon as the board has started."""
    async with far_side(WIRES[wire], RIG) as far:
        far.machine.boots = 5.0
        began = threads.now()
        result = await action(far.url)
        assert threads.now() - began < 7.0
        assert result.get("silence", "confirmed_silent") == "confirmed_silent"
