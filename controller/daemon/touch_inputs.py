"""Touch inputs of the daemon: the configured sources."""

import asyncio
import logging
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

from controller.daemon.config import TouchInput
from controller.sources.touch import ALIGNED, TouchFrame
from drivers import clock
from drivers.pauses import Backoff
from drivers.threads import in_thread
from model.errors import InputError
from registry.plugins import failure_text

_MIN_PAUSE, _MAX_PAUSE = 1.0, 30.0  # s; before a failed source is restarted
_CLOSE_TIMEOUT = 0.2  # s

_logger = logging.getLogger(__name__)


class TouchInputs:
    """Runs touch sources concurrently.

    deliver receives their frames in coordinates of the plate, each source name prefixed with the
    configured name; lift, that prefix: of a source that ends, fails or is cancelled. One that fails
    is restarted after a growing pause.
    """

    def __init__(self, deliver: Callable[[TouchFrame], None], lift: Callable[[str], None]) -> None:
        self._deliver = deliver
        self._lift = lift
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
        prefix, calibration = f"{touch_input.name}:", touch_input.calibration

        def deliver(frame: TouchFrame) -> None:
            # The sender chooses the name, which is printed on terminals.
            source = frame.source if frame.source.isprintable() else ascii(frame.source)
            touches = frame.touches
            if calibration != ALIGNED:
                touches = tuple(map(calibration.apply, touches))
            self._deliver(replace(frame, source=prefix + source, touches=touches))

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
            finally:
                self._lift(prefix)
            # A panel may be plugged in later, a port be released.
            await asyncio.sleep(backoff.pause(ran_for=clock.now() - started_at))
