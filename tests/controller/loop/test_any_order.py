"""Touches, arming, stops, cancellations and slow replies in any order: nothing stays vibrating."""

import asyncio
import random
from typing import Any

import pytest

from controller.loop.loop import Controller
from controller.sources.touch import Touch, TouchFrame
from controller_bench import ENABLED, FarEnd, make_bench
from drivers.errors import DriverError
from drivers.host.group import GroupState
from model.vibration.excitation import Tone
from straight_shapes import Shapes
from virtual_loop import in_virtual_time

PAUSES = (0.0, 0.001, 0.004, 0.02, 0.06)
WATCHDOG = 0.25 + 0.005  # s; what an amplifier needs to fall silent by itself


class LossyFarEnd(FarEnd):
    """A simulated amplifier with envelopes and delayed replies, some of them lost."""

    def __init__(self, rng: random.Random, *, loss: float) -> None:
        super().__init__(knots=32)
        self._dice = rng
        self._loss = loss

    def _reply(self, data: bytes) -> None:
        self.is_mute = self._dice.random() < self._loss
        self.delay = self._dice.choice((0.0, 0.001, 0.005, 0.009))
        super()._reply(data)


async def step_at_random(
    controller: Controller, table: Any, rng: random.Random, tasks: list[asyncio.Task[None]]
) -> bool | None:
    """Do one step; return whether a finger is down, None if that has not changed."""
    now = asyncio.get_running_loop().time()
    match rng.choices(["touch", "lift", "ask", "withdraw", "wait"], [9, 5, 4, 1, 2])[0]:
        case "touch":
            era, frequency = rng.choice(("SW", "NE")), rng.choice((110.0, 250.0))
            table.excitation = {era: Tone(frequency, rng.choice((20e-6, 40e-6)))}
            finger = Touch(1, rng.random(), rng.random())
            controller.deliver(TouchFrame("any", now, (finger,)))
            return True
        case "lift":
            controller.deliver(TouchFrame("any", now, ()))
            return False
        case "ask":
            call = getattr(controller, rng.choice(("arm", "arm", "arm", "disarm", "stop", "clear")))
            tasks.append(asyncio.create_task(call()))
        case "withdraw":  # the loop itself is the first; another one takes over from it
            number = rng.randrange(len(tasks))
            tasks[number].cancel()
            if number == 0:
                await asyncio.gather(tasks[0], return_exceptions=True)
                tasks[0] = asyncio.create_task(controller.run())
    return None


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(12))
@in_virtual_time
async def test_controller_never_stays_vibrating_for_any_order_of_events(
    seed: int, loss: float
) -> None:
    """Without loss zero is reached 20 ms after the last lift; after the end in any case.

    A finger that lifts within 5 ms may count for 60 ms, as a tap.
    The end is a close, or a cancelled loop, after which the watchdogs act. No task is left.
    """
    rng = random.Random(seed)
    loop = asyncio.get_running_loop()
    names = ("a", "b")[: rng.choice((1, 2))]
    far_ends = [LossyFarEnd(rng, loss=loss) for _ in names]
    bench = make_bench(*names, far_ends=far_ends, timing=rng.choice((None, Shapes())))
    controller = bench.controller
    await controller.open()
    tasks = [asyncio.create_task(controller.run())]
    down, came, lifted = False, loop.time(), loop.time()
    for _ in range(40):
        was, change = down, await step_at_random(controller, bench.table, rng, tasks)
        down = was if change is None else change
        if down and not was:
            came = loop.time()
        if was and not down:
            lifted = loop.time() if loop.time() > came + 0.0049 else came + 0.060
        await asyncio.sleep(rng.choice(PAUSES))
        if down or loop.time() - lifted < 0.0205 or controller.group_state is not GroupState.ARMED:
            continue
        assert loss or max(max(far_end.levels) for far_end in far_ends) <= 10
    if rng.random() < 0.5:
        await controller.close()
        assert loss or ENABLED not in bench.states()
    tasks[0].cancel()
    await asyncio.sleep(WATCHDOG + 0.15)
    assert max(max(far_end.levels) for far_end in far_ends) == 0
    await controller.close()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        assert not isinstance(ended, BaseException) or isinstance(
            ended, DriverError | asyncio.CancelledError
        )
    assert asyncio.all_tasks() == {asyncio.current_task()}
