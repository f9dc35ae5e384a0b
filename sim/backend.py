"""The backend of `sim://`: a simulated amplifier in this process.

The plate deviates from the rig's within its uncertainty, as that of `era sim`. The amplifiers of a
rig that are named are under one plate, as are those of one control socket; the only amplifier of a
rig that is not named has one of its own. Not modelled: transmission time.
"""

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from urllib.parse import parse_qsl, unquote
from weakref import WeakValueDictionary

from drivers import clock
from drivers.backend import Backend
from drivers.errors import CommandError, LinkError
from drivers.guard import require_safe
from drivers.protocol.messages import AmplifierEvent, Reply, Request
from drivers.statistics import WireCounters
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.rig import Rig
from sim.bench.bench import Bench, keep_time
from sim.control.context import SimulationContext
from sim.control.server import control_socket
from sim.plant.imperfections import Imperfections, draw_imperfections

_FORM = "sim://RIG.yaml, optionally with ?control=PATH, &amplifier=NAME, and &seed=N or &exact"


class SimulatedBackend(Backend):
    """An amplifier of the rig in a URL `sim://RIG.yaml[?control=PATH][&amplifier=NAME][&seed=N]`.

    `&exact` in place of a seed: the rig's own plate, with no deviation.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        path, _, query = url.removeprefix("sim://").partition("?")
        options = dict(parse_qsl(query, keep_blank_values=True))
        unknown = sorted(options.keys() - {"control", "amplifier", "seed", "exact"})
        if not url.startswith("sim://") or not path or unknown:
            what = f"unknown option {', '.join(unknown)}" if unknown else "no rig file"
            raise CommandError(f"{url!r}: {what}; use {_FORM}")
        self._rig = Path(unquote(path))
        self._control = Path(options["control"]) if options.get("control") else None
        self._amplifier = options.get("amplifier")
        self._is_exact, seed = "exact" in options, options.get("seed", "0")
        if not seed.isdecimal() or (self._is_exact and "seed" in options):
            raise CommandError(f"{url!r}: seed must be a whole number, without exact; use {_FORM}")
        self._seed = int(seed)
        self._open: contextlib.AsyncExitStack | None = None
        self._bench: Bench | None = None
        self._name = ""
        self._last_sent_at = 0.0
        self._counters = WireCounters()
        self._on_event: Callable[[AmplifierEvent], None] = lambda event: None

    @property
    def counters(self) -> WireCounters:
        """Counters of requests and replies."""
        return self._counters

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Register the callback for events; a link in this process is never lost."""
        self._on_event = on_event

    @property
    def last_sent_at(self) -> float:
        """Time of the last request, by time.monotonic() [s]."""
        return self._last_sent_at

    async def open(self) -> None:
        """Load the rig, its plate at rest; raises CommandError."""
        if self._open is not None:
            return
        try:
            rig = load_rig(self._rig)
            name = self._select(tuple(rig.amplifiers))
            plate = self._plate()
            bench = await plate.acquire(partial(self._bench_of, rig))
        except (InputError, OSError) as error:
            raise CommandError(f"{self._url}: {error}") from error
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(plate.release)
            listeners = bench.amplifiers[name].listeners
            listeners.append(self._forward)
            stack.callback(listeners.remove, self._forward)
            self._bench, self._name = bench, name
            self._open = stack.pop_all()

    async def close(self) -> None:
        """End the simulation."""
        stack, self._open = self._open, None
        self._bench = None
        if stack is not None:
            await stack.aclose()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Exchange a request; raises LinkError if not open."""
        require_safe(request)
        if self._bench is None:
            raise LinkError(f"{self._url} is not open")
        self._last_sent_at = clock.now()
        self._counters.frames_out += 1
        self._counters.frames_in += 1
        return self._bench.exchange(self._name, request, now=self._last_sent_at)

    def _plate(self) -> "_Plate":
        """The plate of this URL: that of open amplifiers of the rig and control, or a new one."""
        if self._control is None and self._amplifier is None:
            return _Plate(None)
        control = self._control and self._control.resolve()
        key = (self._rig.resolve(), control, self._is_exact, self._seed)
        found = _plates.get(key)
        if found is None:
            found = _plates[key] = _Plate(self._control)
        return found

    def _bench_of(self, rig: Rig) -> Bench:
        imperfections = (
            Imperfections() if self._is_exact else draw_imperfections(rig, seed=self._seed)
        )
        return Bench(rig, now=clock.now(), imperfections=imperfections)

    def _forward(self, event: AmplifierEvent, moment: float) -> None:
        self._counters.events += 1
        self._on_event(event)

    def _select(self, names: tuple[str, ...]) -> str:
        if self._amplifier is None and len(names) == 1:
            return names[0]
        if self._amplifier in names:
            return self._amplifier
        raise CommandError(f"{self._url}: amplifier=NAME must name one of {', '.join(names)}")


class _Plate:
    """A plate in time and its control, from the first amplifier opened to the last closed."""

    def __init__(self, control: Path | None) -> None:
        self._control = control
        self._lock = asyncio.Lock()
        self._users = 0
        self._bench: Bench | None = None
        self._running = contextlib.AsyncExitStack()

    async def acquire(self, make: Callable[[], Bench]) -> Bench:
        """Use the bench, made by the first user; raises what making it raises."""
        async with self._lock:
            if self._bench is None:
                bench = await asyncio.to_thread(make)
                async with contextlib.AsyncExitStack() as stack:
                    if self._control is not None:
                        context = SimulationContext(bench)
                        await stack.enter_async_context(control_socket(context, self._control))
                    task = asyncio.create_task(keep_time(bench), name="simulated plate")
                    stack.push_async_callback(_cancel, task)
                    self._running = stack.pop_all()
                self._bench = bench
            self._users += 1
            return self._bench

    async def release(self) -> None:
        """End the use by one; the last one ends the simulation."""
        async with self._lock:
            self._users -= 1
            if self._users == 0:
                self._bench = None
                await self._running.aclose()


_plates: WeakValueDictionary[tuple[Path, Path | None, bool, int], _Plate] = WeakValueDictionary()
"""Plates that amplifiers of this process share."""


async def _cancel(task: "asyncio.Task[None]") -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
