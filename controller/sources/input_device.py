"""A touch panel as the Linux kernel shows it: an input device that reports slots.

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
    ABS_MT_SLOT,
    ABS_MT_TRACKING_ID,
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


def get_axis(axis: int) -> int:
    """EVIOCGABS: range and value of an axis."""
    return _request(_READ, 0x40 + axis, _AXIS.size)


def get_slots(size: int) -> int:
    """EVIOCGMTSLOTS: an axis' code in, its value in every slot out, in a buffer of a size."""
    return _request(_READ, 0x0A, size)


GRAB = _request(_WRITE, 0x90, _INT.size)  # EVIOCGRAB: from now on nobody else hears of it


@dataclass(frozen=True)
class InputEvent:
    """One event: its type (EV_...), code and value."""

    kind: int
    code: int
    value: int


def parse_events(data: bytes) -> Iterator[InputEvent]:
    """The whole events in what was read of a device; the kernel never splits one."""
    whole = len(data) // _EVENT.size * _EVENT.size
    for _, _, kind, code, value in _EVENT.iter_unpack(data[:whole]):
        yield InputEvent(kind, code, value)


class InputDevice:
    """An open panel at a path such as /dev/input/event5 or one under /dev/input/by-id.

    grab: keep its touches from every other program, such as a desktop that would click by them.
    Raises InputError where it cannot be opened or is no panel of type B.
    """

    def __init__(self, path: str, *, grab: bool = False) -> None:
        self.path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise InputError(f"touch source {path}: {_advice(error, path)}") from error
        try:
            self.x_range = self._range(ABS_MT_POSITION_X)
            self.y_range = self._range(ABS_MT_POSITION_Y)
            self._slot_count = self._range(ABS_MT_SLOT)[1] + 1
            if grab:
                fcntl.ioctl(self._descriptor, GRAB, 1)
        except OSError as error:
            self.close()
            if error.errno == errno.EBUSY:
                raise InputError(
                    f"touch source {path}: another program has grabbed this panel; stop that one "
                    f"(`sudo fuser -v {path}` tells which)"
                ) from error
            raise InputError(
                f"touch source {path}: no touch panel that reports slots ({error.strerror}); "
                "`libinput list-devices` or `evtest` tell which devices there are"
            ) from error
        except InputError:
            self.close()
            raise

    def fileno(self) -> int:
        """What a selector waits for."""
        return self._descriptor

    @property
    def current_slot(self) -> int:
        """The slot that the next event is about; raises OSError when the device is gone."""
        return self._axis(ABS_MT_SLOT)[0]

    def slots(self) -> dict[int, SlotState]:
        """What every slot holds now; raises OSError when the device is gone."""
        ids, xs, ys = (
            self._of_slots(axis)
            for axis in (ABS_MT_TRACKING_ID, ABS_MT_POSITION_X, ABS_MT_POSITION_Y)
        )
        return {slot: SlotState(*state) for slot, state in enumerate(zip(ids, xs, ys, strict=True))}

    def read(self) -> list[InputEvent]:
        """Events that are there now, none if there are none; raises OSError when it is gone."""
        try:
            data = os.read(self._descriptor, _EVENT.size * _EVENTS_AT_ONCE)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        return list(parse_events(data))

    def close(self) -> None:
        """Let go of it."""
        os.close(self._descriptor)

    def _axis(self, axis: int) -> tuple[int, int, int]:
        """Value, minimum and maximum of an axis."""
        raw = fcntl.ioctl(self._descriptor, get_axis(axis), bytes(_AXIS.size))
        value, low, high, *_ = _AXIS.unpack(raw)
        return value, low, high

    def _range(self, axis: int) -> Range:
        """The range of an axis; raises InputError if it has none."""
        _, low, high = self._axis(axis)
        if low >= high:
            raise InputError(
                f"touch source {self.path}: axis {axis:#x} ranges from {low} to {high}, which is "
                "no range: this is no touch panel that reports slots (multi-touch type B)"
            )
        return low, high

    def _of_slots(self, axis: int) -> tuple[int, ...]:
        """The value of an axis in every slot."""
        layout = struct.Struct(f"{1 + self._slot_count}i")
        question = layout.pack(axis, *([0] * self._slot_count))
        _, *values = layout.unpack(fcntl.ioctl(self._descriptor, get_slots(layout.size), question))
        return tuple(values)


def _advice(error: OSError, path: str) -> str:
    """Why it cannot be opened, and what to do."""
    if error.errno == errno.EACCES:
        return (
            "you may not read it; add yourself to the group of the device (most often "
            "`sudo usermod -aG input $USER`, then log in again) or install a udev rule"
        )
    if error.errno == errno.ENOENT:
        return "there is no such device; `ls -l /dev/input/by-id` shows those that are plugged in"
    return f"{path} cannot be opened: {error.strerror}"
