"""Touch panels of a Linux machine, read from the kernel's input devices.

Panels use multi-touch protocol type B, with contacts in slots; one for a single finger is treated
as one with a single slot (`as_slot_event`). Events are described in the kernel's
Documentation/input/multi-touch-protocol.rst, with the numbers of its input-event-codes.h. Requests
and structures are from include/uapi/linux/input.h, with the layout of request numbers shared by
x86, Arm and RISC-V (asm-generic/ioctl.h).
"""

import asyncio
import contextlib
import errno
import fcntl
import math
import os
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias
from urllib.parse import parse_qsl

from controller.sources.contact_load import LIGHT_FORCE, LIGHT_MAJOR, LightPress
from controller.sources.touch import Touch, TouchFrame, TouchSource, frame_moment, number_option
from model.errors import InputError
from registry.limits import HAND_LOAD

TYPE_A = (
    "multi-touch protocol must be type B (slots), got type A, which does not say which contact is "
    "which; use another panel or driver, or a program that sends its touches as TUIO"
)
"""Refusal of a panel."""

EV_SYN, EV_KEY, EV_ABS = 0x00, 0x01, 0x03
SYN_REPORT, SYN_MT_REPORT, SYN_DROPPED = 0, 2, 3
ABS_X, ABS_Y, ABS_PRESSURE, BTN_TOUCH = 0x00, 0x01, 0x18, 0x14A
ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_TRACKING_ID = 0x2F, 0x35, 0x36, 0x39
ABS_MT_TOUCH_MAJOR, ABS_MT_TOOL_TYPE, ABS_MT_PRESSURE, ABS_MT_DISTANCE = 0x30, 0x37, 0x3A, 0x3B
MT_TOOL_FINGER, MT_TOOL_PALM = 0, 2  # others are a pen, a dial

Range: TypeAlias = tuple[int, int]  # lowest and highest value of an axis
InputEvent: TypeAlias = tuple[float, int, int, int]
"""An event of a panel: the kernel's time [s], type (EV_...), code and value."""

SINGLE_TOUCH_AXES = {
    ABS_MT_POSITION_X: ABS_X,
    ABS_MT_POSITION_Y: ABS_Y,
    ABS_MT_PRESSURE: ABS_PRESSURE,
}
"""Axes of a slot, and the corresponding axes of a panel for a single finger."""

_SLOT_CODES = {
    (EV_ABS, ABS_X): ABS_MT_POSITION_X,
    (EV_ABS, ABS_Y): ABS_MT_POSITION_Y,
    (EV_ABS, ABS_PRESSURE): ABS_MT_PRESSURE,
    (EV_KEY, BTN_TOUCH): ABS_MT_TRACKING_ID,
}
"""Codes of the axes of a slot, by type and code of the events of a panel for a single finger."""

_GRAVITY = 9.81  # m/s²

REPEAT_INTERVAL = 0.05  # s; a panel at rest is silent, but contacts time out without frames

_LIGHT_PRESS = {"light_pressure": ABS_MT_PRESSURE, "light_major": ABS_MT_TOUCH_MAJOR}
"""Axes of the URL's options."""


def as_slot_event(event: InputEvent) -> InputEvent:
    """Convert an event of a single-finger panel to one of a panel with one slot."""
    time, kind, code, value = event
    if kind == EV_KEY:
        value -= 1  # 0, a tracking id, if pressed; -1 if released
    slot_code = _SLOT_CODES.get((kind, code))
    if slot_code is None:
        return time, kind, code, value
    return time, EV_ABS, slot_code, value


@dataclass(frozen=True)
class PanelReport:
    """Events of a panel up to a SYN_REPORT."""

    states: tuple[tuple[Touch, ...], ...]
    """All touches in each state within the report: a contact may come and go within it, or be
    replaced in its slot."""
    is_partial: bool = False
    """Whether events were lost before it, so that all contacts are unknown."""


@dataclass
class SlotState:
    """The values of a slot's axes in the kernel; 0 for axes that the panel does not have."""

    tracking_id: int = -1
    """Of the contact; negative without one."""
    x: int | None = None
    """None until reported, as y."""
    y: int | None = None
    tool: int = MT_TOOL_FINGER
    """Palms are hands, pens are no touches."""
    distance: int = 0
    """Above 0 while hovering."""
    pressure: int = 0
    touch_major: int = 0


