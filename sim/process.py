"""The far end as a process: a bench in real time behind its wires, until it is told to end."""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from pathlib import Path

from drivers import clock
from model.rig import Rig
from sim.bench import Bench
from sim.control import control_socket
from sim.fault_file import FaultFile
from sim.finger import Position
from sim.real_time import keep_time
from sim.station import Station
from sim.wires import Wire, open_wire

_VIEW_EVERY = 0.2  # s; a person reads no faster


async def run_far_end(
    rig: Rig,
    *,
    wire: Wire,
    faults: FaultFile,
    fingers: Mapping[str, Position],
    control: Path | None,
    ready: Callable[[Mapping[str, str]], None],
    view: Callable[[Bench], None] | None,
    until_eof: bool = False,
) -> None:
    """Simulate a rig on a wire until SIGTERM or SIGINT, or the end of standard input.

    faults: what goes wrong, counted from when the URLs are there;
    fingers rest where they are told [m]; control: where the control socket is served, if anywhere;
    ready is called once with the URL of each amplifier by its name, view a few times a second.
    until_eof: whether standard input counts. Raises InputError, LinkError.
    """
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    if until_eof:
        # A thread, for a loop cannot wait for every kind of standard input.
        threading.Thread(target=_await_eof, args=(loop, ended), daemon=True).start()
    bench = await asyncio.to_thread(Bench, rig, now=clock.now())
    bench.place_fingers(fingers, now=clock.now())
    async with contextlib.AsyncExitStack() as stack:
        if control is not None:
            await stack.enter_async_context(control_socket(bench, control))
        stations = [
            Station(bench, name, number=number, faults=faults.of(name, begin=clock.now()))
            for number, name in enumerate(bench.amplifiers, start=1)
        ]
        urls = await stack.enter_async_context(open_wire(wire, stations))
        for station in stations:
            stack.callback(station.close)
            station.start()
        await stack.enter_async_context(_in_background(keep_time(bench), ended))
        if view is not None:
            await stack.enter_async_context(_in_background(_keep_viewing(bench, view), ended))
        ready(urls)
        await ended.wait()


def _await_eof(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    """Read standard input to its end, which the system brings about when a parent dies."""
    with contextlib.suppress(OSError):  # closed from the first is at its end, too
        while os.read(0, 4096):
            pass
    with contextlib.suppress(RuntimeError):  # the loop has closed for another reason
        loop.call_soon_threadsafe(ended.set)


async def _keep_viewing(bench: Bench, view: Callable[[Bench], None]) -> None:
    while True:
        view(bench)
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
