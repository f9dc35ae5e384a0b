"""The backend of `sim://`: a simulated amplifier of protocol 2 in this process.

Not modelled: transmission time.
"""

import contextlib
from collections.abc import Callable
from typing import cast

from drivers import clock
from drivers.backend import Backend
from drivers.errors import LinkError
from drivers.guard import require_safe
from drivers.protocol.messages import AmplifierEvent, Reply, Request
from drivers.statistics import WireCounters
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.shared_rig import SimulationUrl, opened


class SimulatedBackend(Backend):
    """An amplifier of the rig in a URL; see `SimulationUrl`."""

    def __init__(self, url: str) -> None:
        self._url = SimulationUrl.parse(url)
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
        async with contextlib.AsyncExitStack() as stack:
            context, name = await stack.enter_async_context(opened(self._url, SensedAmplifier))
            listeners = context.bench.amplifiers[name].listeners
            listeners.append(self._forward)
            stack.callback(listeners.remove, self._forward)
            self._bench, self._name = context.bench, name
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
            raise LinkError(f"{self._url.text} is not open")
        self._last_sent_at = clock.now()
        self._counters.frames_out += 1
        self._counters.frames_in += 1
        return cast(Reply, self._bench.exchange(self._name, request, now=self._last_sent_at))

    def _forward(self, event: AmplifierEvent, moment: float) -> None:
        self._counters.events += 1
        self._on_event(event)
