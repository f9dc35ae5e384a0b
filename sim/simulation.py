"""The simulation as a process: a bench behind its wires, until a signal ends it.

Time is that of the event loop: the wall clock, or a virtual clock that is stepped explicitly while
I/O is served as usual. The live view shows amplifiers, peak accelerations and fingers on the
terminal.

The project's firmware may be in place of the simulated amplifiers: a process with a serial line for
each. `make firmware` builds it from the sources of a checkout; it is not part of the wheel. Its
samples go nowhere, so the plate does not move.
"""

import asyncio
import contextlib
import os
import selectors
import signal
import threading
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from drivers.errors import LinkError
from model.arrays import FloatArray, Point, lattice
from model.errors import InputError
from model.rig.rig import Rig
from model.vibration import G
from registry import threads
from registry.threads import no_long_collections
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench, keep_time
from sim.control import SimulationContext, control_socket, in_background
from sim.far_ends.wire_assignment import SimulatedWire, open_wires
from sim.faults import FaultFile
from sim.plant.fingers import Accelerometer
from sim.plant.imperfections import Imperfections
from sim.plant.plant import PLANT_SAMPLE_RATE
from sim.transport.far_end import linked_urls

FIRMWARE_FOLDER = Path(__file__).parents[1] / "out" / "firmware"
"""Where `make firmware` puts its programs."""

_STARTUP_TIMEOUT = 10.0  # s


def find_firmware() -> Path:
    """The built firmware, a program; InputError where there is none."""
    program = FIRMWARE_FOLDER / "era-firmware"
    if program.exists():
        return program
    if (FIRMWARE_FOLDER.parents[1] / "firmware").is_dir():
        raise InputError(f"firmware: {program} does not exist; run `make firmware` first")
    raise InputError(
        "firmware: its C sources are not part of this installation; run from a checkout of "
        "era-haptics, after `make firmware`"
    )


@contextlib.asynccontextmanager
async def running_firmware(program: Path, name: str) -> AsyncIterator[str]:
    """Run the firmware for an amplifier, yield its URL. Raises LinkError.

    It ends with this process, also if that is killed: its standard input is at its end then.
    """
    process = await asyncio.create_subprocess_exec(
        program,
        "--serial",
        "--until-eof",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(_STARTUP_TIMEOUT):
            url = (await process.stdout.readline()).decode().strip()
        if not url.startswith("serial://"):
            raise LinkError(f"firmware of {name}: no line was opened, got {url!r}")
        yield url
    except TimeoutError:
        raise LinkError(f"firmware of {name}: not ready in {_STARTUP_TIMEOUT:g} s") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


STEP = 0.005  # s; the largest delay of a timer


class SteppedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time begins at 0 s."""

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


_VIEW_INTERVAL = 0.2  # s


@dataclass(frozen=True)
class Simulation:
    """A rig and the wires of its amplifiers, by name.

    faults: with times from when the URLs are printed; fingers: initial positions [m];
    imperfections: in what the bench differs from the rig; sample_rate [Hz]: of sensors and fingers;
    control: path of the control socket; record: file for the readings of the whole run; until_eof:
    end with standard input; firmware: in the place of the simulated amplifiers; links: to their
    pseudo-terminals.
    """

    rig: Rig
    wires: Mapping[str, SimulatedWire]
    faults: FaultFile = field(default_factory=lambda: FaultFile(faults=[]))
    fingers: Mapping[str, Point] = field(default_factory=dict)
    imperfections: Imperfections = field(default_factory=Imperfections)
    sensors: Sequence[Accelerometer] = ()
    sample_rate: float = PLANT_SAMPLE_RATE
    control: Path | None = None
    record: Path | None = None
    until_eof: bool = False
    firmware: Path | None = None
    links: Mapping[str, Path] = field(default_factory=dict)


def make_fine_loop() -> asyncio.AbstractEventLoop:
    """Make an event loop with timers to microseconds: by default they are late by up to 1 ms."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


async def run_simulation(
    simulation: Simulation,
    *,
    ready: Callable[[Mapping[str, str]], None],
    view: Callable[[SimulationContext], None] | None,
) -> str | None:
    """Simulate until SIGTERM, SIGINT or SIGHUP, or the end of standard input.

    ready is called once with the URLs by amplifier, view a few times a second. Time is virtual in a
    `SteppedLoop`. Returns a message about the file written. Raises InputError, LinkError.
    """
    import termios  # noqa: F401  # fails where there are neither terminals nor these signals

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
        sample_rate=simulation.sample_rate,
        imperfections=simulation.imperfections,
    )
    if ended.is_set():
        return None
    bench.place_fingers(simulation.fingers, now=threads.now())
    context = SimulationContext(bench, step=loop.step if isinstance(loop, SteppedLoop) else None)
    context.accelerometers.place(simulation.sensors)
    if simulation.record is not None:
        context.record(simulation.record)
    try:
        await _serve(simulation, context, ended=ended, ready=ready, view=view)
    finally:
        message = await context.finish_recording()
    return message


