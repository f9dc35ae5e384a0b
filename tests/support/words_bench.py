"""A simulated rig of protocol 3 in this process, and a host's group on it."""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from drivers import clock
from drivers.contents import Layer, Tone
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from model.rig.rig import Rig
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.faults.fault_window import Faults
from sim.memory_line import MemoryPort

LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@dataclass
class RigInMemory:
    """The bench, its devices, and the group of their hosts, each on a line of its own."""

    bench: Bench
    devices: Mapping[str, AmplifierDevice]
    group: Group
    lines: dict[str, Line] = field(default_factory=dict)

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


def memory_line(devices: Sequence[AmplifierDevice], name: str) -> Line:
    """The host's line to devices of a bench."""
    lines: list[Line] = []
    port = MemoryPort(devices, lambda data: lines[0].received(data), lambda why: lines[0].lose(why))
    lines.append(Line(SerialWire(0, sequence=0), port, name))
    return lines[0]


@asynccontextmanager
async def rig_in_memory(rig: Rig) -> AsyncIterator[RigInMemory]:
    """The amplifiers of a rig, identified and disarmed."""
    bench = Bench(rig, now=clock.now(), make_amplifier=Amplifier)
    devices = devices_of(bench)
    lines = {name: memory_line([device], name) for name, device in devices.items()}
    group = Group(
        {name: Host(each, devices[name].address, LIMITS, name=name) for name, each in lines.items()}
    )
    await group.open()
    try:
        yield RigInMemory(bench, devices, group, lines)
    finally:
        for name, device in devices.items():
            device.close()
            if lines[name].loss is None:
                lines[name].lose("closed")


def layer(*tones: tuple[int, float, float], number: int = 0, ramp: float = 0.02) -> Layer:
    """A layer that plays tones of channel, frequency [Hz] and level."""
    return Layer(number, tuple(Tone(*tone) for tone in tones), ramp)
