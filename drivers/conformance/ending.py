"""Checks of how a vibration ends: stop, disarm, watchdog, valid_for."""

from drivers import clock
from drivers.conformance.bench import LONG_WATCHDOG, Bench, expect
from drivers.protocol.messages import AmplifierState, Fault


async def quick_stop(bench: Bench) -> None:
    """It stops on request, and stays stopped until cleared."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    status = await bench.amplifier.stop(0.0)
    bench.expect_state(status, AmplifierState.QUICK_STOP_ACTIVE, after="a stop")
    expect(not any(status.levels), f"levels after a stop are {status.levels}")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while stopped")
    await bench.refused(bench.arm(), what="arming while stopped")
    status = await bench.amplifier.clear()
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")


async def silence_never_later(bench: Bench) -> None:
    """It lets a further stop shorten the ramp to silence, never extend it."""
    full_ramp = bench.can.ramp_max
    for first, then in ((full_ramp, 0.0), (0.0, full_ramp), (full_ramp / 4, full_ramp)):
        await bench.arm()
        await bench.amplifier.apply(bench.tones(1.0))
        await bench.amplifier.stop(first)
        started_at = clock.now()
        await bench.amplifier.stop(then)
        await bench.until(lambda status: not any(status.levels), what="silence", feed=False)
        due = min(first, then) + full_ramp / 4
        took = clock.now() - started_at
        expect(took <= due, f"silence must come within {due:g} s of both stops, took {took:.3f} s")
        await bench.rest()


async def disarm(bench: Bench) -> None:
    """It falls silent on disarm, then switches the high voltage off."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    await bench.amplifier.disarm(0.01)
    status = await bench.until(
        lambda status: status.state is AmplifierState.SWITCH_ON_DISABLED,
        what="disarming",
        feed=False,
    )
    # Some wires report levels, high voltage and state separately: once more, all after the state.
    status = await bench.amplifier.status()
    expect(not any(status.levels), f"levels after Disarm are {status.levels}")
    expect(not status.high_voltage, "high voltage after Disarm is on")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while disarmed")


async def watchdog(bench: Bench) -> None:
    """It trips its watchdog while the host only reads, and latches that."""
    await bench.amplifier.arm(bench.can.watchdog_min)
    await bench.amplifier.apply(bench.tones(1.0))
    status = await bench.until(
        lambda status: status.state is AmplifierState.FAULT, what="watchdog fault", feed=False
    )
    expect(status.fault is Fault.WATCHDOG, f"the fault is {status.fault.name}")
    # Some wires report levels and state separately: read once more for the levels in FAULT.
    status = await bench.amplifier.status()
    expect(not any(status.levels), f"levels in FAULT are {status.levels}")
    expect(not status.high_voltage, "high voltage in FAULT is on")
    faults = await bench.amplifier.faults()
    expect(
        bool(faults) and faults[0].fault is Fault.WATCHDOG,
        f"faults must begin with WATCHDOG, got {faults}",
    )
    await bench.amplifier.heartbeat()
    await bench.refused(bench.arm(), what="arming in FAULT")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply in FAULT")
    status = await bench.amplifier.clear()
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")


async def heartbeats(bench: Bench) -> None:
    """It keeps playing while heartbeats come, each of which restarts the watchdog."""
    watchdog = min(LONG_WATCHDOG, bench.can.watchdog_max)
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    drained = await bench.until(
        lambda status: status.watchdog_left < watchdog - 0.02,
        what="count-down of the watchdog",
        feed=False,
    )
    filled = await bench.amplifier.heartbeat()
    expect(
        drained.watchdog_left < filled.watchdog_left <= watchdog + 1e-3,
        f"watchdog_left must rise with a heartbeat, got {drained.watchdog_left:g} s before and "
        f"{filled.watchdog_left:g} s after it",
    )
    await bench.expect_levels(1.0, why="playing with heartbeats")


async def valid_for(bench: Bench) -> None:
    """It ends a vibration after valid_for, stays armed, and keeps the staged set."""
    await bench.arm()
    ending, staged = bench.tones(1.0, valid_for=0.05), bench.tones(0.5)
    await bench.amplifier.apply(ending)
    await bench.amplifier.stage(staged)
    status = await bench.until(
        lambda status: not any(status.levels), what="end of a vibration", feed=True
    )
    bench.expect_state(status, AmplifierState.OPERATION_ENABLED, after="valid_for")
    await bench.amplifier.apply(ending)
    await bench.expect_levels(why="ended set applied again")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.5, why="commit of a set staged before another ended")
