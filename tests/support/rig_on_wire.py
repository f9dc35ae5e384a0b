"""The amplifiers of a rig on a real wire, as version 3 speaks, in the test's own event loop."""

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import cast

from drivers import clock
from model.rig.rig import Rig
from sim.amplifier.contract import Amplifier
from sim.amplifier.readings import AmplifierSummary
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wires
from sim.faults.fault_window import Faults
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

    def silent_from(self) -> float:
        """When the amplifier is silent for good [s], or infinity, by its own clock."""
        self.bench.advance(clock.now())
        ends = [tone.silent_from for output in self.amplifier.outputs for tone in output]
        return max(ends, default=self.bench.time)


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
