"""Checks of the clock: read, shifted by Arm, steered by Ping, marked by Mark."""

import asyncio
from functools import partial

from drivers.protocol.definition import (
    CLOCK_UNKNOWN,
    HIGH_STEPS,
    HIGH_TIME,
    MESSAGES,
    QUANTITIES,
    REACTION,
)
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judged_exchange import RATE_STEP
from era_haptics.lab.conformance.outcomes import (
    ContractViolation,
    UntimedClock,
    expect_equal,
    require,
    verify,
)
from era_haptics.lab.conformance.request_rows import (
    DISARM_NOW,
    SILENCE_NOW,
    STOP_NOW,
    RequestRows,
    Wait,
    commit,
    send,
)
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expectations.tolerances import DRIFT, Interval
from registry import threads

_LOWEST, _HIGHEST = QUANTITIES["rate"].minimum, QUANTITIES["rate"].maximum
_READINGS, _SPACING = 8, 0.03  # readings of one state; s, longest time between two of them
_MAX_DURATION = 8.0  # s; in which a rate must show
_LAYER_TIME = 1.5  # s; of a layer, whose end shows a wrong rate
_QUICK = 0.01  # s; exchange time for such a layer
_SHIFTS = 1, 0x4000, 0xC001
_MARKED = 0.1  # s; from a Mark until it is read
_NO_CLOCK_ERROR = (
    "clock_error is 65535, unknown; measure the largest error of a clock reading and state it in "
    "the capabilities"
)


def _require_clock(subject: Subject) -> None:
    is_known = subject.can["clock_error"] != CLOCK_UNKNOWN
    require(is_known, _NO_CLOCK_ERROR)


async def _expect_advancing(
    subject: Subject, violation: type[ContractViolation] = ContractViolation
) -> None:
    """Read the clock a few times; raise a violation unless it follows time."""
    low_words = set()
    for number in range(_READINGS):
        status = await subject.status()
        low_words.add(status["clock"] % HIGH_STEPS)
        await asyncio.sleep(_SPACING * (number % 7) / 7)
    await subject.request("GetStatus")
    subject.dating.expect_steady(violation)
    is_coarse = subject.can["clock_error"] > QUANTITIES["clock_error"].to_wire(HIGH_TIME)
    is_changing = is_coarse or len(low_words) > 1
    verify(is_changing, "low words of the clock", expected="several values", actual=low_words)


@reading("protocol.md#the-clock")
async def clock_goes_on(subject: Subject) -> None:
    """Two GetStatus: the clock advances by the time between them.

    Derive the clock from the sample count, and add the time since the last sample by a timer.
    Nothing is driven until this check passes, because all times are judged by this clock.
    """
    _require_clock(subject)
    await _expect_advancing(subject, UntimedClock)


@driving("protocol.md#the-clock")
def clock_readings(subject: Subject) -> RequestRows:
    """Status while armed: its clock was read between the request and the reply.

    Read the clock when you build the reply, between samples too, without a constant or growing
    error above clock_error.
    """
    _require_clock(subject)
    return [subject.arm, subject.layer_0(), partial(_expect_advancing, subject)]


@driving("protocol.md#the-clock")
def clock_shifts(subject: Subject) -> RequestRows:
    """Arm with a shift: the clock moves by this shift; with the session held: no shift.

    Add shift times 65536 to the clock, modulo 2^32, before you build the reply, and only if the
    session is new.
    """
    _require_clock(subject)
    return [partial(_expect_shift, subject, steps) for steps in _SHIFTS]


async def _expect_shift(subject: Subject, steps: int) -> None:
    """Arm with a shift, then again with the session held."""
    await subject.arm(shift=steps)
    same_session = send("Arm", watchdog=subject.can["watchdog_max"], shift=_SHIFTS[1])
    await subject.run([same_session, DISARM_NOW, subject.settle])
    await subject.request("GetStatus")
    subject.dating.expect_steady()


@driving("protocol.md#the-clock")
async def clock_rate(subject: Subject) -> None:
    """Ping with a rate: the clock keeps this rate until the next Ping; unarmed: rate 0.

    Scale the increment of the clock only. Times such as valid_for, ramps and the watchdog stay real
    time; leaving OPERATION_ENABLED resets the rate.
    """
    _require_clock(subject)
    await subject.request("GetStatus")  # whose duration determines how soon a rate shows
    visible_change = _HIGHEST * RATE_STEP - DRIFT
    duration = max(0.35, 1.5 * subject.timing.read_time / visible_change)
    require(duration <= _MAX_DURATION, "the line is too slow to observe the rate")
    layer_time = _LAYER_TIME if subject.timing.exchange_time <= _QUICK else duration / 2
    timed = subject.layer_0(valid_for=round(1000 * layer_time), ramp=subject.ramp)
    fast, slow = (send("Ping", rate=rate) for rate in (_HIGHEST, _LOWEST))
    read = partial(_expect_rate, subject, duration)
    keeps_rate: RequestRows = [
        send("Ping", session=77, rate=_LOWEST, code="WRONG_SESSION"),
        SILENCE_NOW,
        send("Arm", watchdog=subject.can["watchdog_max"], shift=1),
        timed,
        partial(_expect_rate, subject, layer_time + duration),
    ]
    stops: RequestRows = [fast, STOP_NOW, slow, read, subject.clear]
    disarm = send("Disarm", ramp=subject.ramp)
    disarms: RequestRows = [fast, disarm, slow, subject.settle, slow, read]
    until_trip = Wait(subject.shortest_watchdog / 1000)
    trips: RequestRows = [fast, subject.feeding.starve, until_trip, subject.settle, slow, read]
    await subject.run([subject.arm, fast, *keeps_rate, slow, read, *stops])
    await subject.run([subject.arm, subject.layer_0(), *disarms])
    await subject.run([partial(subject.arm, 0.0), *trips])


async def _expect_rate(subject: Subject, duration: float) -> None:
    """Read statuses for a time [s]; raise ContractViolation if they contradict the rate."""
    end = threads.now() + duration
    while threads.now() < end:
        row = send("GetStatus")
        if subject.feeding.is_due:  # a Commit feeds, and leaves the rate as it is
            row = commit(subject.sets.token)
        await subject.run([row])
        await asyncio.sleep(_SPACING / 2)
    await subject.request("GetStatus")
    subject.dating.expect_steady()


@driving("protocol.md#the-clock")
async def mark(subject: Subject) -> None:
    """Mark: the next Status shows the clock of the Mark, the following one the current clock.

    Store the clock in the interrupt of the last byte of the Mark, show it in one Status, then
    discard it.
    """
    subject.require("mark")
    client = subject.client
    if client.has_broadcasts:
        await client.look_around()
    await subject.run([subject.arm, send("Mark"), send("Mark"), Wait(0.1)])
    if client.has_broadcasts and not client.neighbors:
        sent_at = threads.now()
        client.write(client.request(MESSAGES["Mark"].number, (), to=0))
        written_at = threads.now()
        await asyncio.sleep(_MARKED)
        received_by = written_at + REACTION + client.transit
        when = subject.dating.interval(Interval(sent_at, received_by))
        subject.judge.carry_out("Mark", {}, {}, when)
        await subject.run([subject.ping, subject.status])
        expect_equal(len(client.inbox), 0, "number of replies to a broadcast Mark")
