"""Checks that only read."""

from drivers.amplifier import WATCHDOG
from drivers.conformance.bench import Bench, expect
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState


async def identity(bench: Bench) -> None:
    """It identifies itself, in this version of the protocol."""
    who = bench.amplifier.identity
    expect(
        bool(who.vendor and who.serial_number),
        f"vendor and serial number must not be empty, got {who}",
    )
    expect(
        PROTOCOL.version in who.versions,
        f"versions must include {PROTOCOL.version}, got {who.versions}",
    )


async def capabilities(bench: Bench) -> None:
    """It reports usable capabilities and a watchdog range that includes the default."""
    can = bench.can
    expect(1 <= can.channels <= 16, f"channels must be 1 to 16, got {can.channels}")
    expect(
        0 < can.frequency_min < can.frequency_max,
        f"frequency range must not be empty, got {can.frequency_min:g} to {can.frequency_max:g} Hz",
    )
    expect(
        0 < can.level_max <= 1,
        f"highest level must be above 0 and at most 1, got {can.level_max:g}",
    )
    expect(
        can.watchdog_min <= WATCHDOG <= can.watchdog_max,
        f"watchdog range must include 250 ms, got {can.watchdog_min:g} to {can.watchdog_max:g} s",
    )


async def starts_disarmed(bench: Bench) -> None:
    """It is disarmed until it is armed: high voltage off, silent."""
    status = await bench.amplifier.status()
    expect(
        status.state is AmplifierState.SWITCH_ON_DISABLED,
        f"state must be SWITCH_ON_DISABLED, got {status.state.name}",
    )
    expect(not status.high_voltage, "high voltage must be off, got on")
    expect(status.levels == (0.0,) * bench.can.channels, f"levels must be 0, got {status.levels}")


async def reading_changes_nothing(bench: Bench) -> None:
    """It reports its faults, and reading does not change its state."""
    before = await bench.amplifier.status()
    await bench.amplifier.faults()
    await bench.amplifier.heartbeat()
    after = await bench.amplifier.status()
    expect(
        after.state is before.state, f"state must stay {before.state.name}, got {after.state.name}"
    )
