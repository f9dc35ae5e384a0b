"""Sets that the amplifier refused: they never play, and nothing of them stays with the host."""

import asyncio
import math
import sys
from dataclasses import replace
from types import FrameType

import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Apply, Nak, NakCode, Reply, Request, Stage
from lossy_backend import LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from virtual_loop import in_virtual_time

LIMITS = GuardLimits(40.0, 500.0, 1.0, slew=50.0, on_time=2.0)


class RefusingBackend(LossyBackend):
    """Refuses sets of the kinds in `refused`."""

    refused: tuple[type[Request], ...] = ()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Exchange a request, unless it is refused."""
        if isinstance(request, self.refused):
            return Nak(NakCode.WRONG_SESSION)
        return await super().exchange(request, timeout=timeout)


def checked(guard: Guard, token: int, frequency: float = 110.0) -> SafeCommandSet:
    """Check a set of one tone."""
    return guard.check(
        CommandSet(token, (DriveCommand(0, frequency, 0.5),), ramp=0.05, valid_for=0.0)
    )


@in_virtual_time
async def test_thousandth_refusal_costs_as_the_first() -> None:
    """Calls of Python from check to refusal, by Apply, and by Stage beside one that is staged."""
    backend = RefusingBackend(SimulatedAmplifier("main", channels=4))
    amplifier = Amplifier(backend)
    await amplifier.open()
    await amplifier.arm(2.0)
    guard = Guard(replace(LIMITS, on_time=math.inf), amplifier.capabilities)
    calls = 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    async def refused(number: int, *, is_counted: bool = True) -> int:
        nonlocal calls
        backend.refused = (Apply,)
        before = calls
        sys.setprofile(count if is_counted else None)
        with pytest.raises(CommandRefused):
            await amplifier.apply(checked(guard, 2 * number + 1, 100.0 + number % 7))
        await amplifier.stage(checked(guard, 2 * number + 2))
        sys.setprofile(None)
        return calls - before

    await refused(0)
    early = await refused(1)
    for number in range(2, 999):
        await refused(number, is_counted=False)
    assert await refused(999) <= 1.05 * early


@pytest.mark.parametrize("kind", [Apply, Stage])
@in_virtual_time
async def test_refused_set_spends_no_time_of_vibration(kind: type[Request]) -> None:
    """A second after 1.9 s of vibration were refused, the next set may last as long."""
    backend = RefusingBackend(SimulatedAmplifier("main", channels=4))
    amplifier = Amplifier(backend)
    await amplifier.open()
    await amplifier.arm(2.0)
    guard = Guard(LIMITS, amplifier.capabilities)
    first = checked(guard, 1)
    assert 1.5 < first.valid_for < 2.0
    backend.refused = (kind,)
    with pytest.raises(CommandRefused):
        await (amplifier.apply(first) if kind is Apply else amplifier.stage(first))
    backend.refused = ()
    await asyncio.sleep(1.0)
    assert played_by(checked(guard, 2)) == played_by(first)
    await amplifier.apply(checked(guard, 3))


def played_by(safe: SafeCommandSet) -> CommandSet:
    """What a set plays, whatever its token."""
    return CommandSet(0, safe.commands, ramp=safe.ramp, valid_for=safe.valid_for)
