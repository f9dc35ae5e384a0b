"""A simulated rig of protocol 3 in this process, and a host's group on it."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from drivers import clock
from drivers.contents import Layer, Tone
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from model.rig.rig import Rig
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.faults.fault_window import Faults
from sim.memory_line import MemoryLine

LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@dataclass
class RigInMemory:
    """The bench, its devices, and the group of their hosts, each on a line of its own."""

    bench: Bench
    devices: Mapping[str, AmplifierDevice]
    group: Group
    lines: dict[str, MemoryLine] = field(default_factory=dict)

    async def beat_until(self, time: float) -> None:
        """Feed the watchdogs until a time [s]."""
        while (left := time - clock.now()) > 0:
            await asyncio.sleep(min(left, 0.1))
            await self.group.beat()


def devices_of(bench: Bench) -> dict[str, AmplifierDevice]:
    """A device for each amplifier, at addresses 1, 2, ..., without faults as yet."""
    return {
        name: AmplifierDevice(bench, name, address=number, faults=Faults(begin=clock.now()))
        for number, name in enumerate(bench.amplifiers, 1)
    }


@asynccontextmanager
async def rig_in_memory(rig: Rig) -> AsyncIterator[RigInMemory]:
    """The amplifiers of a rig, identified and disarmed."""
    bench = Bench(rig, now=clock.now(), make_amplifier=Amplifier)
    devices = devices_of(bench)
    lines = {name: MemoryLine([device], name) for name, device in devices.items()}
    group = Group(
        {
            name: Host(each.line, devices[name].address, LIMITS, name=name)
            for name, each in lines.items()
        }
    )
    await group.open()
    try:
        yield RigInMemory(bench, devices, group, lines)
    finally:
        for name, device in devices.items():
            device.close()
            lines[name].close()


def layer(*tones: tuple[int, float, float], number: int = 0, ramp: float = 0.02) -> Layer:
    """A layer that plays tones of channel, frequency [Hz] and level."""
    return Layer(number, tuple(Tone(*tone) for tone in tones), ramp)
