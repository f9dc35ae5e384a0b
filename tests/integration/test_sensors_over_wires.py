"""Tones at an amplifier's sensors, over every wire, against a direct solution in frequency."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from drivers import clock
from drivers.host.amplifier import Amplifier
from drivers.host.sensors import Reading, measure_tones, read_sensors
from long_form import shortly
from memory_machine import live_in_memory
from model.rig.rig import Rig
from model.vibration.natural_modes import direct_responder
from sim.plant.accelerometer import Accelerometer
from sim.sensors.recorder import Accelerometers
from virtual_loop import in_virtual_time
from wires import WIRES
from words_bench import HostedRig, layer, rig_on_wire

PLACE = (0.11, 0.07)  # m; of an accelerometer
PLAYED = ((1, 110.0, 0.2, 40.0), (3, 173.5, 0.3, -75.0))
"""Channel, frequency [Hz], level and phase [degrees]."""

SETTLING, WINDOW = 1.5, 0.4  # s
EVERY_WIRE = pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))


@asynccontextmanager
async def on_wire(wire: str, rig: Rig, *extra: Accelerometer) -> AsyncIterator[HostedRig]:
    """A rig on a wire in memory, with accelerometers beside the sensors at its feet."""
    live_in_memory()
    async with rig_on_wire(rig, WIRES[wire]) as hosted:
        Accelerometers(hosted.bench).place(extra)
        yield hosted


async def settled(hosted: HostedRig, *tones: tuple[int, float, float, float]) -> int:
    """Play tones until the plate has settled; returns their token."""
    await hosted.group.arm()
    played = await hosted.group.apply({"main": [layer(*tones, ramp=0.05)]})
    await hosted.beat_until(clock.now() + SETTLING)
    return played.token


async def measured(hosted: HostedRig, frequencies: list[float], window: float) -> Reading:
    """Measure tones while the watchdog is fed."""
    measuring = asyncio.create_task(measure_tones(host_of(hosted), frequencies, window))
    while not measuring.done():
        await hosted.beat_until(clock.now() + 0.05)
    return await measuring


def host_of(hosted: HostedRig) -> Amplifier:
    """The only amplifier."""
    return hosted.group.amplifiers["main"]


def phasor(tone: tuple[float, float]) -> complex:
    """Complex amplitude of a tone's amplitude and phase [degrees]."""
    return tone[0] * complex(np.exp(1j * math.radians(tone[1])))


@EVERY_WIRE
@in_virtual_time
async def test_tones_are_those_of_a_direct_solution(wire: str, coarse_rig: Rig) -> None:
    """Two tones at once on two ERAs, at every foot and an accelerometer: within 1 % and 1 degree.

    Small ones of 1 % of the largest and less, next to a nodal line, within 1 % of the largest.
    """
    async with on_wire(wire, coarse_rig, Accelerometer("A", *PLACE)) as hosted:
        token = await settled(hosted, *PLAYED)
        reading = await measured(hosted, [frequency for _, frequency, _, _ in PLAYED], WINDOW)
        await hosted.group.disarm()
    assert (reading.state, reading.token) == ("COMPLETE", token)
    phasors = np.array([[phasor(tone) for tone in one.tones] for one in reading.sensors])
    by_channel = sorted(coarse_rig.eras, key=lambda era: coarse_rig.wiring[era.name].number)
    points = np.array([*((era.x, era.y) for era in by_channel), PLACE])
    frequencies = np.array([frequency for _, frequency, _, _ in PLAYED])
    solve = direct_responder(coarse_rig.plate, coarse_rig.mesh)
    fields = solve(by_channel, frequencies, points)
    for tone, (channel, _, level, phase) in enumerate(PLAYED):
        expected = fields[tone, channel] * phasor((level, phase))
        seen = phasors[:, tone]
        assert abs(seen - expected).max() < 0.01 * abs(expected).max()
        large = abs(expected) > 0.01 * abs(expected).max()
        assert abs(abs(seen / expected)[large] - 1).max() < 0.01
        assert abs(np.angle(seen / expected, deg=True)[large]).max() < 1.0


@EVERY_WIRE
@in_virtual_time
async def test_sensors_are_described_and_many_tones_read(wire: str, coarse_rig: Rig) -> None:
    """Sixteen tones at five sensors take several replies; one sensor is overloaded."""
    frequencies = [90.0 + 10 * n for n in range(16)]
    extra = Accelerometer("A", *PLACE, reach=1e-3)  # m/s²
    async with on_wire(wire, coarse_rig, extra) as hosted:
        found = await read_sensors(host_of(hosted))
        eras = {coarse_rig.wiring[era.name].number: era for era in coarse_rig.eras}
        assert [one.channel for one in found] == [*sorted(eras), None]
        places = [*((eras[n].x, eras[n].y) for n in sorted(eras)), PLACE]
        for one, at in zip(found, places, strict=True):
            assert (one.x, one.y) == pytest.approx(at, abs=5e-5)
        assert {one.unit for one in found} == {"ACCELERATION"}
        await settled(hosted, (0, frequencies[2], 0.2, 0.0))
        reading = await measured(hosted, frequencies, 0.2)
        await hosted.group.disarm()
    assert [one.is_overloaded for one in reading.sensors] == [False] * 4 + [True]
    assert all(len(one.tones) == 16 for one in reading.sensors)
    amplitude = reading.sensors[0].tones[2][0]
    others = [size for one in reading.sensors[:4] for size, _ in one.tones]
    assert max(size for n, size in enumerate(others) if n % 16 != 2) < 0.01 * amplitude
