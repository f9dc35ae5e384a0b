"""Touch inputs of the daemon: the configured sources, and the touches of API clients."""

import asyncio
import logging
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial

from controller.api.methods import TouchParams
from controller.daemon.config import API_SOURCES, TouchInput
from controller.daemon.deferred_calls import call_guarded
from controller.sources.touch import Touch, TouchFrame
from drivers import clock
from drivers.pauses import Backoff
from drivers.threads import in_thread
from model.errors import InputError
from model.structure.plate import Plate
from registry.plugins import failure_text

_MIN_PAUSE, _MAX_PAUSE = 1.0, 30.0  # s; before a failed source is restarted
_CLOSE_TIMEOUT = 0.2  # s
MAX_SOURCES_PER_CLIENT = 64  # with fingers down
_SOURCE_TIMEOUT = 1.0  # s; without a frame, after which a source has no finger down any more

_logger = logging.getLogger(__name__)


class TouchInputs:
    """Runs touch sources concurrently.

    deliver receives their frames, each source name prefixed with the configured name. A source that
    fails is restarted after a growing pause.
    """

    def __init__(self, deliver: Callable[[TouchFrame], None]) -> None:
        self._deliver = deliver
        self._running: list[asyncio.Task[None]] = []

    def start(self, inputs: Iterable[TouchInput]) -> None:
        """Run these sources until `close`."""
        self._running += [
            asyncio.create_task(self._run(each), name=f"touch {each.name}") for each in inputs
        ]

    async def close(self) -> None:
        """Stop all sources; one of a plug-in that goes on is ended where it waits."""
        for task in self._running:
            task.cancel()
        if not self._running:
            return
        _, late = await asyncio.wait(self._running, timeout=_CLOSE_TIMEOUT)
        for task in late:  # else the end of the program would wait for it
            _logger.warning("%s: does not end when cancelled", task.get_name())
            with suppress(Exception):  # it ignores this as well, or fails
                task.get_coro().close()
            task.cancel()
        ends = asyncio.gather(*late, return_exceptions=True)
        await asyncio.wait([ends], timeout=_CLOSE_TIMEOUT)

    async def _run(self, touch_input: TouchInput) -> None:
        def deliver(frame: TouchFrame) -> None:
            # The sender chooses the name, which is printed on terminals.
            source = frame.source if frame.source.isprintable() else ascii(frame.source)
            self._deliver(replace(frame, source=f"{touch_input.name}:{source}"))

        backoff = Backoff(_MIN_PAUSE, _MAX_PAUSE)
        while True:
            started_at = clock.now()
            try:
                # A plug-in may block.
                source = await in_thread(touch_input.make, name="touch source")
                await source.run(deliver)
            except Exception as error:
                is_expected = isinstance(error, InputError | OSError)
                text = str(error) if is_expected else failure_text(error)
                _logger.error("touch source %s: failed, restarting: %s", touch_input.name, text)
            else:
                _logger.info("touch source %s: finished", touch_input.name)
                return
            # A panel may be plugged in later, a port be released.
            await asyncio.sleep(backoff.pause(ran_for=clock.now() - started_at))


class ApiTouches:
    """Touch frames of API clients, each delivered in its turn; which clients have fingers down."""

    def __init__(self, plate: Plate, deliver: Callable[[TouchFrame], None]) -> None:
        self._plate = plate
        self._deliver = deliver
        # With fingers down, and the time [s] of the last frame.
        self._sources: dict[object, dict[str, float]] = {}

    def add(self, client: object, params: TouchParams, *, client_name: str, now: float) -> None:
        """Add a frame that arrived at a time [s]; raises InputError for too many sources.

        The same source name of two clients denotes two sources.
        """
        source = f"{API_SOURCES}:{client_name}:{params.source}"
        sources = self._sources.setdefault(client, {})
        sources.pop(source, None)
        if params.touches:
            for old in [each for each in sources if now - sources[each] > _SOURCE_TIMEOUT]:
                del sources[old]
            if len(sources) >= MAX_SOURCES_PER_CLIENT:
                raise InputError(
                    f"a client must have at most {MAX_SOURCES_PER_CLIENT} touch sources with "
                    "fingers down; lift some first"
                )
            sources[source] = now
        touches = tuple(
            Touch(point.id, point.x_m / self._plate.length, 1 - point.y_m / self._plate.width)
            for point in params.touches
        )
        self._deliver(TouchFrame(source, now, touches, origin=f"{API_SOURCES}:{client_name}"))

    def lift_all(self, client: object, *, now: float) -> None:
        """Lift all fingers of a client at a time [s], whatever fails at one of its sources."""
        for source in self._sources.pop(client, ()):
            call_guarded(partial(self._deliver, TouchFrame(source, now, ())))
