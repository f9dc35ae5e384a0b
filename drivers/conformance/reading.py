"""Checks that only read."""

from drivers.amplifier import WATCHDOG
from drivers.conformance.bench import Bench
from drivers.conformance.check import reading
from drivers.conformance.findings import expect
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState


@reading("wire-protocol.md#hello")
async def identity(bench: Bench) -> None:
    """It identifies itself, in this version of the protocol, and the same again."""
    who = bench.amplifier.identity
    expect(
        bool(who.vendor and who.serial_number),
        "vendor and serial number",
        expected="texts",
        seen=(who.vendor, who.serial_number),
    )
    expect(
        PROTOCOL.version in who.versions,
        "versions",
        expected=f"with {PROTOCOL.version}",
        seen=who.versions,
    )
    await bench.amplifier.identify()
    expect(bench.amplifier.identity == who, "identity", expected=who, seen=bench.amplifier.identity)


@reading("wire-protocol.md#getcaps")
async def capabilities(bench: Bench) -> None:
    """It reports usable capabilities, always the same, with 250 ms in the watchdog's range."""
    can, steps = bench.can, PROTOCOL.quantities
    bounds = (
        ("channels", can.channels, 1, steps.channel_count.maximum),
        ("frequency_min", can.frequency_min, 0, can.frequency_max),
        ("frequency_step", can.frequency_step, steps.frequency.step, can.frequency_max),
        ("level_max", can.level_max, steps.level.step, 1.0),
        ("level_step", can.level_step, steps.level.step, can.level_max),
        ("ramp_max", can.ramp_max, 0, steps.ramp.high),
        ("watchdog_min", can.watchdog_min, steps.watchdog.low, WATCHDOG),
        ("watchdog_max", can.watchdog_max, WATCHDOG, steps.watchdog.high),
        ("envelope_step_min", can.envelope_step_min, 0, can.envelope_step_max),
    )
    for name, value, low, high in bounds:
        is_within = low - 1e-9 <= value <= high + 1e-9
        expect(is_within, name, expected=f"{low:g} to {high:g}", seen=f"{value:g}")
    expect(can.frequency_max > 0, "frequency_max", expected="above 0", seen=can.frequency_max)
    expect(
        bool(can.envelope_knots) == bool(can.envelope_slots),
        "envelope knots and slots",
        expected="both or neither",
        seen=(can.envelope_knots, can.envelope_slots),
    )
    await bench.amplifier.identify()
    again = bench.amplifier.capabilities
    expect(again == can, "capabilities", expected=can, seen=again)


@reading("wire-protocol.md#states")
async def starts_disarmed(bench: Bench) -> None:
    """It is disarmed until it is armed: high voltage off, silent."""
    status = await bench.amplifier.status()
    off = AmplifierState.SWITCH_ON_DISABLED
    expect(status.state is off, "state", expected=off.name, seen=status.state.name)
    expect(not status.high_voltage, "high voltage", expected="off", seen="on")
    silent = (0.0,) * bench.can.channels
    expect(status.levels == silent, "levels", expected=silent, seen=status.levels)
    expect(not status.watchdog_left, "watchdog_left", expected=0, seen=status.watchdog_left)


@reading("wire-protocol.md#states")
async def reading_changes_nothing(bench: Bench) -> None:
    """It reports its faults, and reading does not change its state."""
    before = await bench.amplifier.status()
    await bench.amplifier.faults()
    await bench.amplifier.heartbeat()
    after = await bench.amplifier.status()
    expect(after.state is before.state, "state", expected=before.state.name, seen=after.state.name)


@reading("wire-protocol.md#the-frame", "wire-modbus.md#the-line", "wire-can.md#orders-and-answers")
async def replies_in_time(bench: Bench) -> None:
    """It begins every reply within 10 ms, beside the time on the wire."""
    on_wire = bench.amplifier.round_trip()
    for name, call in (
        ("GetStatus", bench.amplifier.status),
        ("GetFaults", bench.amplifier.faults),
        ("Ping", bench.amplifier.heartbeat),
    ):
        durations = []
        for _ in range(_TRIES):
            _, when = await bench.timed(call())
            durations.append(when.latest - when.earliest)
        limit = PROTOCOL.reaction + on_wire + _ADAPTERS
        typical = sorted(durations)[_TRIES // 2]
        expect(
            typical <= limit,
            f"reply to {name}",
            expected=f"within {limit * 1e3:.1f} ms, {_ADAPTERS * 1e3:g} ms of which for adapters",
            seen=f"{typical * 1e3:.1f} ms",
        )


_TRIES = 9
_ADAPTERS = 0.008  # s; USB adapters, operating systems and networks, both ways
