"""Touches, arming, stops, cancellations and slow replies in any order: nothing stays vibrating."""

import asyncio
import random
from typing import Any

import pytest

from controller.group.amplifier_group import GroupState
from controller.loop.loop import Controller
from controller.sources.touch import Touch, TouchFrame
from controller_bench import make_bench
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.errors import DriverError, LinkTimeout
from drivers.protocol.messages import AmplifierState, Reply, Request
from model.vibration.excitation import Tone
from shaped_link import Shapes
from sim.amplifier.amplifier import SimulatedAmplifier
from virtual_loop import in_virtual_time

PAUSES = (0.0, 0.001, 0.004, 0.02, 0.06)
WATCHDOG = 0.25 + 0.005  # s; what an amplifier needs to fall silent by itself


class Link(Backend):
    """A simulated amplifier on the loop's clock with delayed replies, some of them lost."""

    def __init__(self, rng: random.Random, *, loss: float) -> None:
        self.amplifier = SimulatedAmplifier("any", channels=2)
        self._dice = rng
        self._loss = loss
        self._last_sent_at = 0.0

    async def open(self) -> None:
        """Do nothing."""

    async def close(self) -> None:
        """Do nothing."""

    @property
    def last_sent_at(self) -> float:
        """On the loop's clock [s]."""
        return self._last_sent_at

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Obey at once, reply later."""
        self._last_sent_at = asyncio.get_running_loop().time()
        reply = self.amplifier.handle(request, self._last_sent_at)
        if self._dice.random() < self._loss:
            await asyncio.sleep(timeout)
            raise LinkTimeout("the answer was lost")
        await asyncio.sleep(self._dice.choice((0.0, 0.001, 0.005, 0.009)))
        return reply

    def level(self) -> float:
        """The highest level of all channels."""
        now = asyncio.get_running_loop().time()
        self.amplifier.tick(now)
        return max(self.amplifier.status(now).levels)


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
    bench = make_bench(*("a", "b")[: rng.choice((1, 2))])
    links = {name: Link(rng, loss=loss) for name in bench.rig.amplifiers}
    controller = Controller(
        bench.rig,
        bench.table,
        amplifiers={name: Amplifier(link) for name, link in links.items()},
        timing=rng.choice((None, Shapes())),
    )
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
        assert loss or max(link.level() for link in links.values()) < 1e-3
    if rng.random() < 0.5:
        await controller.close()
        states = {link.amplifier.state for link in links.values()}
        assert loss or AmplifierState.OPERATION_ENABLED not in states
    tasks[0].cancel()
    await asyncio.sleep(WATCHDOG + 0.15)
    assert max(link.level() for link in links.values()) == 0
    await controller.close()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        assert not isinstance(ended, BaseException) or isinstance(
            ended, DriverError | asyncio.CancelledError
        )
    assert asyncio.all_tasks() == {asyncio.current_task()}
