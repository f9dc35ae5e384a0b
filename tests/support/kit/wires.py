"""Simulated amplifiers of protocol 4 on real wires: terminals, TCP, CAN servers and adapters.

The amplifiers of a rig run in the test's own event loop.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import cast

from drivers.errors import LinkDegraded, LinkError
from drivers.host.amplifier import WATCHDOG
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.records import Values
from kit.clock import MemoryMachine, VirtualLoop, live_in_memory
from model.rig.rig import Channel, Rig
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.readings import AmplifierSummary
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wire_assignment import FAR_ENDS, SimulatedWire, open_wires
from sim.faults import Faults
from sim.plant.imperfections import Imperfections


@dataclass
class FarSide:
    """The far side of a wire: URLs and devices by the amplifiers' names, and the bench behind.

    machine: whose lines they are in virtual time.
    """

    urls: Mapping[str, str]
    devices: Mapping[str, AmplifierDevice]
    bench: Bench
    machine: MemoryMachine | None

    @property
    def url(self) -> str:
        """Of the only amplifier, or the first."""
        return next(iter(self.urls.values()))

    @property
    def device(self) -> AmplifierDevice:
        """The only one, or the first."""
        return next(iter(self.devices.values()))

    @property
    def amplifier(self) -> SimulatedAmplifier:
        """What stands behind it."""
        return cast(SimulatedAmplifier, self.bench.amplifiers[self.device.name])

    def summary(self, name: str = "") -> AmplifierSummary:
        """State, token and levels of an amplifier now; of the first without a name."""
        self.bench.advance(threads.now())
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
    wire: SimulatedWire | Mapping[str, SimulatedWire],
    rig: Rig,
    *,
    seed: int = 0,
    imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
) -> AsyncIterator[FarSide]:
    """The amplifiers of a rig behind a wire, without faults until a test injects them.

    wire: of all of them, or of each by name; of memory in virtual time.
    """
    is_virtual = isinstance(asyncio.get_running_loop(), VirtualLoop)
    machine = live_in_memory() if is_virtual else None
    bench, devices = make_bench(rig, seed=seed, imperfections=imperfections)
    wires = dict.fromkeys(bench.amplifiers, wire) if isinstance(wire, SimulatedWire) else wire
    if machine is not None and len(bench.amplifiers) > 1:
        machine.be_prompt()  # the lines have delays of their kinds
    async with open_wires(wires, [*devices.values()]) as urls:
        try:
            yield FarSide(urls, devices, bench, machine)
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
    bench = Bench(rig, now=threads.now(), imperfections=imperfections)
    return bench, {
        name: AmplifierDevice(
            bench, name, address=number, faults=Faults(begin=threads.now(), seed=seed)
        )
        for number, name in enumerate(bench.amplifiers, start=1)
    }


WIRES: Mapping[str, SimulatedWire] = {
    far_end.scheme: SimulatedWire(kind, unpluggable=True) for kind, far_end in FAR_ENDS.items()
}
"""A wire with a far end of each kind, by the scheme of its URLs."""

SHARED_WIRES: Mapping[str, SimulatedWire] = {
    far_end.scheme: SimulatedWire(kind, shared=True) for kind, far_end in FAR_ENDS.items()
}
"""The same with several amplifiers on one line, where they hear one broadcast."""


def on_amplifiers(rig: Rig, names: Sequence[str]) -> Rig:
    """Wire the ERAs of a rig to amplifiers of these names in turn."""
    count = len(names)
    wiring = {
        era: Channel(names[number % count], number // count)
        for number, era in enumerate(rig.wiring)
    }
    amplifiers, outputs = dict.fromkeys(names, "sim://"), frozenset(names if rig.outputs else ())
    return replace(rig, wiring=wiring, amplifiers=amplifiers, outputs=outputs)


def on_two_amplifiers(rig: Rig) -> Rig:
    """Wire the ERAs of a rig to two amplifiers, east and west, in turn."""
    return on_amplifiers(rig, ("east", "west"))


LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@dataclass
class HostedRig(FarSide):
    """The far side of a wire, and the group of its hosts.

    watchdog [s]: of the group, also when it is opened again.
    """

    lines: Lines
    group: Group
    watchdog: float

    def levels(self, name: str) -> tuple[float, ...]:
        """What the channels of an amplifier play now."""
        return self.summary(name).levels

    async def reopen(self, *, within: float) -> None:
        """Close the lines, and open them again once they are there, within so many seconds."""
        await self.lines.close()
        async with asyncio.timeout(within):
            while True:
                with contextlib.suppress(LinkError):
                    self.group = await _opened_group(self.lines, self.urls, self.watchdog)
                    return
                await self.lines.close()
                await asyncio.sleep(0.05)

    async def beat_until(self, time: float) -> None:
        """Feed the watchdogs of those that reply until a time [s]."""
        while (left := time - threads.now()) > 0:
            await asyncio.sleep(min(left, 0.1))
            with contextlib.suppress(LinkDegraded):
                await self.group.beat()


@asynccontextmanager
async def rig_on_wire(
    rig: Rig, wire: SimulatedWire, *, watchdog: float = WATCHDOG
) -> AsyncIterator[HostedRig]:
    """The amplifiers of a rig on a wire, identified and disarmed; watchdog [s]."""
    async with far_side(wire, rig) as far:
        lines = Lines()
        try:
            group = await _opened_group(lines, far.urls, watchdog)
            yield HostedRig(far.urls, far.devices, far.bench, far.machine, lines, group, watchdog)
        finally:
            await lines.close()


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
) -> AmplifierLayer:
    """A layer that plays tones of channel, frequency [Hz], level and perhaps phase [degrees]."""
    return AmplifierLayer(number, tuple(AmplifierTone(*tone) for tone in tones), ramp)


async def until(condition: Callable[[], object]) -> None:
    """Let the event loop turn until a condition holds, for a minute at most."""
    async with asyncio.timeout(60.0):
        while not condition():  # noqa: ASYNC110  it has no event
            await asyncio.sleep(0.0)


def damage(data: bytes, chance: random.Random) -> bytes:
    """One to four bytes changed, inserted, removed, or a piece repeated; never empty."""
    damaged = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(damaged))
        match chance.randrange(5):
            case 0:
                damaged[at] ^= 1 << chance.randrange(8)
            case 1:
                damaged[at] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            case 2:
                damaged.insert(at, chance.randrange(256))
            case 3 if len(damaged) > 8:
                del damaged[at : at + chance.randint(1, 4)]
            case _:
                damaged[at:at] = damaged[at : at + 10]
    return bytes(damaged).ljust(5, b"\0")
