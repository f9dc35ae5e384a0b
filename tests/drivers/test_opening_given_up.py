"""Abandoned opening of a silent amplifier, over every wire.

In virtual time, so that it can be at any moment between two tries.
"""

import asyncio

import pytest

from drivers.amplifier import Amplifier
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from virtual_loop import run_virtual
from wires import far_side

WIRES = {"serial": Wire("serial"), "modbus+rtu": Wire("modbus-rtu"), "can+slcan": Wire("slcan")}
AT_ONCE = 0.1  # s; one attempt takes 0.5 s


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("how", ["cancelled", "closed"])
def test_opening_ends_at_once_when_abandoned(wire: str, how: str, coarse_rig: Rig) -> None:
    """Cancelled or closed meanwhile."""

    async def give_up(url: str, *, after: float) -> float:
        """Return how long [s] it takes."""
        amplifier = Amplifier(open_backend(url))
        opening = asyncio.create_task(amplifier.open())
        await asyncio.sleep(after)
        assert not opening.done()
        begin = asyncio.get_running_loop().time()
        if how == "cancelled":
            opening.cancel()
        else:
            await amplifier.close()
        await asyncio.gather(opening, return_exceptions=True)
        return asyncio.get_running_loop().time() - begin

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            far.device.inject_fault(FaultWindow("hang"))
            for after in (0.001, 0.3, 0.7, 1.2, 1.4):
                assert await give_up(far.url, after=after) < AT_ONCE

    run_virtual(run())
