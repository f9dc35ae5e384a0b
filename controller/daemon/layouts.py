"""The surface layouts and touch inputs of a running daemon.

`LayoutChoice` holds the layouts and the current one. `TouchInputs` runs the configured touch
sources.
"""

import asyncio
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import InputsEvent, LayoutEvent
from controller.api.schema import TouchInputStatus
from controller.daemon.config import DaemonConfig, TouchInput
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.effects.strengths import Strengths, read_strengths
from controller.sources.touch import RejectCounter, TouchFrame, TouchSource
from controller.sources.touch_calibration import ALIGNED
from model.arrays import FloatArray
from model.errors import InputError
from registry import threads
from registry.plugins import did_you_mean, failure_text
from registry.retries import Backoff
from registry.threads import in_thread

_logger = logging.getLogger(__name__)

_MIN_PAUSE = 1.0  # s; before a failed source is restarted
_MAX_PAUSE = 30.0  # s
SOURCE_CLOSE_TIMEOUT = 0.2  # s
WATCH_INTERVAL = 1.0  # s; between checks of all inputs


def warn_of_bands(layouts: Mapping[str | None, SurfaceLayout], frequencies: FloatArray) -> None:
    """Log the frequencies played for bands that contain no frequency of the table [Hz]."""
    for name, layout in layouts.items():
        for problem in layout.band_problems(frequencies):
            _logger.warning("layout %s: %s", name, problem)


class LayoutChoice:
    """The layouts of a daemon's configuration; the first is current until another is chosen.

    config: configuration rendered for the table's frequencies [Hz].
    """

    def __init__(self, config: DaemonConfig, frequencies: FloatArray) -> None:
        self._layouts = config.layouts
        self.observers: list[Callable[[], None]] = []
        """Called after the current layout or its content changes."""
        self.name = next(iter(self._layouts))
        """Name of the current layout; None if no layout is configured."""
        self.player = EffectPlayer(
            self._layouts[self.name], Strengths(read_strengths(config.strengths))
        )
        """Plays the current layout."""
        warn_of_bands(self._layouts, frequencies)

    @property
    def names(self) -> list[str]:
        """Names of the available layouts."""
        return [name for name in self._layouts if name is not None]

    def use(self, name: str) -> None:
        """Switch to a layout; raises RpcError for an unknown name."""
        if name not in self._layouts:
            remedy = "add layouts to the daemon's file"
            if self.names:
                remedy = f"{did_you_mean(name, self.names)}choose one of {', '.join(self.names)}"
            raise RpcError(
                ErrorCode.INVALID_PARAMS, f"unknown layout {name!a}", where="name", remedy=remedy
            )
        if name != self.name:
            self._play(name)

    def apply(
        self,
        layouts: Mapping[str | None, SurfaceLayout],
        changed_names: Collection[str | None],
    ) -> list[str]:
        """Replace the layouts, some of which have changed; the current name is kept.

        If the current layout was removed, switches to the first and returns a note, otherwise [].
        """
        self._layouts = layouts
        if self.name not in layouts:
            self._play(next(iter(layouts)))
            return [f"current layout: {self.name or 'none'}"]
        if self.name in changed_names:
            self._play(self.name)
        return []

    def event(self) -> LayoutEvent:
        """Return the current layout as an event."""
        layout = None if self.name is None else self.player.layout.as_json()
        return LayoutEvent(name=self.name, layout=layout)

    def _play(self, name: str | None) -> None:
        self.name = name
        self.player.replace(self._layouts[name])
        _logger.info("layout: using %s", name or "none")
        for observer in self.observers:
            observer()


