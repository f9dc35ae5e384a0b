"""Rigs simulated in this process, by URLs `sim://RIG.yaml`, each shared by its amplifiers.

The plate deviates from the rig's within its uncertainty, as that of `era sim`. The amplifiers of a
rig that are named are under one plate, as are those of one control socket; the only amplifier of a
rig that is not named has one of its own.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import unquote
from weakref import WeakValueDictionary

from drivers import clock
from drivers.errors import CommandError
from drivers.urls import AmplifierUrl
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.rig import Rig
from sim.bench.bench import Bench, keep_time
from sim.control.context import SimulationContext
from sim.control.server import control_socket
from sim.plant.imperfections import Imperfections, draw_imperfections

_FORM = "sim://RIG.yaml, optionally with ?control=PATH, &amplifier=NAME, and &seed=N or &exact"


class SimulationUrl:
    """A URL `sim://RIG.yaml[?control=PATH][&amplifier=NAME][&seed=N]`; raises CommandError.

    `&exact` in place of a seed, None here: the rig's own plate, with no deviation.
    """

    def __init__(self, url: str) -> None:
        self._url = AmplifierUrl(url, _FORM, ("control", "amplifier", "seed", "exact"))
        options, file = self._url.options, unquote(self._url.place) + self._url.path
        if not file:
            raise self._url.refused("rig file must be named")
        if {"seed", "exact"} <= options.keys():
            raise self._url.refused("seed must not be given with exact")
        self.rig = Path(file)
        self.seed = None if "exact" in options else self._url.whole_option("seed", 0, 10**9, low=0)
        self.control = Path(options["control"]) if options.get("control") else None
        self.amplifier = options.get("amplifier")

    def select(self, names: tuple[str, ...]) -> str:
        """The amplifier that it names, or the only one; raises CommandError."""
        if self.amplifier is None and len(names) == 1:
            return names[0]
        if self.amplifier not in names:
            raise self._url.refused(f"amplifier must be one of {', '.join(names)}")
        return self.amplifier


@asynccontextmanager
async def opened(url: SimulationUrl) -> AsyncIterator[tuple[SimulationContext, str]]:
    """The simulation of a URL while this lasts, and the name of its amplifier.

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
    """That of open amplifiers of the rig and control, or a new one."""
    if url.control is None and url.amplifier is None:
        return _SharedRig(None)
    control = url.control and url.control.resolve()
    key = (url.rig.resolve(), control, url.seed)
    found = _rigs.get(key)
    if found is None:
        found = _rigs[key] = _SharedRig(url.control)
    return found


class _SharedRig:
    """A rig in time and its control, from the first amplifier opened to the last closed."""

    def __init__(self, control: Path | None) -> None:
        self._control = control
        self._lock = asyncio.Lock()
        self._users = 0
        self._context: SimulationContext | None = None
        self._running = contextlib.AsyncExitStack()

    async def acquire(self, rig: Rig, seed: int | None) -> SimulationContext:
        """Use it, made by the first user; raises what making it raises."""
        async with self._lock:
            if self._context is None:
                context = SimulationContext(await asyncio.to_thread(self._make, rig, seed))
                async with contextlib.AsyncExitStack() as stack:
                    if self._control is not None:
                        await stack.enter_async_context(control_socket(context, self._control))
                    task = asyncio.create_task(keep_time(context.bench), name="simulated plate")
                    stack.push_async_callback(_cancel, task)
                    self._running = stack.pop_all()
                self._context = context
            self._users += 1
            return self._context

    async def release(self) -> None:
        """End the use by one; the last one ends the simulation."""
        async with self._lock:
            self._users -= 1
            if self._users == 0:
                self._context = None
                await self._running.aclose()

    def _make(self, rig: Rig, seed: int | None) -> Bench:
        imperfections = Imperfections() if seed is None else draw_imperfections(rig, seed=seed)
        return Bench(rig, now=clock.now(), imperfections=imperfections)


_rigs: WeakValueDictionary[object, _SharedRig] = WeakValueDictionary()
"""Rigs that amplifiers of this process share."""


async def _cancel(task: "asyncio.Task[None]") -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
