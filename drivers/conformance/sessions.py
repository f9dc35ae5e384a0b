"""Checks of sessions, of the numbers of stops, and of the list of faults."""

import asyncio

from drivers import clock
from drivers.conformance.bench import LONG_WATCHDOG, Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import expect
from drivers.protocol.messages import AmplifierState, Fault, Feature

_STATES = "wire-protocol.md#states"


@driving(_STATES, "wire-can.md#network-management")
async def sessions(bench: Bench) -> None:
    """It obeys the session that armed it alone: another neither plays nor feeds the watchdog."""
    amplifier = bench.amplifier
    watchdog = min(LONG_WATCHDOG, bench.can.watchdog_max)
    await bench.arm()
    if not amplifier.carries_sessions:
        return
    own = amplifier.session
    # One that differs in its high byte only, one in its low, and the next.
    others = [one for one in (own ^ 0x0100, own ^ 0x0001, own % 65535 + 1) if one]
    await bench.play(1.0)
    staged = bench.tones(0.75)
    if bench.has(Feature.STAGING):
        await amplifier.stage(staged)
    _, bench.fed = await bench.timed(amplifier.arm(watchdog, session=own))
    await bench.expect_levels(1.0, why="after the same Arm again")
    for other in others:
        amplifier.session = other
        try:
            for name, request in (
                ("a Ping", amplifier.heartbeat),
                ("an Apply", lambda: amplifier.apply(bench.tones(0.5))),
                ("a Stage", lambda: amplifier.stage(bench.tones(0.5))),
                ("a Commit", lambda: amplifier.commit(staged.token)),
                ("an Arm", lambda other=other: amplifier.arm(watchdog, session=other)),
            ):
                await asyncio.sleep(0.01)
                await bench.refused(request(), what=f"{name} of another session")
                bench.expect_not_fed(await bench.sample(), by=f"{name} of another session")
        finally:
            amplifier.session = own
    await bench.beat()
    await bench.expect_levels(1.0, why="after requests of another session")
    await amplifier.disarm(0.0)
    await bench.refused(amplifier.arm(watchdog, session=own), what="a session that has ended")


@driving("wire-protocol.md#clear")
async def clear_names_the_stop(bench: Bench) -> None:
    """It numbers stops, and a Clear that names an earlier one acknowledges nothing."""
    await bench.arm()
    first = (await bench.amplifier.stop(0.0)).latch
    second = (await bench.amplifier.stop(0.0)).latch
    following = first % 255 + 1
    expect(second == following, f"latch after {first}", expected=following, seen=second)
    await bench.refused(bench.amplifier.clear(first), what="a Clear of an earlier stop")
    status = await bench.amplifier.status()
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a Clear of another stop")
    await bench.refused(bench.amplifier.clear(second % 255 + 1), what="a Clear of a stop to come")
    status = await bench.amplifier.clear(second)
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")


@driving("wire-protocol.md#getfaults")
async def fault_list(bench: Bench) -> None:
    """It lists faults newest first with their ages, numbers them, and keeps them once cleared."""
    bench.require(Feature.WATCHDOG)
    before = await bench.amplifier.faults()
    tripped_at = []
    for _ in range(2):
        latch = (await bench.amplifier.status()).latch
        await bench.arm(bench.can.watchdog_min)
        await bench.play(1.0)
        await bench.pause_until(bench.fed.latest + bench.watchdog)
        status = await bench.until(
            lambda status: status.state is AmplifierState.FAULT, what="a watchdog fault", feed=False
        )
        tripped_at.append(bench.fed.earliest + bench.watchdog)
        following = latch % 255 + 1
        expect(status.latch == following, "latch of a fault", expected=following, seen=status.latch)
        await bench.refused(bench.amplifier.clear(latch), what="a Clear of another latch in FAULT")
        await bench.amplifier.clear(status.latch)
        await asyncio.sleep(0.05)
    faults, when = await bench.timed(bench.amplifier.faults())
    names = [one.fault.name for one in faults[:2]]
    expect(
        names == [Fault.WATCHDOG.name] * 2, "newest faults", expected="WATCHDOG twice", seen=names
    )
    ages = [one.age for one in faults]
    expect(ages == sorted(ages), "ages of faults", expected="ascending", seen=ages)
    least = max(2, len(before))  # how many it keeps is its own affair
    expect(len(faults) >= least, "faults", expected=f"at least {least}", seen=len(faults))
    for age, at in zip(ages, reversed(tripped_at), strict=False):
        low, high = when.earliest - at - 0.03, when.latest - at + 0.01 + 4 * bench.exchange_time
        low -= 4 * bench.exchange_time
        expect(
            low <= age <= high + 1e-3 * (clock.now() - at),
            "age of a watchdog fault",
            expected=f"{low:.3f} to {high:.3f} s",
            seen=f"{age:.3f} s",
        )


@driving("wire-protocol.md#event", "wire-can.md#network-management")
async def events(bench: Bench) -> None:
    """It sends events of its changes of state, if it sends any, and no others."""
    heard = []
    before = bench.amplifier.statistics.events
    bench.amplifier.listen(lambda event: heard.append(event.state))
    await bench.arm()
    await bench.play(1.0)
    await bench.amplifier.stop(0.0)
    await bench.amplifier.clear()
    status = (await bench.sample()).status
    await asyncio.sleep(0.05)
    if not bench.has(Feature.EVENTS):
        sent = bench.amplifier.statistics.events - before
        expect(not sent, "events without the feature", expected="none", seen=sent)
        return
    expect(bool(heard), "events of Arm, Stop and Clear", expected="some", seen="none")
    last = heard[-1]
    expect(
        last is status.state, "state of the last event", expected=status.state.name, seen=last.name
    )