SLOT_AXES = {
    ABS_MT_TRACKING_ID: "tracking_id",
    ABS_MT_POSITION_X: "x",
    ABS_MT_POSITION_Y: "y",
    ABS_MT_TOOL_TYPE: "tool",
    ABS_MT_DISTANCE: "distance",
    ABS_MT_PRESSURE: "pressure",
    ABS_MT_TOUCH_MAJOR: "touch_major",
}
"""Axes of a slot and their fields in `SlotState`, in its order."""


class SlotReader:
    """Decodes events into reports, without I/O.

    A contact appears once both its coordinates are known. A slot keeps the coordinates of its last
    contact, since the kernel omits values that did not change. Pens and hovering fingers are no
    touches; a palm is a hand that rests, with its load. ranges: of the axes ABS_MT_POSITION_X and
    _Y; light_press: values of force and size under a finger that presses lightly.
    """

    def __init__(
        self,
        ranges: Mapping[int, Range],
        *,
        light_press: LightPress = LightPress(),  # noqa: B008  frozen
    ) -> None:
        self._ranges = ranges
        self._light_press = light_press
        self._slots: dict[int, SlotState] = {}
        self._current = 0
        self._pending: list[tuple[Touch, ...]] = []  # intermediate states of this report
        self._changed: set[int] = set()  # slots whose contact has changed within this report
        self._has_lost_events = False

    @property
    def touches(self) -> tuple[Touch, ...]:
        """All touches, by slot; the second of two with one tracking id gets an id of its slot."""
        touches: dict[int, Touch] = {}
        for number, slot in sorted(self._slots.items()):
            touch = self._touch(slot)
            if touch is None:
                continue
            if touch.id in touches:
                touch = replace(touch, id=-1 - number)
            touches[touch.id] = touch
        return tuple(touches.values())

    def feed(self, kind: int, code: int, value: int) -> PanelReport | None:
        """Process one event (EV_..., code and value); return the report that it completes, or None.

        Slots that are negative are ignored. Raises InputError for type A.
        """
        if kind == EV_ABS and code == ABS_MT_SLOT:
            self._current = value
        elif kind == EV_ABS and code in SLOT_AXES and self._current >= 0:
            self._set_axis(code, value)
        elif kind == EV_SYN and code == SYN_MT_REPORT:
            raise InputError(TYPE_A)
        elif kind == EV_SYN and code == SYN_DROPPED:
            self._has_lost_events = True
        elif kind == EV_SYN and code == SYN_REPORT:
            return self._finish_report()
        return None

    def _set_axis(self, code: int, value: int) -> None:
        """Set an axis of the current slot; a second contact in a slot begins another state."""
        if code == ABS_MT_TRACKING_ID:
            if self._current in self._changed and not self._has_lost_events:
                self._pending.append(self.touches)
            self._changed.add(self._current)
        slot = self._slots.setdefault(self._current, SlotState())
        setattr(slot, SLOT_AXES[code], value)

    def _finish_report(self) -> PanelReport:
        """Return the report that ends, and prepare the next one."""
        if self._has_lost_events:
            self._slots.clear()
        report = PanelReport((*self._pending, self.touches), is_partial=self._has_lost_events)
        self._pending = []
        self._changed = set()
        self._has_lost_events = False
        return report

    def resynchronise(self, slots: Mapping[int, SlotState], *, current: int) -> None:
        """Replace all state by the kernel's; current: slot of the next event."""
        self._current = current
        self._slots = {number: replace(state) for number, state in slots.items()}

    def _touch(self, slot: SlotState) -> Touch | None:
        """Return the touch in a slot, None unless a finger with known coordinates is there."""
        if slot.tracking_id < 0 or slot.x is None or slot.y is None:
            return None
        if slot.tool not in (MT_TOOL_FINGER, MT_TOOL_PALM) or slot.distance > 0:
            return None
        load: float | None = HAND_LOAD
        if slot.tool == MT_TOOL_FINGER:
            load = self._light_press.load(pressure=slot.pressure, touch_major=slot.touch_major)
        x = self._share(ABS_MT_POSITION_X, slot.x)
        y = self._share(ABS_MT_POSITION_Y, slot.y)
        return Touch(slot.tracking_id, x, y, load)

    def _share(self, code: int, value: int) -> float:
        """Return a value relative to the range of its axis, 0..1."""
        low, high = self._ranges[code]
        return (value - low) / (high - low)


