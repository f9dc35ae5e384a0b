"""Tones at an amplifier's sensors, over every wire, against a direct solution in frequency."""

import math

import numpy as np
import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from drivers.protocol.messages import ReadingState
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Rig
from model.vibration.direct import direct_responder
from sim.sensors.accelerometer import Accelerometer, Accelerometers
from virtual_loop import run_virtual
from wires import WIRES, FarSide, far_side, patient

PLACE = (0.11, 0.07)  # m; of an accelerometer
PLAYED = (DriveCommand(1, 110.0, 0.2, 40.0), DriveCommand(3, 173.5, 0.3, -75.0))
SETTLING, WINDOW = 1.5, 0.4  # s


async def opened(far: FarSide) -> Amplifier:
    """Open the amplifier of a far side."""
    amplifier = Amplifier(open_backend(patient(far.url)))
    await amplifier.open()
    return amplifier


async def settled(amplifier: Amplifier, *commands: DriveCommand) -> CheckedAmplifier:
    """Play commands until the plate has settled."""
    checked = CheckedAmplifier(amplifier)
    await checked.arm(2.0)
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), amplifier.capabilities)
    token = amplifier.next_token()
    await checked.apply(guard.check(CommandSet(token, commands, ramp=0.05, valid_for=0.0)))
    await keep_alive(checked, SETTLING, interval=0.05)
    return checked


@pytest.mark.parametrize("wire", WIRES)
def test_tones_are_those_of_a_direct_solution(wire: str, coarse_rig: Rig) -> None:
    """Two tones at once on two ERAs, at every foot and an accelerometer: within 1 % and 1 degree.

    Small ones of 1 % of the largest and less, next to a nodal line, within 1 % of the largest.
    """

    async def run() -> tuple[np.ndarray, ReadingState]:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            Accelerometers(far.bench).place([Accelerometer("A", *PLACE)])
            amplifier = await opened(far)
            await settled(amplifier, *PLAYED)
            reading = await amplifier.measure([one.frequency for one in PLAYED], WINDOW)
            status = await amplifier.status()
            await amplifier.disarm(0.0)
            await amplifier.close()
            phasors = [[tone.phasor for tone in one.tones] for one in reading.sensors]
            assert reading.token == status.token
            return np.array(phasors), reading.state

    phasors, state = run_virtual(run())
    assert state is ReadingState.COMPLETE
    by_channel = sorted(coarse_rig.eras, key=lambda era: coarse_rig.wiring[era.name].number)
    points = np.array([*((era.x, era.y) for era in by_channel), PLACE])
    solve = direct_responder(coarse_rig.plate, coarse_rig.mesh)
    frequencies = np.array([one.frequency for one in PLAYED])
    fields = solve(by_channel, frequencies, points)
    for tone, played in enumerate(PLAYED):
        drive = played.level * np.exp(1j * math.radians(played.phase))
        expected = fields[tone, played.channel] * drive
        seen = phasors[:, tone]
        assert abs(seen - expected).max() < 0.01 * abs(expected).max()
        large = abs(expected) > 0.01 * abs(expected).max()
        assert abs(abs(seen / expected)[large] - 1).max() < 0.01
        assert abs(np.angle(seen / expected, deg=True)[large]).max() < 1.0
