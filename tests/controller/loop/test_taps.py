"""A tap whose down and up come in one iteration of the event loop, in virtual time."""

import asyncio

from controller.effects.click import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller_bench import Bench, running
from virtual_loop import in_virtual_time


def _clicking() -> EffectPlayer:
    return EffectPlayer(SurfaceLayout(effects={"click": Click()}, elsewhere="click"))


async def _playing_times(bench: Bench, seconds: float) -> list[float]:
    """Times [s] from now on at which a channel plays, by the millisecond."""
    began = asyncio.get_running_loop().time()
    times = []
    while (now := asyncio.get_running_loop().time()) < began + seconds:
        if any(bench.far_end.levels):
            times.append(now - began)
        await asyncio.sleep(0.001)
    return times


@in_virtual_time
async def test_tap_within_one_iteration_is_felt_as_a_click() -> None:
    """Its 40 ms are played, and silent is the plate 80 ms after the tap."""
    async with running(intent_source=_clicking()) as bench:
        bench.touch((1, 0.5, 0.5))
        bench.touch()
        times = await _playing_times(bench, 0.3)
        assert 0.035 <= times[-1] - times[0] <= 0.055
        assert times[-1] < 0.080
