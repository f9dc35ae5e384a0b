"""What can be seen without driving anything."""

from drivers.amplifier import WATCHDOG
from drivers.conformance.bench import Bench, expect
from drivers.protocol.messages import AmplifierState


async def identity(bench: Bench) -> None:
    """It says who it is, in the version of the protocol that is spoken here."""
    who = bench.amplifier.identity
    expect(bool(who.vendor and who.serial_number), f"no vendor or no serial number: {who}")
    expect(who.protocol_version == 1, f"protocol version {who.protocol_version}")


async def capabilities(bench: Bench) -> None:
    """It can do something, and has a watchdog that leaves the host time."""
    can = bench.can
    expect(1 <= can.channels <= 16, f"{can.channels} channels")
    expect(0 < can.frequency_min < can.frequency_max, "its range of frequencies is empty")
    expect(0 < can.level_max <= 1, f"its highest level is {can.level_max:g}")
    expect(can.watchdog_min <= WATCHDOG <= can.watchdog_max, "no watchdog of 250 ms is possible")


async def starts_disarmed(bench: Bench) -> None:
    """It is disarmed while nobody has armed it: high voltage off, silent."""
    status = await bench.amplifier.status()
    expect(status.state is AmplifierState.SWITCH_ON_DISABLED, f"its state is {status.state.name}")
    expect(not status.high_voltage, "its high voltage is on")
    expect(status.levels == (0.0,) * bench.can.channels, f"its levels are {status.levels}")


async def looking_on(bench: Bench) -> None:
    """It tells its faults, and stays as it is when it is looked at."""
    before = await bench.amplifier.status()
    await bench.amplifier.faults()
    await bench.amplifier.heartbeat()
    after = await bench.amplifier.status()
    expect(after.state is before.state, f"its state went to {after.state.name}")