def light_press(resolutions: Mapping[int, int], stated: Mapping[int, float]) -> LightPress:
    """Return the values of a panel's axes under a finger that presses lightly.

    resolutions: by axis, in units per millimetre, or units per gram for a pressure; 0 or missing if
    the panel does not state it. A pressure without resolution has an arbitrary unit (the kernel's
    input-event-codes.rst); a contact size without resolution has the unit of positions. stated:
    values from the URL by axis, which take precedence; 0 disables an axis.
    """
    pressure = resolutions.get(ABS_MT_PRESSURE, 0) * 1000 * LIGHT_FORCE / _GRAVITY
    per_mm = resolutions.get(ABS_MT_TOUCH_MAJOR, 0) or resolutions.get(ABS_MT_POSITION_X, 0)
    return LightPress(
        pressure=stated.get(ABS_MT_PRESSURE, pressure) or None,
        touch_major=stated.get(ABS_MT_TOUCH_MAJOR, per_mm * LIGHT_MAJOR) or None,
    )


_READ = 2
_WRITE = 1
_EVENT = struct.Struct("llHHi")  # struct input_event: time of two longs, type, code, value
_AXIS = struct.Struct("6i")  # struct input_absinfo: value, minimum, maximum, fuzz, flat, resolution
_INT = struct.Struct("i")
_EVENTS_AT_ONCE = 64
_KEYS = 0x300 // 8  # bytes of a set of keys, KEY_CNT bits


def _request(direction: int, number: int, size: int) -> int:
    """_IOC(direction, 'E', number, size)."""
    return direction << 30 | size << 16 | ord("E") << 8 | number


def eviocgabs(axis: int) -> int:
    """Return the request EVIOCGABS: range and value of an axis."""
    return _request(_READ, 0x40 + axis, _AXIS.size)


def eviocgmtslots(size: int) -> int:
    """Return the request EVIOCGMTSLOTS: an axis in every slot, for a buffer of a size."""
    return _request(_READ, 0x0A, size)


GRAB = _request(_WRITE, 0x90, _INT.size)  # EVIOCGRAB: exclusive access
CLOCK = _request(_WRITE, 0xA0, _INT.size)  # EVIOCSCLOCKID: clock of the events
PRESSED_KEYS = _request(_READ, 0x18, _KEYS)  # EVIOCGKEY


def parse_events(data: bytes) -> Iterator[InputEvent]:
    """Yield the complete events in data read from a device; the kernel never splits one."""
    whole = len(data) // _EVENT.size * _EVENT.size
    for seconds, microseconds, kind, code, value in _EVENT.iter_unpack(data[:whole]):
        yield seconds + 1e-6 * microseconds, kind, code, value


