"""Effects through the control loop, in virtual time: what the amplifier receives, and when."""

import asyncio

import pytest

from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.effect import Effect, EffectRun, NoSensation, Sensation
from controller.effects.layout import Layout
from controller.effects.player import EffectPlayer
from controller.sources.contacts import Contact
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


@in_virtual_time
async def test_failing_effect_is_silent_until_it_recovers() -> None:
    """Touches are felt again once the plug-in does not raise."""

    class Broken(Effect):
        """Raises at the second call."""

        kind = "broken"
        is_for_motion = False

        def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
            return Breaking()

    class Breaking(EffectRun):
        looks = 0

        def feel(self, contact: Contact, now: float) -> Sensation | NoSensation | None:
            self.looks += 1
            if self.looks > 1:
                raise ZeroDivisionError("in a plug-in")
            return Sensation(20.0, until=now + 0.03)

    layout = Layout(effects={"broken": Broken(), "buzz": Buzz()}, elsewhere="broken")
    player = EffectPlayer(layout)
    async with running(intent_source=player) as bench:
        await bench.hold(FINGER, seconds=0.2)
        _, played, silent = bench.far_end.sets()
        assert any(command.level for command in played.commands)
        assert not any(command.level for command in silent.commands)
        assert "ZeroDivisionError" in bench.reports.silenced[-1].reason
        bench.touch()
        await asyncio.sleep(0.01)
        player.layout = Layout(effects=layout.effects, elsewhere="buzz")
        await bench.hold(FINGER, seconds=0.2)
        assert any(command.level for command in bench.far_end.sets()[-1].commands)
