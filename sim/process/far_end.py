"""The far end as a process: a bench behind its wires, until it is told to end."""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from drivers import clock
from drivers.operation.steady import no_long_collections
from model.finger.load import FingerLoad
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.bench.real_time import keep_time
from sim.bench.simulated_device import SimulatedDevice
from sim.control.context import SimulationContext, finish_recording
from sim.control.server import control_socket
from sim.far_ends.wire_choice import Choice
from sim.far_ends.wires import open_wires
from sim.faults.fault_file import FaultFile
from sim.plant.finger import Position
from sim.plant.plant import SAMPLE_RATE
from sim.process.virtual_time import SteppedLoop
from sim.sensors.accelerometer import Accelerometer

_VIEW_EVERY = 0.2  # s; a person reads no faster


@dataclass(frozen=True)
class FarEnd:
    """What is simulated: a rig, and which wire each of its amplifiers is on, by its name.

    faults: what goes wrong, counted from when the URLs are there; fingers rest where they are told
    [m], and load the plate by finger_load, or not at all; sensors are there from the first;
    sample_rate [Hz]: of all that is measured; control: where the control socket is served, record:
    where sensors and fingers are recorded to, from the first to the end; until_eof: whether it ends
    with standard input.
    """

    rig: Rig
    wires: Mapping[str, Choice]
    faults: FaultFile = field(default_factory=lambda: FaultFile(()))
    fingers: Mapping[str, Position] = field(default_factory=dict)
    finger_load: FingerLoad | None = None
    sensors: Sequence[Accelerometer] = ()
    sample_rate: float = SAMPLE_RATE
    control: Path | None = None
    record: Path | None = None
    until_eof: bool = False


async def run_far_end(
    far_end: FarEnd,
    *,
    ready: Callable[[Mapping[str, str]], None],
    view: Callable[[SimulationContext], None] | None,
) -> str | None:
    """Simulate until SIGTERM, SIGINT or SIGHUP, or the end of standard input where that counts.

    ready is called once with the URL of each amplifier by its name, view a few times a second.
    Virtual where the running loop is a `SteppedLoop`. Returns what is to be said of what was
    written. Raises InputError, LinkError.
    """
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):  # the last: a terminal closes
        loop.add_signal_handler(number, ended.set)
    if far_end.until_eof:
        # A thread, for a loop cannot wait for every kind of standard input.
        threading.Thread(target=_await_eof, args=(loop, ended), daemon=True).start()
    bench = await asyncio.to_thread(
        Bench,
        far_end.rig,
        now=clock.now(),
        sample_rate=far_end.sample_rate,
        finger_load=far_end.finger_load,
    )
    if ended.is_set():
        return None
    bench.place_fingers(far_end.fingers, now=clock.now())
    context = SimulationContext(bench, step=loop.step if isinstance(loop, SteppedLoop) else None)
    context.accelerometers.place(far_end.sensors)
    if far_end.record is not None:
        context.record(far_end.record)
    try:
        await _serve(far_end, context, ended=ended, ready=ready, view=view)
    finally:
        said = await finish_recording(context)
    return said


async def _serve(
    far_end: FarEnd,
    context: SimulationContext,
    *,
    ended: asyncio.Event,
    ready: Callable[[Mapping[str, str]], None],
    view: Callable[[SimulationContext], None] | None,
) -> None:
    """Put the amplifiers on their wires, and let time pass until the end."""
    bench = context.bench
    async with contextlib.AsyncExitStack() as stack:
        devices = [
            SimulatedDevice(
                bench,
                name,
                number=far_end.wires[name].number or number,
                faults=far_end.faults.of(name, begin=clock.now()),
            )
            for number, name in enumerate(bench.amplifiers, start=1)
        ]
        wires = {name: choice.wire for name, choice in far_end.wires.items()}
        context.urls = await stack.enter_async_context(open_wires(wires, devices))
        context.devices = {device.name: device for device in devices}
        if far_end.control is not None:
            await stack.enter_async_context(control_socket(context, far_end.control))
        for device in devices:
            stack.callback(device.close)
            device.start()
        await stack.enter_async_context(_in_background(keep_time(bench), ended))
        if view is not None:
            await stack.enter_async_context(_in_background(_keep_viewing(context, view), ended))
        stack.enter_context(no_long_collections())
        ready(context.urls)
        await ended.wait()


def _await_eof(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    """Read standard input to its end, which the system brings about when a parent dies."""
    with contextlib.suppress(OSError):  # closed from the first is at its end, too
        while os.read(0, 4096):
            pass
    with contextlib.suppress(RuntimeError):  # the loop has closed for another reason
        loop.call_soon_threadsafe(ended.set)


async def _keep_viewing(
    context: SimulationContext, view: Callable[[SimulationContext], None]
) -> None:
    while True:
        view(context)
        await asyncio.sleep(_VIEW_EVERY)


@asynccontextmanager
async def _in_background(
    work: Coroutine[None, None, None], ended: asyncio.Event
) -> AsyncIterator[None]:
    """Work beside everything else; where it fails, the far end ends with that failure."""
    task = asyncio.create_task(work)
    task.add_done_callback(lambda _: ended.set())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
