"""Checks of its clock: as it is read, moved on by Arm, and steered by Ping."""

import asyncio
from functools import partial

from drivers.protocol.definition import CLOCK_UNKNOWN, HIGH_STEPS, HIGH_TIME, QUANTITIES
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import Rows, Untimed, Violation, expect, require, send
from era_haptics.lab.conformance.subject import RATE, Subject
from era_haptics.lab.expected_output import DRIFT
from registry import threads

_PLACE = "protocol.md#the-clock"
_LOWEST, _HIGHEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_READINGS, _APART = 8, 0.03  # of one state; s between two at most
_MAX_DURATION = 8.0  # s; in which a rate must show
_LASTING, _QUICK = 1.5, 0.01  # s; of a layer, whose end shows a wrong rate; for an exchange
_SHIFTS = 1, 0x4000, 0xC001


def _require_known(subject: Subject) -> None:
    require(subject.can["clock_error"] != CLOCK_UNKNOWN, "it states no clock_error")


async def _expect_steady(subject: Subject, otherwise: type[Violation] = Violation) -> None:
    """Require that its clock was where it must be by all that was read of it."""
    await subject.request("GetStatus")
    if (wrong := f"{1e3 * subject.dating.error:.3g} ms") != "0 ms":
        what = "by how much readings of its clock contradict each other"
        raise otherwise(what, expected="0 ms", seen=wrong)


async def _read(subject: Subject, otherwise: type[Violation] = Violation) -> None:
    low = set()
    for at in range(_READINGS):
        low.add((await subject.status())["clock"] % HIGH_STEPS)
        await asyncio.sleep(_APART * (at % 7) / 7)
    await _expect_steady(subject, otherwise)
    is_coarse = subject.can["clock_error"] > QUANTITIES["clock_error"].to_wire(HIGH_TIME)
    expect(is_coarse or len(low) > 1, "low word of the clock", expected="any", seen=low)


@reading(_PLACE)
async def clock_goes_on(subject: Subject) -> None:
    """It shows a clock that goes on by the time between two statuses: all else rests on that."""
    _require_known(subject)
    await _read(subject, Untimed)


@driving(_PLACE)
def clock_readings(subject: Subject) -> Rows:
    """It shows its clock as it is between request and reply, armed too, for ever on."""
    _require_known(subject)
    return [subject.arm, subject.one(), partial(_read, subject)]


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
    await subject.request("GetStatus")  # whose exchanges all rests on
    duration = max(0.35, 1.5 * subject.read_time / (_HIGHEST * RATE - DRIFT))
    require(duration <= _MAX_DURATION, "its exchanges are too long to see a rate")

    lasting = _LASTING if subject.exchange_time <= _QUICK else duration / 2  # s; not of the clock
    timed = subject.one(valid_for=round(1000 * lasting), ramp=subject.ramp)

    async def read(duration: float = duration) -> None:
        end = threads.now() + duration
        while threads.now() < end:  # a Commit feeds, and leaves the rate as it is
            again = send("Commit", token=subject.token)
            await subject.run([again if subject.is_hungry else send("GetStatus")])
            await asyncio.sleep(_APART / 2)
        await _expect_steady(subject)

    fast, slow = (send("Ping", rate=each) for each in (_HIGHEST, _LOWEST))
    changing_nothing: Rows = (
        *(send("Ping", session=77, rate=_LOWEST, code="WRONG_SESSION"), send("Silence", ramp=0)),
        *(send("Arm", watchdog=subject.can["watchdog_max"], shift=1), timed),
    )
    falls_silent = send("Disarm", ramp=subject.ramp), slow, subject.settle
    trips = subject.starve, subject.shortest_watchdog / 1000, subject.settle, slow
    await subject.run(
        [
            *(subject.arm, fast, *changing_nothing, partial(read, lasting + duration), slow, read),
            *(fast, send("Stop", ramp=0), slow, read, subject.clear),
            *(subject.arm, subject.one(), fast, *falls_silent, slow, read),
            *(partial(subject.arm, 0.0), fast, *trips, read),
        ]
    )
