"""A mute amplifier in the control loop: what is said of it, and what the others do."""

import asyncio

from controller_bench import FINGER, FarEnd, running
from drivers.host.group import GroupState
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_mute_amplifier_is_lost_though_the_finger_was_lifted() -> None:
    """Silence that it does not hear, repeated, does not put off when it must have fallen silent."""
    local = [FarEnd(baud=921_600), FarEnd(baud=921_600)]
    async with running("a", "b", far_ends=local) as bench:
        await bench.hold(FINGER, seconds=0.2)
        bench.far_ends[1].is_deaf = True
        bench.touch()
        await asyncio.sleep(0.6)
        assert bench.reports.lost
        assert bench.controller.group.state is GroupState.LOST
        assert not any(bench.far_ends[0].levels)
