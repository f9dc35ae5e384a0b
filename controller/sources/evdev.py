"""Touch source `evdev:`: the touch panels of a Linux machine."""

import asyncio
import errno
import math
from collections.abc import Callable
from urllib.parse import parse_qsl

from controller.sources.input_device import InputDevice
from controller.sources.slot_reader import (
    ABS_MT_PRESSURE,
    ABS_MT_TOUCH_MAJOR,
    TYPE_A,
    SlotReader,
    light_press,
)
from controller.sources.touch import Touch, TouchFrame, TouchSource, frame_moment, number_option
from model.errors import InputError

REPEAT_INTERVAL = 0.05  # s; a panel at rest is silent, but contacts time out without frames

_LIGHT_PRESS = {"light_pressure": ABS_MT_PRESSURE, "light_major": ABS_MT_TOUCH_MAJOR}
"""Axes of the URL's options."""


class EvdevSource(TouchSource):
    """Follows the panel at `evdev:PATH` or `evdev:PATH?grab=yes`, such as evdev:/dev/input/event5.

    `light_pressure=VALUE`, `light_major=VALUE`: of its axes under a finger that presses lightly.

    A panel is silent while fingers rest, so the kernel's slots are polled every 50 ms, which also
    detects an unplugged panel immediately. Raises InputError for any other URL, and in `run` if the
    panel is missing or unplugged.
    """

    def __init__(self, url: str, *, open_panel: Callable[..., InputDevice] = InputDevice) -> None:
        path, _, options = url.removeprefix("evdev:").partition("?")
        grab, self._light_values = _panel_options(options)
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
        try:
            await self._follow(panel, deliver)
        except OSError as error:
            reason = f"lost ({error.strerror}); plug it in again"
            if error.errno == errno.EINVAL:
                reason = TYPE_A
            raise InputError(f"touch source {self._path}: {reason}") from error
        finally:
            panel.close()

    async def _follow(self, panel: InputDevice, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver frames at the kernel's times; raises OSError if the panel is unplugged."""
        loop = asyncio.get_running_loop()
        press = light_press(panel.resolutions, self._light_values)
        reader = SlotReader(panel.ranges, light_press=press)
        self._deliver_state(panel, reader, deliver)
        readable = asyncio.Event()
        loop.add_reader(panel.fileno(), readable.set)
        try:
            while True:
                try:
                    async with asyncio.timeout(REPEAT_INTERVAL if reader.touches else None):
                        await readable.wait()
                except TimeoutError:
                    self._deliver_state(panel, reader, deliver)
                    continue
                readable.clear()
                for event_time, kind, code, value in panel.read():
                    report = reader.feed(kind, code, value)
                    if report is None:
                        continue
                    if report.is_partial:
                        self._deliver_state(panel, reader, deliver, event_time)
                        continue
                    for touches in report.states:
                        self._deliver(touches, deliver, event_time)
        finally:
            loop.remove_reader(panel.fileno())

    def _deliver_state(
        self,
        panel: InputDevice,
        reader: SlotReader,
        deliver: Callable[[TouchFrame], None],
        event_time: float = -math.inf,
    ) -> None:
        """Deliver a frame of the kernel's state; raises OSError if the panel is unplugged."""
        reader.resynchronise(panel.slots(), current=panel.current_slot)
        self._deliver(reader.touches, deliver, event_time)

    def _deliver(
        self,
        touches: tuple[Touch, ...],
        deliver: Callable[[TouchFrame], None],
        event_time: float,
    ) -> None:
        """Deliver a frame of an event at a time [s]; now if that is from another clock."""
        frame_time = frame_moment(event_time, asyncio.get_running_loop().time())
        deliver(TouchFrame(self._name, frame_time, touches))


def _panel_options(options: str) -> tuple[dict[str, str], dict[int, float]]:
    """Return the options of a panel, and separately its values under a light press by axis.

    A value that is not a number of at least 0 stays among the options.
    """
    remaining = dict(parse_qsl(options, keep_blank_values=True))
    light_values = {}
    for name, axis in _LIGHT_PRESS.items():
        if name not in remaining:
            continue
        value = number_option(f"{name}={remaining[name]}", name, default=0)
        if 0 <= value < math.inf:
            light_values[axis] = value
            del remaining[name]
    return remaining, light_values
