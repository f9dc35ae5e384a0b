"""Touch inputs of the daemon: the configured sources."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal

from controller.api.schema import TouchInputStatus
from controller.api.server import InputsEvent
from controller.daemon.config import TouchInput
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import ALIGNED, TouchFrame, TouchSource
from model.errors import InputError
from registry import threads
from registry.plugins import failure_text
from registry.threads import Backoff, in_thread

_MIN_PAUSE, _MAX_PAUSE = 1.0, 30.0  # s; before a failed source is restarted
_CLOSE_TIMEOUT = 0.2  # s
_WATCH_INTERVAL = 1.0  # s; in which the state of all inputs is looked at

_logger = logging.getLogger(__name__)


class TouchInputs:
    """Runs touch sources concurrently.

    deliver receives their frames in coordinates of the plate, each source name prefixed with the
    configured name; lift, that prefix: of a source that ends, fails or is cancelled. One that fails
    is restarted after a growing pause. rejects: counter of all sources. changed: called when
    `event` has changed.
    """

    def __init__(
        self,
        deliver: Callable[[TouchFrame], None],
        lift: Callable[[str], None],
        *,
        rejects: RejectCounter,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._deliver = deliver
        self._lift = lift
        self._rejects = rejects
        self._changed = changed
        self._sources: dict[TouchInput, TouchSource | str | None] = {}
        """Source of each input; the reason in words while it has no source; None at its end."""
        self._running: list[asyncio.Task[None]] = []
        self.event = InputsEvent(inputs=[], rejected_touches={})
        """State of all inputs and rejected touches, at most a second old."""

    def start(self, inputs: Sequence[TouchInput]) -> None:
        """Run these sources until `close`."""
        self._sources = dict.fromkeys(inputs, "being opened")
        self._running += [
            asyncio.create_task(self._run(each), name=f"touch {each.name}") for each in inputs
        ]
        self._running.append(asyncio.create_task(self._watch(), name="touch inputs"))

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
            started_at = threads.now()
            try:
                # A plug-in may block.
                source = await in_thread(touch_input.make, name="touch source")
                source.rejects = self._rejects
                self._sources[touch_input] = source
                await source.run(deliver)
            except Exception as error:
                is_expected = isinstance(error, InputError | OSError)
                text = str(error) if is_expected else failure_text(error)
                _logger.error("touch source %s: failed, restarting: %s", touch_input.name, text)
                self._look((touch_input, text))
            else:
                _logger.info("touch source %s: finished", touch_input.name)
                self._look((touch_input, None))
                return
            finally:
                self._lift(prefix)
            # A panel may be plugged in later, a port be released.
            await asyncio.sleep(backoff.pause(ran_for=threads.now() - started_at))

    def _look(self, *changed: tuple[TouchInput, TouchSource | str | None]) -> None:
        """Look at all inputs, of which some have changed."""
        self._sources.update(changed)
        statuses = [_status(*each) for each in self._sources.items()]
        event = InputsEvent(inputs=statuses, rejected_touches=dict(self._rejects.counts))
        if event != self.event:
            self.event = event
            self._changed()

    async def _watch(self) -> None:
        """Look at all inputs from time to time."""
        while True:
            await asyncio.sleep(_WATCH_INTERVAL)
            self._look()


def _status(touch_input: TouchInput, source: TouchSource | str | None) -> TouchInputStatus:
    """Describe an input by its source, or by the reason for having no source."""
    try:
        problem = source.problem if isinstance(source, TouchSource) else source
    except Exception as error:  # of a plug-in
        problem = failure_text(error)
    lacking: Literal["mute", "missing"] = "missing" if isinstance(source, str) else "mute"
    return TouchInputStatus(
        name=touch_input.name,
        url=touch_input.url,
        state="ended" if source is None else "open" if problem is None else lacking,
        problem=problem,
    )
