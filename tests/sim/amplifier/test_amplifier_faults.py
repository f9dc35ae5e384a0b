"""Warmth, high voltage, faults and restarts of the simulated amplifier, on a virtual clock."""

import math

import pytest

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Disarm,
    Fault,
    FaultList,
    FaultRecord,
    GetFaults,
    LoadEnvelope,
    Nak,
    NakCode,
)
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.amplifier.thermal_model import ThermalState


def playing(token: int, level: float) -> CommandSet:
    """Every channel at 110 Hz."""
    commands = tuple(DriveCommand(channel, 110.0, level) for channel in range(4))
    return CommandSet(token, commands, ramp=0.0, valid_for=0.0)


def armed() -> SimulatedAmplifier:
    """Four channels, enabled and silent."""
    amplifier = SimulatedAmplifier("main", channels=4)
    amplifier.handle(Arm(2.0), 0.0)
    return amplifier


@pytest.mark.parametrize(("level", "rise"), [(1.0, 30.0), (0.5, 7.5)])
def test_temperature_follows_the_load(level: float, rise: float) -> None:
    """First order with 120 s: 30 K at full stroke, a quarter at half, 25 °C when silent."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, level)), 0.0)
    assert amplifier.status(0.0).temperature == 25.0
    warm = 25 + rise * (1 - math.exp(-1 / 120))
    assert amplifier.status(1.0).temperature == pytest.approx(warm, abs=1e-9)
    amplifier.handle(Disarm(0.0), 1.0)
    cooler = amplifier.status(121.0).temperature
    assert cooler - 25 == pytest.approx((warm - 25) * math.exp(-1), rel=1e-9)


def test_temperature_derates_above_70_and_trips_above_85() -> None:
    """Half of the level, in Achieved too; then silent in 5 ms, latched until cool."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8)), 0.0)
    amplifier.set_temperature(71.0, 1.0)
    assert amplifier.status(1.02).levels == pytest.approx((0.4,) * 4)
    assert amplifier.state is AmplifierState.OPERATION_ENABLED
    reply = amplifier.handle(Apply(playing(2, 0.6)), 1.1)
    assert isinstance(reply, Achieved)
    assert reply.commands[0].level == pytest.approx(0.3)
    assert amplifier.status(1.1).levels == pytest.approx((0.3,) * 4)
    amplifier.set_temperature(86.0, 1.2)
    amplifier.tick(1.2051)
    now = amplifier.status(1.2051)
    assert (now.state, now.fault, now.high_voltage) == (
        AmplifierState.FAULT,
        Fault.OVER_TEMPERATURE,
        False,
    )
    assert now.levels == (0.0,) * 4
    amplifier.handle(Clear(1), 1.3)
    assert amplifier.state is AmplifierState.FAULT
    amplifier.set_temperature(25.0, 1.4)
    amplifier.handle(Clear(1), 1.4)
    assert amplifier.state is AmplifierState.SWITCH_ON_DISABLED
    amplifier.handle(Arm(2.0), 1.5)
    reply = amplifier.handle(Apply(playing(3, 0.6)), 1.5)
    assert isinstance(reply, Achieved)
    assert reply.commands[0].level == 0.6


@pytest.mark.parametrize("threshold", [70.0, 85.0])
def test_temperature_crosses_a_threshold_at_its_time(threshold: float) -> None:
    """From 64 °C in a place of 90 °C; one that is not on the way is never reached."""
    heat = ThermalState(since=3.0, temperature=64.0, final=90.0)
    assert heat.when(threshold) == pytest.approx(3 + 120 * math.log(26 / (90 - threshold)))
    assert heat.when(95.0) == math.inf
    assert heat.when(60.0) == math.inf


def test_high_voltage_is_on_while_armed_and_discharges() -> None:
    """1800 V; 1800/e after 20 ms without it."""
    amplifier = armed()
    assert amplifier.status(0.1).voltage == 1800.0
    amplifier.handle(Disarm(0.0), 1.0)
    assert amplifier.status(1.02).voltage == round(1800 / math.e)
    assert amplifier.status(2.0).voltage == 0.0
    assert SimulatedAmplifier("main", channels=1).status(0.0).voltage == 0.0


