"""Boards that restart whenever their port is opened, print text, and hear nothing meanwhile."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from daemon_bench import READY, daemon_at, far_end, until_state
from drivers import clock
from drivers.by_hand import actions
from drivers.conformance.opening import opened
from drivers.errors import LinkTimeout
from registry.limits import GuardLimits
from rig_on_wire import WIRES, far_side
from set_table import make_rig
from sim.faults.fault_window import FaultWindow
from virtual_loop import in_virtual_time

RIG = make_rig("a", GuardLimits(20.0, 1000.0, 1.0))
SERIAL = ["serial", "modbus+rtu", "can+slcan"]


@pytest.mark.parametrize(("boots", "openings"), [(0.8, 1), (5.0, 1), (9.0, 2)])
@in_virtual_time
async def test_daemon_reaches_it_at_the_first_opening(
    boots: float, openings: int, tmp_path: Path
) -> None:
    """Within 6 s (docs/reference/urls.md), else while the port stays open; also after a loss."""
    async with far_end(tmp_path) as far:
        assert far.machine is not None
        far.machine.boots = boots
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, READY)
            assert [*far.machine.attempts.values()] == [openings]
            far.device.inject_fault(FaultWindow("unplug"))
            await until_state(era, "COMM_LOST")
            far.device.recover()
            await until_state(era, READY)


async def _conformance(url: str) -> Any:
    async with opened(url) as client:
        return await client.hello()


@pytest.mark.parametrize("action", [actions.identify, actions.status, actions.stop, _conformance])
@pytest.mark.parametrize("wire", SERIAL)
@in_virtual_time
async def test_command_reaches_it(wire: str, action: Callable[[str], Awaitable[Any]]) -> None:
    """Each opens the port for itself; a stop is confirmed as soon as the board has started."""
    async with far_side(WIRES[wire], RIG) as far:
        assert far.machine is not None
        far.machine.boots = 5.0
        began = clock.now()
        found = await action(far.url)
        assert clock.now() - began < 7.0
        assert found.get("silence", "confirmed_silent") == "confirmed_silent"


@pytest.mark.parametrize(("wire", "told_after"), [("serial", 6.0), ("modbus+tcp", 1.5)])
@in_virtual_time
async def test_mute_amplifier_is_told_after_a_time(wire: str, told_after: float) -> None:
    """That of a board that restarts, or three attempts of 0.5 s; the error names the remedy."""
    async with far_side(WIRES[wire], RIG) as far:
        far.device.inject_fault(FaultWindow("hang"))
        began = clock.now()
        with pytest.raises(LinkTimeout) as told:
            await actions.identify(far.url)
        assert clock.now() - began == pytest.approx(told_after, abs=0.6)
        assert ("restarts" in str(told.value)) is (wire == "serial")
