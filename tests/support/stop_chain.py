"""A chain in virtual time whose stops are judged by what the simulated amplifiers play.

Faults of frames (lost, late, doubled) lie between the host and each amplifier. What a stop reports
is compared with the channels themselves, then and until long after the last late frame.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from controller.loop.loop import Controller
from controller.sources.touch import Touch, TouchFrame
from drivers.amplifier import Amplifier
from drivers.errors import DriverError
from drivers.operation.silence import SilenceStatus, StopOutcome
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Commit,
    Nak,
    Reply,
    Request,
    Stage,
)
from drivers.registry import open_backend
from memory_machine import live_in_memory
from registry.limits import GuardLimits
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.wires import Wire, open_wires
from sim.faults.fault_window import Faults, FaultWindow
from sim.waveform import level_of
from virtual_loop import VirtualLoop
from witnessed_chain import OneTable, make_rig

WIRES = {
    "serial": Wire("serial", speed=921_600),
    "serial, shared": Wire("serial", speed=115_200, shared=True),
    "modbus-rtu": Wire("modbus-rtu", speed=115_200),
    "modbus-tcp": Wire("modbus-tcp"),
    "socketcand": Wire("socketcand", speed=500_000),
    "slcan": Wire("slcan", speed=500_000),
}
"""Every kind of wire; of two amplifiers one line or bus each kind but serial is shared."""

MAX_DELAY = 0.2  # s; of a late frame
LONGEST = 5.0  # s; a stop that takes longer hangs
_LATE = 2 * MAX_DELAY + 0.05  # s; until every late frame and its late copy have arrived
_SILENT = PROTOCOL.quantities.level.step / 2  # what a status reports as 0
_MOMENTS = 20  # at which a fade is looked at


@dataclass
class StopChain:
    """A controller whose loop runs, the amplifiers that it drives, and what was found wrong."""

    rng: random.Random
    bench: Bench
    devices: list[SimulatedDevice]
    controller: Controller
    amplifiers: Mapping[str, Amplifier]
    urls: Mapping[str, str]
    found: list[str] = field(default_factory=list)
    granted: list[tuple[str, Request, Reply]] = field(default_factory=list)
    unhandled: list[str] = field(default_factory=list)
    loop: "asyncio.Task[None] | None" = None

    async def play(self) -> None:
        """Arm, and let a finger be felt; gives up after a DriverError."""
        with contextlib.suppress(DriverError):
            await self.controller.clear()
            await self.controller.arm()
        self.touch()
        await asyncio.sleep(self.rng.uniform(0.0, 0.08))

    def touch(self) -> None:
        """Deliver a finger at a random place."""
        now = asyncio.get_running_loop().time()
        at = Touch(1, self.rng.uniform(0.1, 0.9), self.rng.uniform(0.1, 0.9))
        self.controller.deliver(TouchFrame("test", now, (at,)))

    def disturb(self, windows: tuple[FaultWindow, ...]) -> None:
        """Begin faults on the way to and from every amplifier."""
        for device in self.devices:
            for window in windows:
                device.inject_fault(window)

    async def abandon(self) -> None:
        """Close the wires and send nothing, which is what a killed host leaves."""
        if self.loop is not None:
            self.loop.cancel()
        for amplifier in self.amplifiers.values():
            await amplifier.close()

    def recover(self) -> None:
        """End all faults."""
        for device in self.devices:
            device.recover()

    def loud(self, name: str) -> str:
        """What an amplifier plays now or will without a further request; empty if nothing."""
        now = asyncio.get_running_loop().time()
        self.bench.advance(now)
        amplifier = self.bench.amplifiers[name]
        ends = max((tone.silent_from for output in amplifier.outputs for tone in output), default=0)
        lasts = min(max(0.0, ends - now), LONGEST)
        level = max(
            level_of(output, now + lasts * number / _MOMENTS)
            for output in amplifier.outputs
            for number in range(_MOMENTS)
        )
        is_enabled = amplifier.state is AmplifierState.OPERATION_ENABLED
        if level > _SILENT or is_enabled:
            return f"{name} in {amplifier.state.name} plays {level:.4f} until {ends - now:.4f} s on"
        return ""

    async def judge(self, outcomes: Mapping[str, StopOutcome], *, scene: str) -> None:
        """Compare the outcomes of a stop with the amplifiers, now and until all is silent."""
        loop = asyncio.get_running_loop()
        stopped_at = loop.time()
        if outcomes.keys() != self.bench.amplifiers.keys():
            self.found.append(f"{scene}: outcomes of {sorted(outcomes)} only")
        certain = [name for name, outcome in outcomes.items() if outcome.is_confirmed]
        self._check(certain, f"{scene}: confirmed silent, but")
        over = [
            name for name, one in outcomes.items() if one.silence is SilenceStatus.WATCHDOG_ELAPSED
        ]
        self.granted.clear()
        await asyncio.sleep(_LATE)
        self._check([*certain, *over], f"{scene}: said to be silent, but afterwards")
        for name, request, reply in self.granted:
            if name in certain and _enables(request, reply):
                self.found.append(f"{scene}: {name} confirmed silent, then took {request}")
        for name, one in outcomes.items():
            if one.may_play_until is not None:
                late = one.may_play_until + MAX_DELAY - loop.time()
                await asyncio.sleep(max(0.0, late))
                self._check([name], f"{scene}: {one} at {stopped_at:.4f} s, but afterwards")

    def _check(self, names: list[str], what: str) -> None:
        self.found += [f"{what} {loud}" for name in names if (loud := self.loud(name))]

    async def close(self) -> None:
        """Close the controller and end its loop, unless that hangs after an exception."""
        ending = [asyncio.create_task(self.controller.close())]
        if self.loop is not None:
            self.loop.cancel()
            ending.append(self.loop)
        _, left = await asyncio.wait(ending, timeout=LONGEST)
        if left:
            self.found.append(f"{len(left)} tasks have not ended {LONGEST:g} s after closing")
        for task in ending:
            if task.done() and not task.cancelled():
                task.exception()
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        loop.ends = loop.time() + LONGEST


def _enables(request: Request, reply: Reply) -> bool:
    """Whether a reply grants something after which a channel may play."""
    return isinstance(request, Arm | Stage | Commit | Apply) and not isinstance(reply, Nak)


@asynccontextmanager
async def stop_chain(
    wire: str, amplifiers: int, rng: random.Random, *, is_open: bool = True
) -> AsyncIterator[StopChain]:
    """A chain over a wire, open and disarmed; is_open: else its amplifiers were never opened."""
    loop = asyncio.get_running_loop()
    live_in_memory()
    names = ("west", "east")[:amplifiers]
    rig = make_rig(names, GuardLimits(40.0, 500.0, 0.5))
    bench = Bench(rig, now=loop.time(), make_amplifier=SensedAmplifier)
    devices = [
        SimulatedDevice(
            bench,
            name,
            address=number,
            faults=Faults(begin=loop.time(), seed=rng.randrange(1 << 30)),
        )
        for number, name in enumerate(names, 1)
    ]
    async with open_wires(dict.fromkeys(names, WIRES[wire]), devices) as urls:
        amplifiers = {name: Amplifier(open_backend(url)) for name, url in urls.items()}
        controller = Controller(rig, OneTable(rig.plate), amplifiers=amplifiers)
        chain = StopChain(rng, bench, devices, controller, amplifiers, urls)
        loop.set_exception_handler(
            lambda _, context: chain.unhandled.append(
                f"{context['message']}: {context.get('exception')!r}"
            )
        )
        for device in devices:
            _note_granted(chain, device)
        if is_open:
            await controller.open()
            chain.loop = asyncio.create_task(controller.run())
        try:
            yield chain
        finally:
            chain.recover()
            await chain.close()
            for device in devices:
                device.close()


def _note_granted(chain: StopChain, device: SimulatedDevice) -> None:
    """Note every request that the amplifier granted and its reply."""
    exchange = device.exchange

    def exchanging(request: Request) -> Reply | None:
        reply = exchange(request)
        if reply is not None:
            chain.granted.append((device.name, request, reply))
        return reply

    device.exchange = exchanging  # type: ignore[method-assign]