class TouchInputs:
    """Runs touch sources concurrently; a source that fails is restarted after a growing pause.

    deliver: receives their frames in plate coordinates; source names start with the configured
        name.
    lift: receives the prefix of a source that ends, fails or is cancelled.
    rejects: counter shared by all sources.
    """

    def __init__(
        self,
        deliver: Callable[[TouchFrame], None],
        lift: Callable[[str], None],
        *,
        rejects: RejectCounter,
    ) -> None:
        self.deliver = deliver
        self._lift = lift
        self._rejects = rejects
        self.observers: list[Callable[[], None]] = []
        """Called after `event` changes."""
        self._sources: dict[TouchInput, TouchSource | str | None] = {}
        """Source of each input; a text with the reason while it is missing; None after its end."""
        self._running: list[asyncio.Task[None]] = []
        self.event = InputsEvent(inputs=[], rejected_touches={})
        """State of all inputs and rejected touches, at most one second old."""

    def start(self, inputs: Sequence[TouchInput]) -> None:
        """Run these sources until `close`."""
        self._sources = dict.fromkeys(inputs, "being opened")
        for touch_input in inputs:
            running = asyncio.create_task(self._run(touch_input), name=f"touch {touch_input.name}")
            self._running.append(running)
        self._running.append(asyncio.create_task(self._watch(), name="touch inputs"))

    async def close(self) -> None:
        """Stop all sources; close the coroutine of a plug-in that ignores cancellation."""
        for task in self._running:
            task.cancel()
        if not self._running:
            return
        _, late = await asyncio.wait(self._running, timeout=SOURCE_CLOSE_TIMEOUT)
        for task in late:  # otherwise the program would wait for it at its end
            _logger.warning("%s: not ended by cancellation", task.get_name())
            with suppress(Exception):  # it can ignore this too, or fail
                task.get_coro().close()
            task.cancel()
        ends = asyncio.gather(*late, return_exceptions=True)
        await asyncio.wait([ends], timeout=SOURCE_CLOSE_TIMEOUT)

    async def _run(self, touch_input: TouchInput) -> None:
        prefix = f"{touch_input.name}:"
        calibration = touch_input.calibration

        def deliver(frame: TouchFrame) -> None:
            source = frame.source
            if not source.isprintable():  # the sender chooses it, and terminals print it
                source = ascii(source)
            touches = frame.touches
            if calibration != ALIGNED:
                touches = tuple(map(calibration.apply, touches))
            self.deliver(replace(frame, source=prefix + source, touches=touches))

        backoff = Backoff(_MIN_PAUSE, _MAX_PAUSE)
        while True:
            started_at = threads.now()
            try:
                # A plug-in can block.
                source = await in_thread(touch_input.make, name="touch source")
                source.rejects = self._rejects
                self._sources[touch_input] = source
                await source.run(deliver)
            except Exception as error:
                is_expected = isinstance(error, InputError | OSError)
                problem = str(error) if is_expected else failure_text(error)
                _logger.error("touch source %s: failed, restarting: %s", touch_input.name, problem)
                self._sources[touch_input] = problem
                self._update()
            else:
                _logger.info("touch source %s: finished", touch_input.name)
                self._sources[touch_input] = None
                self._update()
                return
            finally:
                self._lift(prefix)
            # A panel can be plugged in later, or a port released.
            await asyncio.sleep(backoff.pause(ran_for=threads.now() - started_at))

    def _update(self) -> None:
        """Update the state of all inputs."""
        statuses = [_status(touch_input, source) for touch_input, source in self._sources.items()]
        event = InputsEvent(inputs=statuses, rejected_touches=dict(self._rejects.counts))
        if event != self.event:
            self.event = event
            for observer in self.observers:
                observer()

    async def _watch(self) -> None:
        """Update the state of all inputs periodically."""
        while True:
            await asyncio.sleep(WATCH_INTERVAL)
            self._update()


def _status(touch_input: TouchInput, source: TouchSource | str | None) -> TouchInputStatus:
    """Describe an input with its source, or with the reason why the source is missing."""
    state: Literal["open", "mute", "missing", "ended"]
    problem: str | None
    if source is None:
        state = "ended"
        problem = None
    elif isinstance(source, str):
        state = "missing"
        problem = source
    else:
        problem = _problem_of(source)
        state = "open" if problem is None else "mute"
    return TouchInputStatus(
        name=touch_input.name, url=touch_input.url, state=state, problem=problem
    )


def _problem_of(source: TouchSource) -> str | None:
    """Return why an open source is mute; None if it works."""
    try:
        return source.problem
    except Exception as error:  # of a plug-in
        return failure_text(error)
