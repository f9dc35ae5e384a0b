"""Simulated amplifiers in this process, by URLs `sim://RIG.yaml`; amplifiers share their rig.

As in `era sim`, the plate is drawn at random from the rig's tolerances. All named amplifiers of a
rig drive the same plate, as do all amplifiers with the same control socket; the only amplifier of a
rig, if not named, has a separate plate. Requests and replies are the bytes of a serial line, with
the delays of a USB adapter where a rig has several amplifiers. Not modeled: transmission time.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import ClassVar
from urllib.parse import unquote
from weakref import WeakValueDictionary

from drivers.errors import CommandError, LinkError
from drivers.urls import SIMULATED, AmplifierUrl
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Scheme, WireAddress
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from registry import threads
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench, keep_time
from sim.control import SimulationContext, control_socket, in_background
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.plant.imperfections import Imperfections, draw_imperfections
from sim.transport.simulated_line import LineDelays, TwoWayLine, delays_of

_FORM = (
    "sim://RIG.yaml, optionally with ?control=PATH, &amplifier=NAME, &line=KIND, and &seed=N or "
    "&exact"
)


class SimulationUrl:
    """A URL `sim://RIG.yaml[?control=PATH][&amplifier=NAME][&line=KIND][&seed=N]`.

    `&exact` in place of a seed, None here: the nominal plate, without errors. Raises
    CommandError.
    """

    def __init__(self, url: str) -> None:
        self._url = AmplifierUrl(url, _FORM, ("control", "amplifier", "seed", "exact"))
        options = self._url.options
        file = unquote(self._url.place, errors="surrogateescape") + self._url.path
        self._url.require(bool(file), "rig file must be named")
        self._url.require(
            not self._url.number, f"amplifier must be given as ?amplifier={self._url.number}"
        )
        self._url.require(
            not {"seed", "exact"} <= options.keys(), "seed must not be given with exact"
        )
        self.rig = Path(file)
        self.seed = None if "exact" in options else self._url.whole_option("seed", 0, 10**9, low=0)
        self.control = Path(options["control"]) if options.get("control") else None
        self.amplifier = options.get("amplifier")
        self.line_kind = options.get("line")

    def delays(self, rig: Rig, amplifier: str) -> LineDelays | None:
        """Delays of an amplifier's line; the usual ones if the rig has several amplifiers."""
        kind = self.line_kind or (SIMULATED if len(rig.amplifiers) > 1 else None)
        return delays_of(kind, self.seed, amplifier)

    def select(self, names: tuple[str, ...]) -> str:
        """The amplifier that it names, or the only one; raises CommandError."""
        if self.amplifier is None and len(names) == 1:
            return names[0]
        if self.amplifier not in names:
            raise self._url.refused(f"amplifier must be one of {', '.join(names)}")
        return self.amplifier


@asynccontextmanager
async def _opened(url: SimulationUrl) -> AsyncIterator[tuple[SimulationContext, str]]:
    """The running simulation of a URL, and the name of its amplifier.

    Raises CommandError, LinkError.
    """
    try:
        rig = load_rig(url.rig)
        name = url.select(tuple(rig.amplifiers))
        shared = _shared(url)
        context = await shared.acquire(rig, url.seed)
    except (InputError, OSError) as error:
        raise CommandError(f"sim://{url.rig}: {error}") from error
    try:
        yield context, name
    finally:
        await shared.release()


def _shared(url: SimulationUrl) -> "_SharedRig":
    """Return the simulation of open amplifiers of this rig and control, or a new one."""
    if url.control is None and url.amplifier is None:
        return _SharedRig(None)
    control = url.control and url.control.resolve()
    key = (url.rig.resolve(), control, url.seed)
    shared = _rigs.get(key)
    if shared is None:
        shared = _SharedRig(url.control)
        _rigs[key] = shared
    return shared


class _SharedRig:
    """A rig in time and its control, from the first amplifier opened to the last closed."""

    def __init__(self, control: Path | None) -> None:
        self._control = control
        self._lock = asyncio.Lock()
        self._users = 0
        self._context: SimulationContext | None = None
        self._running = contextlib.AsyncExitStack()

    async def acquire(self, rig: Rig, seed: int | None) -> SimulationContext:
        """Use the simulation, which the first user starts; raises InputError, LinkError."""
        async with self._lock:
            if self._context is None:
                context = SimulationContext(await asyncio.to_thread(self._make, rig, seed))
                async with contextlib.AsyncExitStack() as stack:
                    if self._control is not None:
                        await stack.enter_async_context(control_socket(context, self._control))
                    await stack.enter_async_context(in_background(keep_time(context.bench)))
                    self._running = stack.pop_all()
                self._context = context
            self._users += 1
            return self._context

    async def release(self) -> None:
        """End the use by one user; the last user ends the simulation."""
        async with self._lock:
            self._users -= 1
            if self._users == 0:
                self._context = None
                await self._running.aclose()

    def _make(self, rig: Rig, seed: int | None) -> Bench:
        imperfections = Imperfections() if seed is None else draw_imperfections(rig, seed=seed)
        return Bench(rig, now=threads.now(), imperfections=imperfections)


