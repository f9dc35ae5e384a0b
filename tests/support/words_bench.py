"""A simulated rig of protocol 3 in this process or on wires, and a host's group on it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from drivers import clock
from drivers.contents import Layer, Tone
from drivers.errors import LinkDegraded, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from drivers.opening import Lines
from model.rig.rig import Rig
from registry.limits import GuardLimits
from rig_on_wire import far_side, make_bench
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire
from sim.memory_line import MemoryPort

LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@dataclass
class HostedRig:
    """The bench, its devices, and the group of their hosts.

    urls: on real wires, by name; watchdog [s]: of the group, also when it is opened again.
    """

    bench: Bench
    devices: Mapping[str, AmplifierDevice]
    group: Group
    urls: Mapping[str, str] = field(default_factory=dict)
    opened: Lines = field(default_factory=Lines)
    watchdog: float = WATCHDOG

    @property
    def lines(self) -> Mapping[str, Line]:
        """The line of each amplifier."""
        return {name: each.line for name, each in self.group.amplifiers.items()}

    def levels(self, name: str) -> tuple[float, ...]:
        """What the channels of an amplifier play now."""
        self.bench.advance(clock.now())
        return self.bench.amplifiers[name].summary(self.bench.time).levels

    async def reopen(self, *, within: float) -> None:
        """Close the lines, and open them again once they are there, within so many seconds."""
        await self.opened.close()
        async with asyncio.timeout(within):
            while True:
                with contextlib.suppress(LinkError):
                    self.group = await _opened_group(self.opened, self.urls, self.watchdog)
                    return
                await self.opened.close()
                await asyncio.sleep(0.05)

    async def beat_until(self, time: float) -> None:
        """Feed the watchdogs of those that reply until a time [s]."""
        while (left := time - clock.now()) > 0:
            await asyncio.sleep(min(left, 0.1))
            with contextlib.suppress(LinkDegraded):
                await self.group.beat()


def memory_line(devices: Sequence[AmplifierDevice], name: str) -> Line:
    """The host's line to devices of a bench."""
    lines: list[Line] = []
    port = MemoryPort(devices, lambda data: lines[0].received(data), lambda why: lines[0].lose(why))
    lines.append(Line(SerialWire(0, sequence=0), port, name))
    return lines[0]


@asynccontextmanager
async def rig_in_memory(rig: Rig, *, watchdog: float = WATCHDOG) -> AsyncIterator[HostedRig]:
    """The amplifiers of a rig, each on a line of its own, identified and disarmed; watchdog [s]."""
    bench, devices = make_bench(rig)
    hosts = {
        name: Host(memory_line([each], name), each.address, LIMITS, name=name)
        for name, each in devices.items()
    }
    group = Group(hosts, watchdog=watchdog)
    await group.open()
    try:
        yield HostedRig(bench, devices, group)
    finally:
        for name, device in devices.items():
            device.close()
            if hosts[name].line.loss is None:
                hosts[name].line.lose("closed")


@asynccontextmanager
async def rig_on_wire(
    rig: Rig, wire: Wire, *, watchdog: float = WATCHDOG
) -> AsyncIterator[HostedRig]:
    """The amplifiers of a rig on a wire, identified and disarmed; watchdog [s]."""
    async with far_side(wire, rig) as far:
        opened = Lines()
        try:
            group = await _opened_group(opened, far.urls, watchdog)
            yield HostedRig(far.bench, far.devices, group, far.urls, opened, watchdog)
        finally:
            await opened.close()


async def _opened_group(lines: Lines, urls: Mapping[str, str], watchdog: float) -> Group:
    """A group of the amplifiers at these URLs, identified and disarmed."""
    group = Group(
        {name: await lines.amplifier(url, LIMITS, name=name) for name, url in urls.items()},
        watchdog=watchdog,
    )
    await group.open()
    return group


def layer(
    *tones: tuple[int, float, float] | tuple[int, float, float, float],
    number: int = 0,
    ramp: float = 0.02,
) -> Layer:
    """A layer that plays tones of channel, frequency [Hz], level and perhaps phase [degrees]."""
    return Layer(number, tuple(Tone(*tone) for tone in tones), ramp)
