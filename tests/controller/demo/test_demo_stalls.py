"""The demonstration on a machine that stalls for longer than the watchdog, in virtual time."""

import asyncio
import contextlib

from controller.demo.run import keep_armed, noting_refusals
from controller.loop.observer import Observer
from controller_bench import ENABLED, running
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_amplifiers_are_armed_again_after_a_stall() -> None:
    """One whose watchdog has expired is in FAULT; the next touch is played all the same."""
    refused = asyncio.Event()
    recovered: list[float] = []
    async with running(observer=noting_refusals(Observer(), refused)) as bench:
        clock = asyncio.get_running_loop().time
        arming = asyncio.create_task(
            keep_armed(bench.controller, refused, recovered=lambda: recovered.append(clock()))
        )
        bench.far_end.amplifier.tick(clock() + 3.0)
        assert bench.far_end.state == "FAULT"
        await asyncio.sleep(1.0)
        assert bench.far_end.state == ENABLED
        assert len(recovered) == 1
        bench.touch((1, 0.5, 0.5))
        await asyncio.sleep(0.05)
        assert any(bench.far_end.levels)
        arming.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await arming
