"""Touch panels of a Linux machine, read from the kernel's input devices."""

import asyncio
import contextlib
import errno
import logging
from collections.abc import Callable

from controller.sources.input_device import InputDevice
from controller.sources.slots import SlotReader, light_press
from controller.sources.touch import Touch, TouchFrame, TouchSource
from controller.sources.url_options import panel_options
from model.errors import InputError

REPEAT_INTERVAL = 0.05  # s; a panel at rest is silent, but contacts time out without frames
# Between attempts to reopen an unplugged panel [s], doubled each time.
_FIRST_PAUSE, _MAX_PAUSE = 0.5, 5.0

_logger = logging.getLogger(__name__)


class EvdevSource(TouchSource):
    """Follows the panel at `evdev:PATH` or `evdev:PATH?grab=yes`, such as evdev:/dev/input/event5.

    `light_pressure=VALUE`, `light_major=VALUE`: of its axes under a finger that presses lightly.

    A panel is silent while fingers rest, so the kernel's slots are polled every 50 ms, which also
    detects an unplugged panel at once. It is reopened when it is back. Raises InputError for any
    other URL, and in `run` if there is no panel.
    """

    def __init__(self, url: str, *, open_panel: Callable[..., InputDevice] = InputDevice) -> None:
        path, _, options = url.removeprefix("evdev:").partition("?")
        grab, self._light_values = panel_options(options)
        if not url.startswith("evdev:") or not path or grab not in ({}, {"grab": "yes"}):
            raise InputError(
                "touch source must be evdev:PATH of an input device, or evdev:PATH?grab=yes to "
                "keep its touches from other programs; also light_pressure=VALUE and "
                f"light_major=VALUE, got {url}"
            )
        self._name = f"evdev:{path}"
        self._path = path
        self._grab = bool(grab)
        self._open = open_panel

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame per report until cancelled."""
        panel = self._open(self._path, grab=self._grab)
        while True:
            try:
                await self._follow(panel, deliver)
            except OSError as error:
                if error.errno != errno.ENODEV:
                    raise
                self._deliver(deliver, ())
                _logger.warning("%s: unplugged, lifting its touches", self._name)
            finally:
                panel.close()
            panel = await self._reopened()
            _logger.warning("%s: reconnected", self._name)

    async def _reopened(self) -> InputDevice:
        """Open the panel as soon as it is plugged in again."""
        pause = _FIRST_PAUSE
        while True:
            await asyncio.sleep(pause)
            with contextlib.suppress(InputError):
                return self._open(self._path, grab=self._grab)
            pause = min(2 * pause, _MAX_PAUSE)

    async def _follow(self, panel: InputDevice, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the frames of a panel until it is unplugged; raises OSError then."""
        loop = asyncio.get_running_loop()
        press = light_press(panel.resolutions, self._light_values)
        reader = SlotReader(panel.ranges, light_press=press)
        reader.resynchronise(panel.slots(), current=panel.current_slot)
        self._deliver(deliver, reader.touches)
        readable = asyncio.Event()
        loop.add_reader(panel.fileno(), readable.set)
        try:
            while True:
                try:
                    async with asyncio.timeout(REPEAT_INTERVAL if reader.touches else None):
                        await readable.wait()
                except TimeoutError:
                    reader.resynchronise(panel.slots(), current=panel.current_slot)
                    self._deliver(deliver, reader.touches)
                    continue
                readable.clear()
                for event in panel.read():
                    report = reader.feed(event.kind, event.code, event.value)
                    if report is None:
                        continue
                    if report.is_partial:
                        reader.resynchronise(panel.slots(), current=panel.current_slot)
                        self._deliver(deliver, reader.touches)
                    else:
                        for touches in report.states:
                            self._deliver(deliver, touches)
        finally:
            loop.remove_reader(panel.fileno())

    def _deliver(self, deliver: Callable[[TouchFrame], None], touches: tuple[Touch, ...]) -> None:
        deliver(TouchFrame(self._name, asyncio.get_running_loop().time(), touches))