_rigs: WeakValueDictionary[object, _SharedRig] = WeakValueDictionary()
"""Rigs that amplifiers of this process share."""


class MemoryPort:
    """The port of a host, with devices at their addresses at the other end.

    It works in the running event loop. on_data: called with bytes of the devices; on_loss: called
    once with the cause when the first device is unplugged; delays: see `TwoWayLine`. Raises
    LinkError while the first device is unplugged.
    """

    is_blocked = False

    def __init__(
        self,
        devices: Sequence[AmplifierDevice],
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
        delays: LineDelays | None = None,
    ) -> None:
        self._first = devices[0]
        if not self._first.is_plugged:
            raise LinkError(f"amplifier {self._first.name} is unplugged")
        self._on_data = on_data
        self._on_loss = on_loss
        amplifiers = {device.address: device for device in devices}
        self._wire = TwoWayLine(self._deliver, faults=self._first.faults, delays=delays)
        self._end = SerialAmplifiers(amplifiers, self._wire.outward.send)
        self._wire.to_amplifier = self._end.receive
        self.running = contextlib.AsyncExitStack()
        """Contexts that end with the port."""
        self._is_open = True
        self._first.plug_listeners.append(self._plug)

    def write(self, data: bytes) -> None:
        """Send bytes to the amplifiers; raises LinkError if it is lost."""
        if not self._is_open:
            raise LinkError(f"amplifier {self._first.name} was unplugged")
        self._wire.inward.send(data)

    def poll(self) -> None:
        """Do nothing: received bytes were already delivered."""

    def close(self) -> None:
        """Close it; disarm before, or vibrations continue until the watchdogs trip."""
        if self._is_open:
            self._is_open = False
            self._first.plug_listeners.remove(self._plug)
            self._end.close()
            self._wire.close()

    async def wait_closed(self) -> None:
        """End the contexts of the port."""
        await self.running.aclose()

    def _deliver(self, data: bytes) -> None:
        # Never while the host still writes the request.
        asyncio.get_running_loop().call_soon(self._arrived, data)

    def _arrived(self, data: bytes) -> None:
        if self._is_open:
            self._on_data(data)

    def _plug(self, is_plugged: bool) -> None:
        if not is_plugged:
            self.close()
            self._on_loss(f"amplifier {self._first.name} was unplugged")


class SimulatedAddress(WireAddress):
    """An amplifier of a rig simulated in this process, alone on its line; see `SimulationUrl`."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "sim": Scheme(
            line_kind=SIMULATED,
            example="sim://RIG.yaml",
            help="a simulated amplifier of a rig",
            number="`?amplifier=NAME`",
            forms={
                "sim://RIG": "`seed` 0 or `exact`, `control`: [simulated hardware]"
                "(../how-to/simulated-hardware.md). In a rig file, `sim://` alone simulates this "
                "rig"
            },
        )
    }

    def __init__(self, url: str) -> None:
        self._url = SimulationUrl(url)
        self.line = url
        self.number = 1
        self.settings = {"protocol": "serial"}

    def make_wire(self) -> SerialWire:
        """Make the wire with a random number, so that a reply to an earlier host does not match."""
        return SerialWire(0, sequence=random.getrandbits(16))

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> MemoryPort:
        """Simulate the rig, its plate at rest, or share it; raises CommandError, LinkError.

        The last port of a rig that is closed ends its simulation.
        """
        async with contextlib.AsyncExitStack() as stack:
            context, name = await stack.enter_async_context(_opened(self._url))
            device = context.devices.get(name)
            if not isinstance(device, AmplifierDevice):
                device = AmplifierDevice(context.bench, name)
                context.devices = {**context.devices, name: device}
            delays = self._url.delays(context.bench.rig, name)
            port = MemoryPort([device], on_data, on_loss, delays)
            port.running = stack.pop_all()
            return port
