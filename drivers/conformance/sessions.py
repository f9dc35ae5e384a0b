"""Checks of sessions, and of the numbers of stops."""

from drivers.conformance.bench import LONG_WATCHDOG, Bench, expect
from drivers.protocol.messages import AmplifierState


async def sessions(bench: Bench) -> None:
    """It obeys the session that armed it alone: another neither plays nor feeds the watchdog."""
    watchdog = min(LONG_WATCHDOG, bench.can.watchdog_max)
    await bench.arm()
    if not bench.amplifier.carries_sessions:
        return
    own = bench.amplifier.session
    other = own % 65535 + 1
    await bench.amplifier.apply(bench.tones(1.0))
    await bench.amplifier.arm(watchdog, session=own)
    await bench.expect_levels(1.0, why="after the same Arm again")
    bench.amplifier.session = other
    before = await bench.amplifier.status()
    await bench.refused(bench.amplifier.heartbeat(), what="a heartbeat of another session")
    for request in (bench.amplifier.apply, bench.amplifier.stage):
        await bench.refused(request(bench.tones(0.5)), what="a set of another session")
    await bench.refused(bench.amplifier.arm(watchdog, session=other), what="arming by another")
    after = await bench.amplifier.status()
    expect(
        after.watchdog_left <= before.watchdog_left,
        f"watchdog_left must not rise with another session, got {before.watchdog_left:g} s, then "
        f"{after.watchdog_left:g} s",
    )
    bench.amplifier.session = own
    await bench.amplifier.heartbeat()
    await bench.expect_levels(1.0, why="after requests of another session")
    await bench.amplifier.disarm(0.0)
    await bench.refused(bench.amplifier.arm(watchdog, session=own), what="a session that has ended")


async def clear_names_the_stop(bench: Bench) -> None:
    """It numbers stops, and a Clear that names an earlier one acknowledges nothing."""
    await bench.arm()
    first = (await bench.amplifier.stop(0.0)).latch
    second = (await bench.amplifier.stop(0.0)).latch
    following = first % 255 + 1
    expect(second == following != 0, f"latch after {first} must be {following}, got {second}")
    await bench.refused(bench.amplifier.clear(first), what="a Clear of an earlier stop")
    status = await bench.amplifier.status()
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a Clear of another stop")
    status = await bench.amplifier.clear(second)
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")
