"""Every wire with its far end, for tests that hold on all of them: one entry a wire.

The far ends run in the test's own event loop, so that a test can look into the amplifier's clock.
"""

from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from model.rig.rig import Channel, Rig
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.wires import Wire, open_wire
from sim.faults.fault_window import Faults

WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", unpluggable=True),
    "modbus+tcp": Wire("modbus-tcp", unpluggable=True),
    "modbus+rtu": Wire("modbus-rtu", unpluggable=True),
    "can+socketcand": Wire("socketcand", unpluggable=True),
    "can+slcan": Wire("slcan", unpluggable=True),
}
"""Each is far end and backend by one scheme; see `sim.far_ends.wires`."""

SHARED_WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", shared=True),
    "modbus+tcp": Wire("modbus-tcp", shared=True),
    "modbus+rtu": Wire("modbus-rtu", shared=True),
    "can+socketcand": Wire("socketcand", shared=True),
    "can+slcan": Wire("slcan", shared=True),
}
"""Those on which several amplifiers hear one broadcast."""


def patient(url: str) -> str:
    """The same amplifier, on CAN with heartbeats 10 s apart: for tests not about them.

    On a busy machine those of 50 ms come so late that the amplifier counts as lost.
    """
    if not url.startswith("can+"):
        return url
    return url.replace("#", f"{'&' if '?' in url else '?'}heartbeat=10000#")


@dataclass(frozen=True)
class FarSide:
    """The far side of a wire: URLs and devices by the amplifiers' names, and the bench behind."""

    urls: Mapping[str, str]
    devices: Mapping[str, SimulatedDevice]
    bench: Bench

    @property
    def url(self) -> str:
        """Of the only amplifier, or the first."""
        return next(iter(self.urls.values()))

    @property
    def device(self) -> SimulatedDevice:
        """The only one, or the first."""
        return next(iter(self.devices.values()))

    @property
    def amplifier(self) -> SimulatedAmplifier:
        """What stands behind it."""
        return self.bench.amplifiers[self.device.name]

    def silent_from(self) -> float:
        """When the amplifier is silent for good [s], or infinity, by its own clock."""
        self.bench.advance(clock.now())
        ends = [tone.silent_from for output in self.amplifier.outputs for tone in output]
        return max(ends, default=self.bench.time)


@asynccontextmanager
async def far_side(wire: Wire, rig: Rig, *, seed: int = 0) -> AsyncIterator[FarSide]:
    """The amplifiers of a rig behind a wire, without faults until a test injects them."""
    bench = Bench(rig, now=clock.now(), make_amplifier=SensedAmplifier)
    devices: Sequence[SimulatedDevice] = [
        SimulatedDevice(bench, name, address=number, faults=Faults(begin=clock.now(), seed=seed))
        for number, name in enumerate(bench.amplifiers, start=1)
    ]
    async with open_wire(wire, devices) as urls:
        try:
            yield FarSide(urls, {device.name: device for device in devices}, bench)
        finally:
            for device in devices:
                device.close()


PROCESS_WIRES: Mapping[str, Sequence[str]] = {
    "serial": ["--serial"],
    "modbus+tcp": ["--modbus-tcp", "0"],
    "modbus+rtu": ["--modbus-rtu"],
    "can+socketcand": ["--socketcand", "0"],
    "can+slcan": ["--slcan"],
}
"""The same as options of `era sim`, for a far end that is a process of its own."""


def on_two_amplifiers(rig: Rig) -> Rig:
    """Wire the ERAs of a rig to two amplifiers, east and west, in turn."""
    wiring = {
        era: Channel("west" if number % 2 else "east", number // 2)
        for number, era in enumerate(rig.wiring)
    }
    return replace(rig, wiring=wiring, amplifiers={"east": "sim://", "west": "sim://"})


def tones(amplifier: Amplifier, *levels: float, token: int | None = None) -> SafeCommandSet:
    """Make a set at 110 Hz with these levels, from channel 0 on."""
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), amplifier.capabilities)
    commands = tuple(DriveCommand(channel, 110.0, level) for channel, level in enumerate(levels))
    return guard.check(
        CommandSet(token or amplifier.next_token(), commands, ramp=0.0, valid_for=0.0)
    )