@pytest.mark.parametrize(
    "fault", [Fault.OVER_VOLTAGE, Fault.ARC, Fault.OVER_CURRENT, Fault.CHANNEL]
)
def test_fault_silences_and_latches(fault: Fault) -> None:
    """Silent within 5 ms, high voltage off, recorded with its channel; listeners in order."""
    amplifier = armed()
    events: list[tuple[AmplifierEvent, float]] = []
    amplifier.listeners.append(lambda event, time: events.append((event, time)))
    amplifier.handle(Apply(playing(1, 0.8)), 0.0)
    amplifier.trip(fault, 1.0, channel=2)
    amplifier.tick(1.0051)
    now = amplifier.status(1.0051)
    assert (now.state, now.fault, now.levels) == (AmplifierState.FAULT, fault, (0.0,) * 4)
    listed = amplifier.handle(GetFaults(), 2.0)
    assert listed == FaultList((FaultRecord(fault, 2, 1.0),))
    reported = [event for event, _ in events]
    assert reported == [
        AmplifierEvent(AmplifierState.FAULT_REACTION_ACTIVE, fault, 2),
        AmplifierEvent(AmplifierState.FAULT, fault),
    ]
    assert [time for _, time in events] == pytest.approx([1.0, 1.005])
    assert amplifier.handle(Arm(2.0), 2.0) == Nak(NakCode.WRONG_STATE)


def test_open_interlock_trips_and_keeps_disarmed() -> None:
    """Silent within 5 ms; neither cleared nor armed until it is closed."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8)), 0.0)
    amplifier.set_interlock(1.0, is_open=True)
    now = amplifier.status(1.0)
    assert (now.state, now.fault) == (AmplifierState.FAULT_REACTION_ACTIVE, Fault.INTERLOCK)
    amplifier.tick(1.0051)
    now = amplifier.status(1.0051)
    assert (now.state, now.levels, now.interlock_open) == (AmplifierState.FAULT, (0.0,) * 4, True)
    amplifier.handle(Clear(1), 1.1)
    assert amplifier.state is AmplifierState.FAULT
    amplifier.set_interlock(1.2, is_open=False)
    amplifier.handle(Clear(1), 1.2)
    assert amplifier.state is AmplifierState.SWITCH_ON_DISABLED
    amplifier.set_interlock(1.3, is_open=True)
    assert amplifier.handle(Arm(2.0), 1.3) == Nak(NakCode.WRONG_STATE)
    assert (amplifier.state, amplifier.fault) == (AmplifierState.SWITCH_ON_DISABLED, Fault.NONE)


def test_fault_while_disarmed_is_only_recorded() -> None:
    """There is nothing to silence; the fault history records it."""
    amplifier = SimulatedAmplifier("main", channels=4)
    amplifier.trip(Fault.ARC, 1.0)
    assert amplifier.state is AmplifierState.SWITCH_ON_DISABLED
    listed = amplifier.handle(GetFaults(), 1.5)
    assert listed == FaultList((FaultRecord(Fault.ARC, None, 0.5),))


def test_restart_is_silent_and_discards_sets() -> None:
    """Without its supply nothing plays; then it is disarmed, without envelopes, tokens, faults."""
    amplifier = armed()
    amplifier.handle(LoadEnvelope(Envelope(1, 0.005, (Knot(0.5, 0.0),))), 0.0)
    amplifier.handle(Apply(playing(1, 0.8)), 0.5)
    amplifier.restart(1.0)
    now = amplifier.status(1.0)
    assert (now.state, now.token, now.levels) == (AmplifierState.SWITCH_ON_DISABLED, 0, (0.0,) * 4)
    amplifier.handle(Arm(2.0), 1.1)
    shaped = CommandSet(1, (DriveCommand(0, 110.0, 0.5, onset=1),), ramp=0.0, valid_for=0.0)
    assert amplifier.handle(Apply(shaped), 1.2) == Nak(NakCode.NO_ENVELOPE, 0)
