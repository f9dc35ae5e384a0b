"""Touch panels of a Linux machine, read from the kernel's input devices."""

import asyncio
import errno
import logging
from collections.abc import Callable
from typing import Protocol
from urllib.parse import parse_qsl

from controller.sources.input_device import InputDevice, InputEvent
from controller.sources.playing import REPEAT
from controller.sources.slots import Range, SlotReader, SlotState
from controller.sources.touch import Touch, TouchFrame, TouchSource
from model.errors import InputError

# How long [s] a panel that was pulled out is waited for, longer each time.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 5.0

_logger = logging.getLogger(__name__)


class Panel(Protocol):
    """What the source needs of an input device; see `InputDevice`."""

    x_range: Range
    y_range: Range

    @property
    def current_slot(self) -> int:
        """The slot that the next event is about."""

    def fileno(self) -> int:
        """What a selector waits for."""

    def slots(self) -> dict[int, SlotState]:
        """What every slot holds now."""

    def read(self) -> list[InputEvent]:
        """Events that are there now."""

    def close(self) -> None:
        """Let go of it."""


class EvdevSource(TouchSource):
    """Follows the panel at `evdev:PATH` or `evdev:PATH?grab=yes`, such as evdev:/dev/input/event5.

    While fingers rest, a panel says nothing; then the kernel is asked every 50 ms what its slots
    hold, which also shows at once that a panel is gone. One that is pulled out is waited for.
    Raises InputError on a URL that says something else, and when `open` or `run` finds no panel.
    """

    def __init__(self, url: str, *, open_panel: Callable[..., Panel] = InputDevice) -> None:
        path, _, options = url.removeprefix("evdev:").partition("?")
        grab = dict(parse_qsl(options, keep_blank_values=True))
        if not url.startswith("evdev:") or not path or grab not in ({}, {"grab": "yes"}):
            raise InputError(
                f"touch source {url}: expected evdev:PATH of an input device, and ?grab=yes to "
                "keep its touches from other programs, such as evdev:/dev/input/event5?grab=yes"
            )
        self._name = f"evdev:{path}"
        self._path = path
        self._grab = bool(grab)
        self._open = open_panel
        self._panel: Panel | None = None

    async def open(self) -> None:
        """Open the device, unless it is; `run` does it by itself. Raises InputError."""
        if self._panel is None:
            self._panel = self._open(self._path, grab=self._grab)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame per report until cancelled."""
        await self.open()
        pause = _FIRST_PAUSE
        while True:
            if self._panel is not None:
                pause = _FIRST_PAUSE
                try:
                    await self._follow(self._panel, deliver)
                except OSError as error:
                    if error.errno != errno.ENODEV:
                        raise
                    self._deliver(deliver, ())
                    _logger.warning("%s is gone, its touches are lifted", self._name)
                finally:
                    self._panel.close()
                    self._panel = None
            await asyncio.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE)
            try:
                self._panel = self._open(self._path, grab=self._grab)
            except InputError:
                continue  # not plugged in again yet
            _logger.warning("%s is there again", self._name)

    async def _follow(self, panel: Panel, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver what a panel says until it is gone; raises OSError then."""
        loop = asyncio.get_running_loop()
        reader = SlotReader(panel.x_range, panel.y_range)
        reader.adopt(panel.slots(), current=panel.current_slot)
        self._deliver(deliver, reader.touches)
        readable = asyncio.Event()
        loop.add_reader(panel.fileno(), readable.set)
        try:
            while True:
                try:
                    async with asyncio.timeout(REPEAT if reader.touches else None):
                        await readable.wait()
                except TimeoutError:
                    reader.adopt(panel.slots(), current=panel.current_slot)
                    self._deliver(deliver, reader.touches)
                    continue
                readable.clear()
                for event in panel.read():
                    report = reader.take(event.kind, event.code, event.value)
                    if report is None:
                        continue
                    if report.is_partial:
                        reader.adopt(panel.slots(), current=panel.current_slot)
                        self._deliver(deliver, reader.touches)
                    else:
                        for touches in report.states:
                            self._deliver(deliver, touches)
        finally:
            loop.remove_reader(panel.fileno())

    def _deliver(self, deliver: Callable[[TouchFrame], None], touches: tuple[Touch, ...]) -> None:
        deliver(TouchFrame(self._name, asyncio.get_running_loop().time(), touches))
