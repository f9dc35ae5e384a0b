"""Effects through the control loop, in virtual time: what the amplifier receives, and when."""

import asyncio

import pytest

from controller.effects.click import Click
from controller.effects.layout import Layout
from controller.effects.player import EffectPlayer
from controller_bench import FINGER, running
from virtual_loop import in_virtual_time


@pytest.mark.parametrize("duration", [0.020, 0.040, 0.065])
@in_virtual_time
async def test_click_ends_on_time_when_the_finger_rests(duration: float) -> None:
    """Silence is sent within a millisecond of its end, not with the next heartbeat."""
    layout = Layout(effects={"click": Click(duration=duration)}, elsewhere="click")
    async with running(intent_source=EffectPlayer(layout)) as bench:
        loop = asyncio.get_running_loop()
        bench.touch(FINGER)
        begin = loop.time()
        await asyncio.sleep(duration - 0.001)
        _, played = bench.far_end.sets()  # the first is the silence with which it is armed
        assert any(command.level for command in played.commands)
        await asyncio.sleep(0.002)
        assert loop.time() - begin == pytest.approx(duration + 0.001)
        *_, silent = bench.far_end.sets()
        assert not any(command.level for command in silent.commands)
