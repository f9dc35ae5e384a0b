"""The amplifiers of a rig on a real wire, as version 3 speaks, in the test's own event loop."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import cast

from drivers import clock
from drivers.contents import Layer, Tone
from drivers.errors import LinkDegraded, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from drivers.opening import Lines
from drivers.protocol.records import Values
from model.rig.rig import Channel, Rig
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier
from sim.amplifier.readings import AmplifierSummary
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wires
from sim.faults.fault_window import Faults
from sim.memory_line import MemoryPort
from sim.plant.imperfections import Imperfections


@dataclass(frozen=True)
class FarSide:
    """The far side of a wire: URLs and devices by the amplifiers' names, and the bench behind."""

    urls: Mapping[str, str]
    devices: Mapping[str, AmplifierDevice]
    bench: Bench

    @property
    def url(self) -> str:
        """Of the only amplifier, or the first."""
        return next(iter(self.urls.values()))

    @property
    def device(self) -> AmplifierDevice:
        """The only one, or the first."""
        return next(iter(self.devices.values()))

    @property
    def amplifier(self) -> Amplifier:
        """What stands behind it."""
        return cast(Amplifier, self.bench.amplifiers[self.device.name])

    def summary(self, name: str = "") -> AmplifierSummary:
        """State, token and levels of an amplifier now; of the first without a name."""
        self.bench.advance(clock.now())
        found = self.bench.amplifiers[name or self.device.name]
        return found.summary(self.bench.time)


def after_each(
    device: AmplifierDevice, note: Callable[[str, Values, Values, float], object]
) -> None:
    """Call with each request that a device carries out: its name, values, reply and time [s]."""
    obey = device.handle

    def handle(name: str, values: Values, now: float) -> Values:
        reply = obey(name, values, now)  # a refusal changes nothing
        note(name, values, reply, now)
        return reply

    device.handle = handle  # type: ignore[method-assign]


@asynccontextmanager
async def far_side(
    wire: Wire | Mapping[str, Wire],
    rig: Rig,
    *,
    seed: int = 0,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> AsyncIterator[FarSide]:
    """The amplifiers of a rig behind a wire, without faults until a test injects them.

    wire: of all of them, or of each by name.
    """
    bench, devices = make_bench(rig, seed=seed, imperfections=imperfections)
    wires = dict.fromkeys(bench.amplifiers, wire) if isinstance(wire, Wire) else wire
    async with open_wires(wires, [*devices.values()]) as urls:
        try:
            yield FarSide(urls, devices, bench)
        finally:
            for device in devices.values():
                device.close()


def make_bench(
    rig: Rig,
    *,
    seed: int = 0,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> tuple[Bench, dict[str, AmplifierDevice]]:
    """A bench, and a device for each amplifier at addresses 1, 2, ..., without faults as yet."""
    bench = Bench(rig, now=clock.now(), imperfections=imperfections)
    return bench, {
        name: AmplifierDevice(
            bench, name, address=number, faults=Faults(begin=clock.now(), seed=seed)
        )
        for number, name in enumerate(bench.amplifiers, start=1)
    }


WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", unpluggable=True),
    "modbus+tcp": Wire("modbus-tcp", unpluggable=True),
    "modbus+rtu": Wire("modbus-rtu", unpluggable=True),
    "can+socketcand": Wire("socketcand", unpluggable=True),
    "can+slcan": Wire("slcan", unpluggable=True),
}
"""Each is far end and host by one scheme; see `sim.far_ends.wires`."""

SHARED_WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", shared=True),
    "modbus+tcp": Wire("modbus-tcp", shared=True),
    "modbus+rtu": Wire("modbus-rtu", shared=True),
    "can+socketcand": Wire("socketcand", shared=True),
    "can+slcan": Wire("slcan", shared=True),
}
"""Those on which several amplifiers hear one broadcast."""


def on_two_amplifiers(rig: Rig) -> Rig:
    """Wire the ERAs of a rig to two amplifiers, east and west, in turn."""
    wiring = {
        era: Channel("west" if number % 2 else "east", number // 2)
        for number, era in enumerate(rig.wiring)
    }
    return replace(rig, wiring=wiring, amplifiers={"east": "sim://", "west": "sim://"})


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