async def _serve(
    simulation: Simulation,
    context: SimulationContext,
    *,
    ended: asyncio.Event,
    ready: Callable[[Mapping[str, str]], None],
    view: Callable[[SimulationContext], None] | None,
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
        if view is not None:
            viewing = _keep_viewing(context, view)
            await stack.enter_async_context(in_background(viewing, ended.set))
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
    """Read standard input until its end, which also comes when the parent dies."""
    with contextlib.suppress(OSError):  # closed already
        while os.read(0, 4096):
            pass
    with contextlib.suppress(RuntimeError):  # the loop is closed already
        loop.call_soon_threadsafe(ended.set)


async def _keep_viewing(
    context: SimulationContext, view: Callable[[SimulationContext], None]
) -> None:
    while True:
        view(context)
        await asyncio.sleep(_VIEW_INTERVAL)


_WINDOW = 0.2  # s; of the peaks shown for fingers
_SHADES = " ·-+*#@"
_FULL = 5.0  # g; the last shade
_THRESHOLD = 0.002  # of _FULL; smaller values are not drawn
_COLUMNS, _ROWS = 28, 10
_DECAY = 0.5  # of the peaks per picture


class SimulationView:
    """Peak accelerations over a lattice of the plate (rows, columns) [m/s²], fading with time."""

    def __init__(self, bench: Bench) -> None:
        plate = bench.rig.plate
        x = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * plate.length
        y = (np.arange(_ROWS) + 0.5) / _ROWS * plate.width
        self.begun = bench.time  # s
        self._bench = bench
        self._points = lattice(x, y)
        self._peaks = np.zeros(len(self._points))

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its points, in the present coordinates of the plate."""
        return self._bench.shapes_at(self._points)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Keep the peaks of accelerations (n, p) [m/s²]."""
        np.maximum(self._peaks, np.abs(accelerations).max(axis=0), out=self._peaks)

    def take(self) -> FloatArray:
        """Return the peaks and fade them."""
        peaks = self._peaks.copy()
        self._peaks *= _DECAY
        return peaks.reshape(_ROWS, _COLUMNS)


def render_simulation(context: SimulationContext, plate: SimulationView) -> RenderableType:
    """Render the present state; without fingers it fits on 24 lines of 80 columns."""
    bench = context.bench
    amplifiers = Table("amplifier", "state", "fault", "set", "level of each channel")
    for name, amplifier in bench.amplifiers.items():
        summary = amplifier.summary(bench.time)
        levels = "  ".join(f"{level:4.0%}" for level in summary.levels)
        amplifiers.add_row(name, summary.state, summary.fault, str(summary.token), levels)
    fingers = Table("finger", "at", "peak acceleration")
    felt = bench.felt(bench.time - _WINDOW, bench.time)
    for name, (x, y) in bench.positions.items():
        peak = f"{felt[name].peak.max() / G:.2f} g" if name in felt else ""
        fingers.add_row(name, f"{x * 1000:.0f}, {y * 1000:.0f} mm", peak)
    footer = [f"{bench.time - plate.begun:.1f} s"]
    if context.recorder is not None:
        full = ", full" if context.recorder.is_full else ""
        footer.append(f"recording {context.recorder.path}: {context.recorder.seconds:.1f} s{full}")
    touched = [fingers] if fingers.row_count else []
    return Group(amplifiers, _picture(bench, plate.take()), *touched, Text("   ".join(footer)))


def _picture(bench: Bench, peaks: FloatArray) -> Text:
    """The plate with y upwards; O are fingers, E are ERAs."""
    share = np.maximum(peaks / (_FULL * G) - _THRESHOLD, 0)
    shade = np.ceil(share * (len(_SHADES) - 1)).astype(int)
    rows = [[_SHADES[min(cell, len(_SHADES) - 1)] for cell in row] for row in shade]
    size = bench.rig.plate.length, bench.rig.plate.width
    places = [((era.x, era.y), "E") for era in bench.rig.eras]
    places += [(at, "O") for at in bench.positions.values()]
    for (x, y), mark in places:
        column = min(int(x / size[0] * _COLUMNS), _COLUMNS - 1)
        rows[min(int(y / size[1] * _ROWS), _ROWS - 1)][column] = mark
    bar = "+" + "-" * _COLUMNS + "+"
    lines = [bar, *(f"|{''.join(row)}|" for row in reversed(rows)), bar]
    legend = f"peak acceleration: {_SHADES[1]} to {_SHADES[-1]} up to {_FULL:g} g; E ERA, O finger"
    return Text("\n".join([*lines, legend]))
