"""Sensors and readings of many tones over every wire, which take several replies."""

import asyncio

import pytest

from drivers import clock
from drivers.host.sensors import measure_tones, read_sensors
from long_form import shortly
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.plant.accelerometer import Accelerometer
from sim.sensors.recorder import Accelerometers
from virtual_loop import in_virtual_time
from wires import WIRES
from words_bench import layer, rig_on_wire

PLACE = (0.11, 0.07)  # m; of an accelerometer
SETTLING, WINDOW = 1.5, 0.2  # s


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))
@in_virtual_time
async def test_sensors_are_described_and_many_tones_read(wire: str, coarse_rig: Rig) -> None:
    """Sixteen tones at five sensors take several replies; one sensor is overloaded."""
    frequencies = [90.0 + 10 * n for n in range(16)]
    extra = Accelerometer("A", *PLACE, reach=1e-3)  # m/s²
    live_in_memory()
    async with rig_on_wire(coarse_rig, WIRES[wire]) as hosted:
        Accelerometers(hosted.bench).place([extra])
        host = hosted.group.amplifiers["main"]
        found = await read_sensors(host)
        eras = {coarse_rig.wiring[era.name].number: era for era in coarse_rig.eras}
        assert [one.channel for one in found] == [*sorted(eras), None]
        places = [*((eras[n].x, eras[n].y) for n in sorted(eras)), PLACE]
        for one, at in zip(found, places, strict=True):
            assert (one.x, one.y) == pytest.approx(at, abs=5e-5)
        assert {one.unit for one in found} == {"ACCELERATION"}
        await hosted.group.arm()
        await hosted.group.apply({"main": [layer((0, frequencies[2], 0.2, 0.0), ramp=0.05)]})
        await hosted.beat_until(clock.now() + SETTLING)
        measuring = asyncio.create_task(measure_tones(host, frequencies, WINDOW))
        while not measuring.done():
            await hosted.beat_until(clock.now() + 0.05)
        reading = await measuring
        await hosted.group.disarm()
    assert [one.is_overloaded for one in reading.sensors] == [False] * 4 + [True]
    assert all(len(one.tones) == 16 for one in reading.sensors)
    amplitude = reading.sensors[0].tones[2][0]
    others = [size for one in reading.sensors[:4] for size, _ in one.tones]
    assert max(size for n, size in enumerate(others) if n % 16 != 2) < 0.01 * amplitude
