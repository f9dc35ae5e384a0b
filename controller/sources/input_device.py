"""A touch panel as an input device of Linux that reports slots.

Requests and structures are those of the kernel's include/uapi/linux/input.h, with the layout of
request numbers that x86, Arm and RISC-V share (asm-generic/ioctl.h).
"""

import errno
import fcntl
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from controller.sources.slots import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_PRESSURE,
    ABS_MT_SLOT,
    ABS_MT_TOUCH_MAJOR,
    SLOT_AXES,
    Range,
    SlotState,
)
from model.errors import InputError

_READ, _WRITE = 2, 1
_EVENT = struct.Struct("llHHi")  # struct input_event: time of two longs, type, code, value
_AXIS = struct.Struct("6i")  # struct input_absinfo: value, minimum, maximum, fuzz, flat, resolution
_INT = struct.Struct("i")
_EVENTS_AT_ONCE = 64


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


@dataclass(frozen=True)
class InputEvent:
    """One event: its type (EV_...), code and value."""

    kind: int
    code: int
    value: int


def parse_events(data: bytes) -> Iterator[InputEvent]:
    """Yield the complete events in data read from a device; the kernel never splits one."""
    whole = len(data) // _EVENT.size * _EVENT.size
    for _, _, kind, code, value in _EVENT.iter_unpack(data[:whole]):
        yield InputEvent(kind, code, value)


class InputDevice:
    """An open panel at a path such as /dev/input/event5 or one under /dev/input/by-id.

    grab: keep its touches from other programs, such as a desktop. Raises InputError if it cannot be
    opened or is no panel of type B.
    """

    def __init__(self, path: str, *, grab: bool = False) -> None:
        self.path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise InputError(f"touch source {path}: {_advice(error, path)}") from error
        try:
            self.ranges = {
                axis: self._range(axis) for axis in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y)
            }
            measured = (*self.ranges, ABS_MT_PRESSURE, ABS_MT_TOUCH_MAJOR)
            self.resolutions = {axis: self._axis(axis)[3] for axis in measured}  # 0: no axis
            self._slot_count = self._range(ABS_MT_SLOT)[1] + 1
            if grab:
                fcntl.ioctl(self._descriptor, GRAB, 1)
        except OSError as error:
            self.close()
            if error.errno == errno.EBUSY:
                raise InputError(
                    f"touch source {path}: grabbed by another program; stop that one "
                    f"(`sudo fuser -v {path}` names it)"
                ) from error
            raise InputError(
                f"touch source {path}: must be a touch panel that reports slots "
                f"({error.strerror}); `libinput list-devices` or `evtest` list the devices"
            ) from error
        except InputError:
            self.close()
            raise

    def fileno(self) -> int:
        """Return the descriptor for a selector."""
        return self._descriptor

    @property
    def current_slot(self) -> int:
        """The slot of the next event; raises OSError if the device is unplugged."""
        return self._axis(ABS_MT_SLOT)[0]

    def slots(self) -> dict[int, SlotState]:
        """Return the state of every slot; raises OSError if the device is unplugged."""
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
        return list(parse_events(data))

    def close(self) -> None:
        """Close the device."""
        os.close(self._descriptor)

    def _axis(self, axis: int) -> tuple[int, int, int, int]:
        """Return value, minimum, maximum and resolution of an axis."""
        raw = fcntl.ioctl(self._descriptor, eviocgabs(axis), bytes(_AXIS.size))
        value, low, high, _, _, resolution = _AXIS.unpack(raw)
        return value, low, high, resolution

    def _range(self, axis: int) -> Range:
        """Return the range of an axis; raises InputError if it is empty."""
        _, low, high, _ = self._axis(axis)
        if low >= high:
            raise InputError(
                f"touch source {self.path}: minimum of axis {axis:#x} must be below its maximum, "
                f"got {low} and {high}; choose a panel that reports slots (multi-touch type B)"
            )
        return low, high

    def _slot_values(self, axis: int) -> tuple[int, ...]:
        """Return the value of an axis in every slot."""
        layout = struct.Struct(f"{1 + self._slot_count}i")
        buffer = layout.pack(axis, *([0] * self._slot_count))
        _, *values = layout.unpack(
            fcntl.ioctl(self._descriptor, eviocgmtslots(layout.size), buffer)
        )
        return tuple(values)


def _advice(error: OSError, path: str) -> str:
    """Return why a device cannot be opened, and the remedy."""
    if error.errno == errno.EACCES:
        return (
            "no permission to read; add yourself to the group of the device (usually "
            "`sudo usermod -aG input $USER`, then log in again) or install a udev rule"
        )
    if error.errno == errno.ENOENT:
        return "no such device; `ls -l /dev/input/by-id` lists those that are plugged in"
    return f"{path} cannot be opened: {error.strerror}"
