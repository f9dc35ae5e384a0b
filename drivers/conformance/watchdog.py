"""Checks of the watchdog: when it trips, and what feeds it."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from drivers import clock
from drivers.amplifier import WATCHDOG
from drivers.conformance.bench import Bench
from drivers.conformance.cases import settle
from drivers.conformance.check import driving
from drivers.conformance.findings import expect
from drivers.errors import CommandRefused, LinkTimeout
from drivers.guard.channel_state import Interval
from drivers.protocol.messages import AmplifierState, Fault, Feature, Status

_PLACE = "wire-protocol.md#watchdog"
_REACTION = 0.005  # s; of the watchdog, and of its fade each
_ODD = 0.137  # s; a watchdog that no other setting resembles


def _has_tripped(status: Status) -> bool:
    return status.state is not AmplifierState.OPERATION_ENABLED


def _is_in_fault(status: Status) -> bool:
    return status.state is AmplifierState.FAULT and not any(status.levels)


async def expect_trip(bench: Bench, *, why: str) -> None:
    """Require that the watchdog trips in time after it was fed last, and silences all."""
    fed, due = bench.fed, bench.watchdog
    tripped = await bench.time_of(_has_tripped, since=fed, due=due, what=f"watchdog {why}")
    bench.expect_time(f"watchdog {why}", tripped, low=due, high=due + _REACTION)
    silent = await bench.time_of(
        _is_in_fault, since=fed, due=due + 2 * _REACTION, what=f"silence by the watchdog {why}"
    )
    bench.expect_time(
        f"silence by the watchdog {why}",
        Interval(max(silent.earliest, tripped.earliest), silent.latest),
        low=due,
        high=due + 2 * _REACTION,
    )


@driving(_PLACE)
async def watchdog(bench: Bench) -> None:
    """It trips its watchdog when it is due, not before, and latches that."""
    bench.require(Feature.WATCHDOG)
    await bench.arm(bench.can.watchdog_min)
    await bench.play(*(1.0,) * bench.can.channels)
    await expect_trip(bench, why="after an Apply")
    # Some wires report levels and state separately: read once more for the levels in FAULT.
    status = await bench.amplifier.status()
    expect(status.fault is Fault.WATCHDOG, "fault", expected="WATCHDOG", seen=status.fault.name)
    expect(not any(status.levels), "levels in FAULT", expected="0", seen=status.levels)
    expect(not status.high_voltage, "high voltage in FAULT", expected="off", seen="on")
    faults = await bench.amplifier.faults()
    newest = faults[0].fault.name if faults else "none"
    expect(newest == "WATCHDOG", "newest fault", expected="WATCHDOG", seen=newest)
    await bench.amplifier.heartbeat()
    await bench.refused(bench.arm(), what="Arm in FAULT")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an Apply in FAULT")
    status = await bench.amplifier.disarm(0.0)
    bench.expect_state(status, AmplifierState.FAULT, after="Disarm in FAULT")
    status = await bench.amplifier.clear()
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")
    expect(status.fault is Fault.NONE, "fault after Clear", expected="NONE", seen=status.fault.name)


@driving(_PLACE)
async def watchdog_times(bench: Bench) -> None:
    """It takes the watchdog that Arm gives, from the shortest to the longest."""
    bench.require(Feature.WATCHDOG)

    async def trips(requested: float) -> None:
        await bench.arm(requested)
        await bench.play(1.0)
        await expect_trip(bench, why=f"of {bench.watchdog:g} s")

    for requested in (_ODD, WATCHDOG, bench.can.watchdog_max):
        await settle(bench, partial(trips, requested))


@driving(_PLACE)
async def watchdog_without_reading(bench: Bench) -> None:
    """It trips its watchdog also if nothing is sent at all."""
    bench.require(Feature.WATCHDOG)
    await bench.arm(WATCHDOG)
    await bench.play(1.0)
    await bench.pause_until(bench.fed.latest + bench.watchdog + 0.3)
    status = (await bench.sample()).status
    bench.expect_state(status, AmplifierState.FAULT, after="the time of the watchdog")
    faults = await bench.amplifier.faults()
    expect(bool(faults), "faults after the time of the watchdog", expected="some", seen="none")
    age = faults[0].age
    elapsed = clock.now() - bench.fed.latest - bench.watchdog
    expect(
        age >= elapsed - 0.02 - 4 * bench.exchange_time,
        "age of the fault",
        expected=f"at least {elapsed - 0.02 - 4 * bench.exchange_time:.3f} s",
        seen=f"{age:.3f} s",
    )


Call = Callable[[], Awaitable[object]]


async def _ignoring(call: Call) -> None:
    """Make a request that may be refused."""
    with contextlib.suppress(CommandRefused):
        await call()


def _not_feeding(bench: Bench) -> list[tuple[str, Call]]:
    """Make requests that look, or are refused."""
    amplifier = bench.amplifier
    late = bench.tones(0.5, token=amplifier.next_token())
    calls: list[tuple[str, Call]] = [
        ("GetStatus", amplifier.status),
        ("GetFaults", amplifier.faults),
        ("Hello and GetCaps", amplifier.identify),
        ("a Commit of a token that is not staged", lambda: amplifier.commit(late.token)),
        ("a Clear of latch 0", lambda: amplifier.clear(0)),
    ]
    if bench.can.channels < 16:
        larger = bench.wider(channels=bench.can.channels + 1)
        beyond = bench.tones(0.5, guard=larger, first=bench.can.channels)
        calls += [
            ("a refused Apply", lambda: amplifier.apply(beyond)),
            ("a refused Stage", lambda: amplifier.stage(beyond)),
        ]
    return calls


@driving(_PLACE)
async def what_does_not_feed(bench: Bench) -> None:
    """It is not fed by requests that look, nor by refused ones."""
    bench.require(Feature.WATCHDOG)
    await bench.arm()
    old = bench.tones(1.0)
    await bench.play(1.0)
    calls = [*_not_feeding(bench), ("an older token", lambda: bench.amplifier.apply(old))]
    for name, call in calls:
        await bench.beat()
        await asyncio.sleep(_SEEN)
        await _ignoring(call)
        bench.expect_not_fed(await bench.sample(), by=name)


_SEEN = 0.02  # s; that the watchdog runs down before a request that must not fill it


@driving(_PLACE)
async def trips_amid_other_requests(bench: Bench) -> None:
    """It trips its watchdog in time while requests look or are refused."""
    bench.require(Feature.WATCHDOG)

    async def trips(calls: list[Call]) -> None:
        await bench.arm(WATCHDOG)
        await bench.play(1.0)
        await _call_until(bench, calls, bench.fed.latest + 0.8 * bench.watchdog)
        await expect_trip(bench, why="amid requests that do not feed it")

    looking: list[Call] = [bench.amplifier.status]
    for calls in (looking, [call for _, call in _not_feeding(bench)]):
        await settle(bench, partial(trips, calls))


async def _call_until(bench: Bench, calls: Sequence[Call], end: float) -> None:
    while True:
        for call in calls:
            if clock.now() > end:
                return
            try:
                await _ignoring(call)
            except LinkTimeout:
                continue
            await asyncio.sleep(0.002)


@driving(_PLACE)
async def what_feeds(bench: Bench) -> None:
    """It is fed by Arm, Ping, Stage, Commit and Apply, each of which keeps it playing."""
    bench.require(Feature.WATCHDOG)
    amplifier = bench.amplifier
    await bench.arm(WATCHDOG)
    session = amplifier.session

    async def stage_and_note() -> None:
        staged.append(bench.tones(0.75))
        await amplifier.stage(staged[-1])

    staged = [bench.tones(1.0)]
    calls: list[tuple[str, Call]] = [
        ("Apply", lambda: amplifier.apply(staged[0])),
        ("Ping", amplifier.heartbeat),
    ]
    if bench.has(Feature.STAGING):
        calls += [
            ("Stage", stage_and_note),
            ("Commit", lambda: amplifier.commit(staged[-1].token)),
            ("a repeated Commit", lambda: amplifier.commit(staged[-1].token)),
        ]
    if amplifier.carries_sessions:
        calls.append(("the same Arm", lambda: amplifier.arm(bench.watchdog, session=session)))
    for name, call in calls:
        await asyncio.sleep(0.6 * bench.watchdog)
        _, bench.fed = await bench.timed(call())
        bench.expect_fed(await bench.sample(), by=name)
    await asyncio.sleep(0.6 * bench.watchdog)
    status = (await bench.sample()).status
    bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="requests that feed it")
    await expect_trip(bench, why=f"after {calls[-1][0]}")


@driving(_PLACE)
async def watchdog_left(bench: Bench) -> None:
    """It reports the time that is left of the watchdog, as it runs down."""
    bench.require(Feature.WATCHDOG)
    await bench.arm(bench.can.watchdog_max)
    for _ in range(8):
        bench.expect_fed(await bench.sample(), by="waiting")
        await asyncio.sleep(bench.watchdog / 10)
    bench.expect_fed(await bench.beat(), by="a Ping")


@driving("wire-protocol.md#states")
async def arms_again(bench: Bench) -> None:
    """It restarts the watchdog with its new time by the same Arm again, and plays on."""
    bench.require(Feature.WATCHDOG)
    amplifier = bench.amplifier
    await bench.arm()
    await bench.play(1.0)
    session = amplifier.session
    shorter = max(WATCHDOG, bench.can.watchdog_min)
    _, bench.fed = await bench.timed(amplifier.arm(shorter, session=session))
    bench.watchdog = shorter
    await bench.expect_levels(1.0, why="after the same Arm again")
    await expect_trip(bench, why="of the second Arm")
