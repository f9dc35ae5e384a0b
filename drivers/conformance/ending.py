"""How a vibration ends: by a stop, by itself, by the watchdog."""

from drivers.conformance.bench import CALM, Bench, expect
from drivers.protocol.messages import AmplifierState, Fault


async def quick_stop(bench: Bench) -> None:
    """It stops when it is told, and stays stopped until that is cleared."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    status = await bench.amplifier.stop(0.0)
    expect(
        status.state is AmplifierState.QUICK_STOP_ACTIVE, f"stopped it is in {status.state.name}"
    )
    expect(not any(status.levels), f"stopped its levels are {status.levels}")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while stopped")
    await bench.refused(bench.arm(), what="arming while stopped")
    status = await bench.amplifier.clear()
    expect(
        status.state is AmplifierState.SWITCH_ON_DISABLED, f"cleared it is in {status.state.name}"
    )


async def disarm(bench: Bench) -> None:
    """It falls silent when it is disarmed, then takes the high voltage away."""
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    await bench.amplifier.disarm(0.01)
    status = await bench.until(
        lambda status: status.state is AmplifierState.SWITCH_ON_DISABLED,
        what="disarming",
        feed=False,
    )
    expect(not any(status.levels), f"disarmed its levels are {status.levels}")
    expect(not status.high_voltage, "disarmed its high voltage is on")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply while disarmed")


async def watchdog(bench: Bench) -> None:
    """It trips its watchdog while the host only looks on, and latches that."""
    await bench.amplifier.arm(bench.can.watchdog_min)
    await bench.amplifier.apply(bench.tones(1.0))
    status = await bench.until(
        lambda status: status.state is AmplifierState.FAULT, what="the watchdog's fault", feed=False
    )
    expect(status.fault is Fault.WATCHDOG, f"the fault is {status.fault.name}")
    # Some wires tell levels and state apart: those of a moment later are the levels in FAULT.
    status = await bench.amplifier.status()
    expect(not any(status.levels), f"in FAULT its levels are {status.levels}")
    expect(not status.high_voltage, "in FAULT its high voltage is on")
    faults = await bench.amplifier.faults()
    expect(bool(faults) and faults[0].fault is Fault.WATCHDOG, f"its faults are {faults}")
    await bench.amplifier.heartbeat()
    await bench.refused(bench.arm(), what="arming in FAULT")
    await bench.refused(bench.amplifier.apply(bench.tones(1.0)), what="an apply in FAULT")
    status = await bench.amplifier.clear()
    expect(
        status.state is AmplifierState.SWITCH_ON_DISABLED, f"cleared it is in {status.state.name}"
    )


async def heartbeats(bench: Bench) -> None:
    """It plays on while heartbeats come, each of which fills the watchdog."""
    watchdog = min(CALM, bench.can.watchdog_max)
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    drained = await bench.until(
        lambda status: status.watchdog_left < watchdog - 0.02, what="a watchdog's count", feed=False
    )
    filled = await bench.amplifier.heartbeat()
    expect(
        drained.watchdog_left < filled.watchdog_left <= watchdog + 1e-3,
        f"the watchdog was at {drained.watchdog_left:g} s, after a heartbeat at "
        f"{filled.watchdog_left:g} s",
    )
    await bench.expect_levels(1.0, why="with heartbeats it plays on")


async def valid_for(bench: Bench) -> None:
    """It ends a vibration by itself after valid_for, stays armed, and keeps what is staged."""
    await bench.arm()
    ending, staged = bench.tones(1.0, valid_for=0.05), bench.tones(0.5)
    await bench.amplifier.apply(ending)
    await bench.amplifier.stage(staged)
    status = await bench.until(
        lambda status: not any(status.levels), what="the end of a vibration", feed=True
    )
    expect(status.state is AmplifierState.OPERATION_ENABLED, f"then it is in {status.state.name}")
    await bench.amplifier.apply(ending)
    await bench.expect_levels(why="a set that has ended was applied again")
    await bench.amplifier.commit(staged.token)
    await bench.expect_levels(0.5, why="a set was committed that was staged before another ended")
