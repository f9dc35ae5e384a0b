"""Touch panels as input devices of the Linux kernel.

A panel for a single finger is treated as one with a single slot (`as_slot_event`). Requests and
structures are from include/uapi/linux/input.h, with the layout of request numbers shared by x86,
Arm and RISC-V (asm-generic/ioctl.h).
"""

import contextlib
import errno
import fcntl
import os
import struct
import time
from collections.abc import Iterator
from typing import TypeAlias

from controller.sources.slot_reader import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_PRESSURE,
    ABS_MT_SLOT,
    ABS_MT_TOUCH_MAJOR,
    ABS_MT_TRACKING_ID,
    ABS_PRESSURE,
    ABS_X,
    ABS_Y,
    BTN_TOUCH,
    EV_ABS,
    EV_KEY,
    SLOT_AXES,
    Range,
    SlotState,
)
from model.errors import InputError

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

_READ = 2
_WRITE = 1
_EVENT = struct.Struct("llHHi")  # struct input_event: time of two longs, type, code, value
_AXIS = struct.Struct("6i")  # struct input_absinfo: value, minimum, maximum, fuzz, flat, resolution
_INT = struct.Struct("i")
_EVENTS_AT_ONCE = 64
_KEYS = 0x300 // 8  # bytes of a set of keys, KEY_CNT bits


def as_slot_event(event: InputEvent) -> InputEvent:
    """Convert an event of a single-finger panel to one of a panel with one slot."""
    time, kind, code, value = event
    if kind == EV_KEY:
        value -= 1  # 0, a tracking id, if pressed; -1 if released
    slot_code = _SLOT_CODES.get((kind, code))
    if slot_code is None:
        return time, kind, code, value
    return time, EV_ABS, slot_code, value


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
