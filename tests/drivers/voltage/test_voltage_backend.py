"""An amplifier of voltage behind its conversion: limits, refusals, statuses."""

import cmath
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import numpy as np
import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard import Guard, safe_voltages
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.protocol.messages import AmplifierState, ChannelLimits
from paper_table import smooth_rig
from registry.voltage import Law, VoltageDrive
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.waveform import ShapedTone
from virtual_loop import in_virtual_time
from voltage_rigs import LAWS, RESONANCES, resonator, voltage_amplifier, voltage_rig

TONES = (DriveCommand(0, 120.0, 0.5, 30.0), DriveCommand(2, 120.0, 0.25, -110.0))


@asynccontextmanager
async def opened(law: str) -> AsyncIterator[tuple[Bench, Amplifier, Guard]]:
    """A bench, its amplifier armed, and a guard."""
    bench = Bench(voltage_rig(smooth_rig(), law), now=1000.0, make_amplifier=SensedAmplifier)
    amplifier = voltage_amplifier(bench)
    await amplifier.open()
    await amplifier.arm()
    yield bench, amplifier, Guard(bench.rig.limits, amplifier.capabilities)
    await amplifier.close()


def a_set(amplifier: Amplifier, *commands: DriveCommand, ramp: float = 0.0) -> CommandSet:
    """A set of these commands."""
    return CommandSet(amplifier.next_token(), commands, ramp=ramp, valid_for=0.0)


@pytest.mark.parametrize("law", ["linear", "quadratic", "quadratic with bias"])
@in_virtual_time
async def test_replies_are_of_motion(law: str) -> None:
    """Achieved set and status have the levels, frequencies and phases that were asked for."""
    async with opened(law) as (bench, amplifier, guard):
        achieved = await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        for wanted, found in zip(TONES, achieved.commands, strict=True):
            assert found.frequency == wanted.frequency
            assert found.phasor == pytest.approx(wanted.phasor, abs=2e-3)
        status = await amplifier.status()
        assert status.levels == pytest.approx((0.5, 0.0, 0.25, 0.0), abs=2e-3)
        outputs = bench.amplifiers["main"].outputs
        assert outputs[0][-1].frequency == (60.0 if law == "quadratic" else 120.0)
        again = await amplifier.stop()
        assert again.state is AmplifierState.QUICK_STOP_ACTIVE


@pytest.mark.parametrize("law", LAWS)
@in_virtual_time
async def test_half_a_frequency_that_no_wire_carries_is_no_contradiction(law: str) -> None:
    """Half of 149.95 Hz goes as 75 Hz; near its resonance the response turns by 4 degrees per Hz.

    A step of the phase is 0.02 degrees.
    """
    async with opened(law) as (_, amplifier, guard):
        await amplifier.disarm()
        checked = CheckedAmplifier(amplifier)
        await checked.arm()
        asked = replace(TONES[0], frequency=149.95)
        achieved = await checked.apply(guard.check(a_set(amplifier, asked)))
        await checked.heartbeat()
        await checked.heartbeat()
        assert achieved.commands[0].frequency == pytest.approx(150.0, abs=0.051)
        assert achieved.commands[0].phase == pytest.approx(asked.phase, abs=0.011)


@in_virtual_time
async def test_halved_phase_is_near_that_which_plays() -> None:
    """Not near one that was staged since and never played.

    The voltage turns by half of 160 degrees from 80 to -120: by 80 degrees, not by 100.
    """
    async with opened("quadratic") as (bench, amplifier, guard):
        phases = []
        for phase, is_played in ((80.0, True), (-60.0, False), (-120.0, True)):
            tone = replace(TONES[0], phase=phase, keep_phase=True)
            safe = guard.check(a_set(amplifier, tone))
            if is_played:
                await amplifier.apply(safe)
                last = bench.amplifiers["main"].outputs[0][-1]
                phases.append(math.degrees(cmath.phase(last.settled_amplitude)))
            else:
                await amplifier.stage(safe)
        turned = math.remainder(phases[1] - phases[0], 360.0)
        assert turned == pytest.approx(80.0, abs=0.1)


@in_virtual_time
async def test_set_that_is_repeated_has_the_same_voltages() -> None:
    """A retry carries what was sent before, or the amplifier would refuse its token."""
    async with opened("quadratic") as (_, amplifier, guard):
        safe = guard.check(a_set(amplifier, *TONES))
        assert await amplifier.apply(safe) == await amplifier.apply(safe)


@in_virtual_time
async def test_tone_goes_out_before_another_comes_in() -> None:
    """Without bias the guard refuses another frequency, or a restart, until there is silence."""
    async with opened("quadratic") as (_, amplifier, guard):
        await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        for other in (replace(TONES[0], frequency=180.0), TONES[0]):
            with pytest.raises(CommandRefused, match="cross-fade") as refused:
                guard.check(a_set(amplifier, other))
            assert refused.value.until is None
        await amplifier.apply(
            guard.check(a_set(amplifier, replace(TONES[0], level=0.6, keep_phase=True)))
        )
        await amplifier.apply(guard.silence(amplifier.next_token(), range(4), ramp=0.02))
        with pytest.raises(CommandRefused, match="cross-fade") as refused:
            guard.check(a_set(amplifier, TONES[0]))
        assert refused.value.until is not None
        guard.check(a_set(amplifier, DriveCommand(1, 90.0, 0.5)))  # a channel that was silent


