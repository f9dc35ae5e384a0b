"""The simulation as a process: a bench behind its wires, until a signal ends it.

Uses the time of the event loop: the wall clock, or a virtual clock stepped explicitly while I/O is
served as usual.
"""

import asyncio
import contextlib
import os
import selectors
import signal
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from model.arrays import Point
from model.rig.rig import Rig
from registry import threads
from registry.threads import no_long_collections
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench, keep_time
from sim.control import SimulationContext, control_socket, in_background
from sim.far_ends.firmware import Firmware, running_firmware
from sim.far_ends.wire_assignment import SimulatedWire, open_wires
from sim.faults import FaultFile
from sim.plant.imperfections import Imperfections
from sim.transport.terminal_links import linked_urls

STEP = 0.005  # s of virtual time; the largest delay of a timer


class SteppedLoop(asyncio.SelectorEventLoop):
    """An event loop with virtual time, which begins at 0 s."""

    def __init__(self) -> None:
        self._now = 0.0
        super().__init__()

    def time(self) -> float:
        """The present virtual time [s]."""
        return self._now

    async def step(self, seconds: float) -> None:
        """Advance the time by so many seconds, and run the timers due in it."""
        end = self._now + seconds
        while self._now < end:
            self._now = min(self._now + STEP, end)
            # Twice: a due timer may schedule another call.
            await asyncio.sleep(0)
            await asyncio.sleep(0)


@dataclass(frozen=True)
class Simulation:
    """A rig and the wires of its amplifiers, by name.

    faults: with times from when the URLs are printed; fingers: initial positions [m];
    imperfections: differences between bench and rig; control: path of the control socket;
    until_eof: end with standard input; firmware: to run instead of simulated amplifiers;
    links: to the pseudo-terminals.
    """

    rig: Rig
    wires: Mapping[str, SimulatedWire]
    faults: FaultFile = field(default_factory=lambda: FaultFile(faults=[]))
    fingers: Mapping[str, Point] = field(default_factory=dict)
    imperfections: Imperfections = field(default_factory=Imperfections)
    control: Path | None = None
    until_eof: bool = False
    firmware: Firmware | None = None
    links: Mapping[str, Path] = field(default_factory=dict)


def make_fine_loop() -> asyncio.AbstractEventLoop:
    """Make an event loop with timers to microseconds: by default they are late by up to 1 ms."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


async def run_simulation(
    simulation: Simulation,
    *,
    ready: Callable[[Mapping[str, str]], None],
) -> None:
    """Simulate until SIGTERM, SIGINT or SIGHUP, or the end of standard input.

    ready is called once with the URLs by amplifier. Time is virtual in a `SteppedLoop`. Raises
    InputError, LinkError.
    """
    import termios  # noqa: F401  # fails on systems without terminals and these signals

    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):  # SIGHUP: the terminal closes
        loop.add_signal_handler(number, ended.set)
    if simulation.until_eof:
        # In a thread, since not every kind of standard input can be polled.
        threading.Thread(target=_await_eof, args=(loop, ended), daemon=True).start()
    bench = await asyncio.to_thread(
        Bench,
        simulation.rig,
        now=threads.now(),
        imperfections=simulation.imperfections,
    )
    if ended.is_set():
        return
    bench.place_fingers(simulation.fingers, now=threads.now())
    context = SimulationContext(bench, step=loop.step if isinstance(loop, SteppedLoop) else None)
    await _serve(simulation, context, ended=ended, ready=ready)


async def _serve(
    simulation: Simulation,
    context: SimulationContext,
    *,
    ended: asyncio.Event,
    ready: Callable[[Mapping[str, str]], None],
) -> None:
    """Open the wires and serve until the end."""
    bench = context.bench
    async with contextlib.AsyncExitStack() as stack:
        if simulation.firmware is not None:
            context.urls = {
                name: await stack.enter_async_context(running_firmware(simulation.firmware, name))
                for name in bench.amplifiers
            }
        else:
            await _open_devices(stack, simulation, context)
        context.urls = stack.enter_context(linked_urls(context.urls, simulation.links))
        if simulation.control is not None:
            await stack.enter_async_context(control_socket(context, simulation.control))
        for device in context.devices.values():
            stack.callback(device.close)
            device.start()
        await stack.enter_async_context(in_background(keep_time(bench), ended.set))
        stack.enter_context(no_long_collections())
        ready(context.urls)
        await ended.wait()


async def _open_devices(
    stack: contextlib.AsyncExitStack, simulation: Simulation, context: SimulationContext
) -> None:
    """Put a simulated amplifier on each wire."""
    devices = [
        AmplifierDevice(
            context.bench,
            name,
            address=simulation.wires[name].address or number,
            faults=simulation.faults.of(name, begin=threads.now()),
        )
        for number, name in enumerate(context.bench.amplifiers, start=1)
    ]
    context.urls = await stack.enter_async_context(open_wires(simulation.wires, devices))
    context.devices = {device.name: device for device in devices}


def _await_eof(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    """Read standard input until its end, also reached when the parent process dies."""
    with contextlib.suppress(OSError):  # closed already
        while os.read(0, 4096):
            pass
    with contextlib.suppress(RuntimeError):  # the loop is closed already
        loop.call_soon_threadsafe(ended.set)
