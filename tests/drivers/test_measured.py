"""Measured voltage and current, over every wire."""

import math
from dataclasses import replace

import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits
from drivers.protocol.messages import Feature
from drivers.registry import open_backend
from model.rig.rig import Rig
from wires import WIRES, far_side, patient


@pytest.mark.parametrize("wire", WIRES)
async def test_voltage_and_current_are_read(wire: str, coarse_rig: Rig) -> None:
    """Level 0.2 at 110 Hz: the voltage has half the frequency and the root of the level.

    The simulated supply has 1800 V, an actuator 1 nF; both rms.
    """
    async with far_side(WIRES[wire], coarse_rig) as far:
        amplifier = Amplifier(open_backend(patient(far.url)), reply_timeout=1.0)
        await amplifier.open()
        await amplifier.arm(2.0)
        guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
        commands = (DriveCommand(1, 110.0, 0.2),)
        await amplifier.apply(guard.check(CommandSet(9, commands, ramp=0.0, valid_for=0.0)))
        silent, playing, *_ = await amplifier.measured()
        assert (silent.voltage, silent.current) == (0.0, 0.0)
        volts = 1800 * math.sqrt(0.2) / math.sqrt(2)
        assert playing.voltage == pytest.approx(volts, abs=0.051)
        assert playing.current == pytest.approx(2 * math.pi * 55 * 1e-9 * volts, abs=0.51e-6)
        await amplifier.disarm(0.0)
        await amplifier.close()


async def test_amplifier_that_measures_nothing_is_not_asked(coarse_rig: Rig) -> None:
    """By its features."""
    async with far_side(WIRES["serial"], coarse_rig) as far:
        able = far.amplifier.capabilities
        far.amplifier.capabilities = replace(able, features=able.features & ~Feature.ELECTRICAL)
        amplifier = Amplifier(open_backend(far.url))
        await amplifier.open()
        assert await amplifier.measured() == ()
        await amplifier.close()