@in_virtual_time
async def test_linear_voltage_fades_across() -> None:
    """With a linear law nothing beats."""
    async with opened("linear") as (_, amplifier, guard):
        await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        guard.check(a_set(amplifier, replace(TONES[0], frequency=180.0), ramp=0.02))


KNOTS = (Knot(0.2, 10.0), Knot(0.4, 100.0), Knot(0.1, -50.0))


@in_virtual_time
async def test_envelopes_without_bias_are_refused() -> None:
    """The square of a straight line is none."""
    async with opened("quadratic") as (_, _, guard):
        with pytest.raises(CommandRefused):
            guard.check_envelope(Envelope(1, 0.005, KNOTS))


@pytest.mark.parametrize("law", ["linear", "quadratic with bias"])
@in_virtual_time
async def test_envelope_is_converted_at_the_frequency_of_its_set(law: str) -> None:
    """Each knot of the voltage, by the resonator's formula, is the knot of the motion.

    The same envelope at another frequency is loaded again, at the same one it is not.
    """
    _, bias, gain = LAWS[law]
    async with opened(law) as (bench, amplifier, guard):
        onset = guard.check_envelope(Envelope(1, 0.005, KNOTS))
        await amplifier.load_envelope(onset)
        loads = []
        for frequency in (120.0, 120.0, 180.0):
            asked = replace(TONES[0], frequency=frequency, onset=1)
            await amplifier.apply(guard.check(a_set(amplifier, asked)))
            tone = bench.amplifiers["main"].outputs[0][-1]
            assert isinstance(tone, ShapedTone)
            response = resonator(np.array([frequency]), RESONANCES["SW"], gain)[0]
            motion = np.array(tone.values[1:]) * response * (2 * bias if bias else 1)
            wanted = [knot.phasor for knot in (*KNOTS, Knot(asked.level, asked.phase))]
            np.testing.assert_allclose(motion, wanted, atol=2e-3)
            loads.append(dict(amplifier._link.backend._loaded))  # type: ignore[attr-defined]
            await amplifier.apply(guard.silence(amplifier.next_token(), range(4), ramp=0.0))
        assert loads[0] == loads[1] != loads[2]


@in_virtual_time
async def test_amplifier_and_rig_must_agree_on_what_levels_are() -> None:
    """Motion with a voltage section, and voltage without one, are refused."""
    rig = voltage_rig(smooth_rig(), "linear")
    of_motion = Bench(replace(rig, voltage={}), now=1000.0, make_amplifier=SensedAmplifier)
    amplifier = voltage_amplifier(of_motion)
    amplifier._link.backend._drives = rig.voltage_of("main")  # type: ignore[attr-defined]
    with pytest.raises(CommandError, match="voltage"):
        await amplifier.open()
    bare = voltage_amplifier(Bench(rig, now=1000.0, make_amplifier=SensedAmplifier))
    bare = Amplifier(bare._link.backend._backend)  # type: ignore[attr-defined]
    await bare.open()
    with pytest.raises(CommandError, match="voltage"):
        Guard(rig.limits, bare.capabilities)


LIMITS = (ChannelLimits(20.0, 300.0, 0.6),)


@in_virtual_time
async def test_voltage_limits_hold_after_the_conversion() -> None:
    """A set that passed the guard is refused for its voltage, its frequency, or no number."""
    async with opened("linear") as (_, amplifier, guard):
        safe = guard.check(a_set(amplifier, TONES[0]))
        held = safe_voltages(safe, [replace(TONES[0], level=0.6)], LIMITS)
        assert held.commands[0].level == 0.6
        for changed in ({"level": 0.61}, {"level": float("nan")}, {"frequency": 301.0}):
            with pytest.raises(CommandRefused) as refused:
                safe_voltages(safe, [replace(TONES[0], **changed)], LIMITS)
            assert refused.value.channel == 0
        with pytest.raises(CommandRefused, match="channels"):
            safe_voltages(safe, [], LIMITS)


@in_virtual_time
async def test_level_beyond_the_voltage_is_refused_by_the_guard() -> None:
    """The highest level is what the voltage reaches at every frequency of the rig."""
    rig = voltage_rig(smooth_rig(), "quadratic")
    bench = Bench(rig, now=1000.0, make_amplifier=SensedAmplifier)
    weak = {
        name: VoltageDrive(((50.0, 1.0, 0.0), (300.0, 1.0, 0.0)), law=Law.QUADRATIC)
        for name in bench.rig.voltage
    }
    bench = Bench(replace(bench.rig, voltage=weak), now=1000.0, make_amplifier=SensedAmplifier)
    amplifier = voltage_amplifier(bench)
    await amplifier.open()
    guard = Guard(bench.rig.limits, amplifier.capabilities)
    assert guard.limits.level == pytest.approx(0.5)
    with pytest.raises(CommandRefused):
        guard.check(a_set(amplifier, DriveCommand(0, 100.0, 0.51)))
