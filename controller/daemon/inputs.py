"""Touch sources of the configuration, each by its name, and clients of the API as another kind."""

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import replace

from controller.api.methods import TouchParams
from controller.daemon.config import API_SOURCES, TouchInput
from controller.sources.touch import Touch, TouchFrame
from drivers.operation.pauses import pauses
from model.errors import InputError
from model.structure.plate import Plate

_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 30.0  # s; before a source that failed is begun again
MOST_SOURCES = 64  # of one client, with fingers down: a gateway has many guests

_logger = logging.getLogger(__name__)


class TouchInputs:
    """Runs touch sources side by side, and exchanges them while others run on.

    deliver takes their frames, whose source names begin with the name in the configuration; failed
    is told where one ends with an error, and it is begun again after a pause that grows. What a
    source that is gone said last expires by itself.
    """

    def __init__(
        self,
        deliver: Callable[[TouchFrame], None],
        *,
        failed: Callable[[str, Exception], None],
    ) -> None:
        self._deliver = deliver
        self._failed = failed
        self._running: dict[TouchInput, asyncio.Task[None]] = {}

    async def exchange(self, inputs: Iterable[TouchInput]) -> None:
        """Run these and no others; those that run already are left alone."""
        wanted = list(inputs)
        for old in [each for each in self._running if each not in wanted]:
            task = self._running.pop(old)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        for new in wanted:
            if new not in self._running:
                self._running[new] = asyncio.create_task(self._run(new), name=f"touch {new.name}")

    async def close(self) -> None:
        """Run none."""
        await self.exchange(())

    async def _run(self, given: TouchInput) -> None:
        def named(frame: TouchFrame) -> None:
            # Whoever sends datagrams names itself; the name is shown on terminals.
            source = frame.source if frame.source.isprintable() else ascii(frame.source)
            self._deliver(replace(frame, source=f"{given.name}:{source}"))

        for pause in pauses(first=_FIRST_PAUSE, longest=_LONGEST_PAUSE):
            try:
                await given.make().run(named)
            except Exception as error:
                self._failed(given.name, error)
            else:
                _logger.info("touch source %s has come to its end", given.name)
                return
            await asyncio.sleep(pause)  # a panel may be plugged in later, a port become free


class ApiTouches:
    """Touch frames of API clients: the newest of each source, delivered once a turn of the loop."""

    def __init__(self, plate: Plate, deliver: Callable[[TouchFrame], None]) -> None:
        self._plate = plate
        self._deliver = deliver
        self._newest: dict[str, TouchFrame] = {}
        self._sources: dict[object, set[str]] = {}
        self._is_due = False

    def take(self, client: object, params: TouchParams, *, client_name: str, now: float) -> None:
        """A frame of a client, that arrived at a time [s]; raises InputError for too many sources.

        Two clients with the same source name are two sources.
        """
        source = f"{API_SOURCES}:{client_name}:{params.source}"
        mine = self._sources.setdefault(client, set())
        if not params.touches:
            mine.discard(source)
        elif source not in mine:
            if len(mine) >= MOST_SOURCES:
                raise InputError(
                    f"a client has fingers of at most {MOST_SOURCES} touch sources; lift some first"
                )
            mine.add(source)
        touches = tuple(
            Touch(point.id, point.x_m / self._plate.length, 1 - point.y_m / self._plate.width)
            for point in params.touches
        )
        self._newest[source] = TouchFrame(source, now, touches)
        self._see_to_delivery()

    def leave(self, client: object, *, now: float) -> None:
        """Lift all that a client has put down; now [s]."""
        for source in self._sources.pop(client, ()):
            self._newest[source] = TouchFrame(source, now, ())
            self._see_to_delivery()

    def _see_to_delivery(self) -> None:
        if not self._is_due:
            self._is_due = True
            asyncio.get_running_loop().call_soon(self._deliver_now)

    def _deliver_now(self) -> None:
        self._is_due = False
        newest, self._newest = self._newest, {}
        for frame in newest.values():
            self._deliver(frame)
