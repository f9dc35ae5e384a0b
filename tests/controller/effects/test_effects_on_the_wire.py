"""Effects through the control loop, in virtual time: what the amplifier receives, and when."""

import asyncio
import logging

import pytest

from controller.effects.click import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.sources.reject_counter import RejectCounter
from controller.sources.tuio import TuioReader
from controller_bench import FINGER, running
from tuio_reference_sender import ReferenceSender
from virtual_loop import in_virtual_time


@pytest.mark.parametrize("duration", [0.020, 0.040, 0.065])
@in_virtual_time
async def test_click_ends_on_time_when_the_finger_rests(duration: float) -> None:
    """Silence is sent within a millisecond of its end, not with the next heartbeat."""
    layout = SurfaceLayout(effects={"click": Click(duration=duration)}, elsewhere="click")
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


@in_virtual_time
async def test_resting_finger_of_a_silent_sender_feels_one_click() -> None:
    """The reference sender says nothing for two seconds; its next bundle is no new press."""
    layout = SurfaceLayout(effects={"click": Click()}, elsewhere="click")
    sender, reader = ReferenceSender(), TuioReader(RejectCounter(logging.getLogger("test")))
    async with running(intent_source=EffectPlayer(layout)) as bench:
        loop = asyncio.get_running_loop()
        begin = loop.time()
        while (now := loop.time() - begin) < 3.0:
            datagram = sender.frame({7: (0.5 if now < 2.5 else 0.51, 0.5)}, now)
            frame = datagram and reader.read(datagram, ("127.0.0.1", 40000), now=loop.time())
            if frame:
                bench.controller.deliver(frame)
            await asyncio.sleep(0.02)
        assert [is_silent for is_silent in bench.silences() if not is_silent] == [False]
        assert bench.reports.contacts[-1] == 1