class InputDevice:
    """An open panel at a path such as /dev/input/event5 or one under /dev/input/by-id.

    One for a single finger, which has no multi-touch axes, looks like one with a single slot. grab:
    keep its touches from other programs, such as a desktop. Raises InputError if it cannot be
    opened or is no panel.
    """

    def __init__(self, path: str, *, grab: bool = False) -> None:
        self.path = path
        self.ranges: dict[int, Range] = {}
        """Ranges of the axes ABS_MT_POSITION_X and _Y."""
        self.resolutions: dict[int, int] = {}
        """Resolutions of the axes that `light_press` uses; 0 for missing axes."""
        self._axis_codes: dict[int, int] = {}  # codes of axes outside the slots
        self._slot_count = 1
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise InputError(f"touch source {path}: {_advice(error, path)}") from error
        try:
            self._set_up(grab=grab)
        except InputError:
            self.close()
            raise
        except OSError as error:
            self.close()
            if error.errno == errno.EBUSY:
                raise InputError(
                    f"touch source {path}: grabbed by another program; stop that one "
                    f"(`sudo fuser -v {path}` names it)"
                ) from error
            raise InputError(
                f"touch source {path}: must be a touch panel ({error.strerror}); `libinput "
                "list-devices` or `evtest` list the devices"
            ) from error

    def _set_up(self, *, grab: bool) -> None:
        """Read the properties of the axes, and set the clock of the events."""
        if self._axis(ABS_MT_POSITION_X)[1:3] == (0, 0):  # the axis is missing
            self._axis_codes = SINGLE_TOUCH_AXES
        self.ranges = {axis: self._range(axis) for axis in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y)}
        measured = (*self.ranges, ABS_MT_PRESSURE, ABS_MT_TOUCH_MAJOR)
        self.resolutions = {axis: self._axis(axis)[3] for axis in measured}
        self._slot_count = self._axis(ABS_MT_SLOT)[2] + 1
        with contextlib.suppress(OSError):  # an older kernel; see `frame_moment`
            fcntl.ioctl(self._descriptor, CLOCK, _INT.pack(time.CLOCK_MONOTONIC))
        if grab:
            fcntl.ioctl(self._descriptor, GRAB, 1)

    def fileno(self) -> int:
        """Return the descriptor for a selector."""
        return self._descriptor

    @property
    def current_slot(self) -> int:
        """The slot of the next event; raises OSError if the device is unplugged."""
        return self._axis(ABS_MT_SLOT)[0]

    def slots(self) -> dict[int, SlotState]:
        """Return the state of every slot.

        Raises OSError if the device is unplugged; EINVAL for one without slots, of type A.
        """
        if self._axis_codes:
            keys = fcntl.ioctl(self._descriptor, PRESSED_KEYS, bytes(_KEYS))
            is_down = keys[BTN_TOUCH // 8] >> BTN_TOUCH % 8 & 1
            x, y, pressure = [self._axis(axis)[0] for axis in SINGLE_TOUCH_AXES]
            return {0: SlotState(is_down - 1, x, y, pressure=pressure)}
        states = zip(*map(self._slot_values, SLOT_AXES), strict=True)
        return {slot: SlotState(*state) for slot, state in enumerate(states)}

    def read(self) -> list[InputEvent]:
        """Return the pending events; raises OSError if the device is unplugged."""
        try:
            data = os.read(self._descriptor, _EVENT.size * _EVENTS_AT_ONCE)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        events = parse_events(data)
        return list(map(as_slot_event, events) if self._axis_codes else events)

    def close(self) -> None:
        """Close the device."""
        os.close(self._descriptor)

    def _axis(self, axis: int) -> tuple[int, int, int, int]:
        """Return value, minimum, maximum and resolution of an axis; zeros if it is missing."""
        request = eviocgabs(self._axis_codes.get(axis, axis))
        raw = fcntl.ioctl(self._descriptor, request, bytes(_AXIS.size))
        value, low, high, _, _, resolution = _AXIS.unpack(raw)
        return value, low, high, resolution

    def _range(self, axis: int) -> Range:
        """Return the range of an axis; raises InputError if it is empty."""
        _, low, high, _ = self._axis(axis)
        if low >= high:
            code = self._axis_codes.get(axis, axis)
            raise InputError(
                f"touch source {self.path}: minimum of axis {code:#x} must be below its maximum, "
                f"got {low} and {high}; choose a multi-touch panel that reports slots (type B), or "
                "a single-touch panel"
            )
        return low, high

    def _slot_values(self, axis: int) -> tuple[int, ...]:
        """Return the value of an axis in every slot."""
        layout = struct.Struct(f"{1 + self._slot_count}i")
        request = layout.pack(axis, *([0] * self._slot_count))
        reply = fcntl.ioctl(self._descriptor, eviocgmtslots(layout.size), request)
        _, *values = layout.unpack(reply)
        return tuple(values)


def _advice(error: OSError, path: str) -> str:
    """Return why a device cannot be opened, and the remedy."""
    if error.errno == errno.EACCES:
        return (
            "no permission to read; add yourself to the group of the device (usually "
            "`sudo usermod -aG input $USER`, then log in again) or install a udev rule"
        )
    if error.errno == errno.ENOENT:
        return "no such device; `ls -l /dev/input/by-id` lists the connected devices"
    return f"{path} cannot be opened: {error.strerror}"


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
