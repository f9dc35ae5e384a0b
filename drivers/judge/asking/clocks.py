"""Checks of its clock: as it is read, moved on by Arm, and steered by Ping."""

import asyncio
from functools import partial

from drivers.judge.asking.check import driving
from drivers.judge.asking.client import expect, expect_equal, require
from drivers.judge.asking.material import Rows, send
from drivers.judge.asking.subject import RATE, Subject
from drivers.judge.outputs import DRIFT
from drivers.protocol.clock import HIGH_STEPS, HIGH_TIME
from drivers.protocol.table import CLOCK_UNKNOWN, QUANTITIES
from registry import clock

_PLACE = "protocol.md#the-clock"
_LOWEST, _HIGHEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_READINGS, _APART = 8, 0.03  # of one state; s between two at most
_MAX_DURATION = 3.0  # s; in which a rate must show
_SHIFTS = 1, 0x4000, 0xC001


def _require_known(subject: Subject) -> None:
    require(subject.can["clock_error"] != CLOCK_UNKNOWN, "it states no clock_error")


async def _expect_steady(subject: Subject) -> None:
    """Require that its clock was where it must be by all that was read of it."""
    await subject.request("GetStatus")
    wrong = f"{1e3 * subject.dating.error:.3g} ms"
    expect_equal(wrong, "0 ms", "by how much readings of its clock contradict each other")


@driving(_PLACE)
async def clock_readings(subject: Subject) -> None:
    """It shows its clock as it is between request and reply, armed or not, for ever on."""
    _require_known(subject)

    async def read() -> None:
        low = set()
        for at in range(_READINGS):
            low.add((await subject.status())["clock"] % HIGH_STEPS)
            await asyncio.sleep(_APART * (at % 7) / 7)
        is_coarse = subject.can["clock_error"] > QUANTITIES["clock_error"].to_wire(HIGH_TIME)
        expect(is_coarse or len(low) > 1, "low word of the clock", expected="any", seen=low)
        await _expect_steady(subject)

    await subject.run([read, subject.arm, subject.one(), read])


@driving(_PLACE)
def clock_shifts(subject: Subject) -> Rows:
    """It moves its clock on by the shift of an Arm, not with the session that it holds."""
    _require_known(subject)
    again = send("Arm", watchdog=subject.can["watchdog_max"], shift=_SHIFTS[1])

    async def shift() -> None:
        for steps in _SHIFTS:
            await subject.arm(shift=steps)
            await subject.run([again, send("Disarm", ramp=0), subject.settle])
            await _expect_steady(subject)

    return [shift]


@driving(_PLACE)
async def clock_rate(subject: Subject) -> None:
    """It runs faster by the rate of a Ping until the next, and by none unless it is armed."""
    _require_known(subject)
    width = max(subject.exchange_time, subject.client.transit)
    duration = max(0.35, 1.5 * width / (_HIGHEST * RATE - DRIFT))
    require(duration <= _MAX_DURATION, "its exchanges are too long to see a rate")

    silence = send("Silence", ramp=0)  # which feeds, and leaves the rate as it is

    async def read() -> None:
        end = clock.now() + duration
        while clock.now() < end:
            await subject.run([silence if subject.is_hungry else send("GetStatus")])
            await asyncio.sleep(_APART / 2)
        await _expect_steady(subject)

    fast, slow = (send("Ping", rate=each) for each in (_HIGHEST, _LOWEST))
    changing_nothing: Rows = (
        *(send("Ping", session=77, rate=_LOWEST, code="WRONG_SESSION"), subject.one()),
        *(silence, send("Arm", watchdog=subject.can["watchdog_max"], shift=1)),
    )
    falls_silent = send("Disarm", ramp=subject.ramp), slow, subject.settle
    trips = subject.starve, subject.shortest_watchdog / 1000, subject.settle, slow
    await subject.run(
        [
            *(subject.arm, fast, *changing_nothing, read, slow, read),
            *(fast, send("Stop", ramp=0), slow, read, subject.clear),
            *(subject.arm, subject.one(), fast, *falls_silent, slow, read),
            *(partial(subject.arm, 0.0), fast, *trips, read),
        ]
    )
