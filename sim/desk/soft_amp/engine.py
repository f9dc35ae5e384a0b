"""The engine of `firmware/ports/sound/sound.h` in this process, and what it counts.

Counters are in memory shared with the process that watches it.
"""

import ctypes
import mmap
import os
import tempfile
import time
from typing import IO

from drivers.errors import LinkError
from sim.desk.soft_amp.library import library
from sim.desk.soft_amp.settings import MAX_CHANNELS, Law, Settings


class Counters(ctypes.Structure):
    """`struct counters` of firmware/ports/sound/counters.h."""

    _fields_ = (
        ("blocks", ctypes.c_uint64),
        ("frames", ctypes.c_uint64),
        ("gaps", ctypes.c_uint64),
        ("xruns", ctypes.c_uint64),
        ("clipped", ctypes.c_uint64),
        ("requests", ctypes.c_uint64),
        ("is_streaming", ctypes.c_uint32),
        ("is_lost", ctypes.c_uint32),
        ("is_realtime", ctypes.c_uint32),
        ("state", ctypes.c_uint32 * 2),
        ("fault", ctypes.c_uint32 * 2),
        ("block", ctypes.c_uint32),
    )


def new_file() -> IO[bytes]:
    """A file without a name, of the size of the counters, all zero."""
    file = tempfile.TemporaryFile()  # noqa: SIM115  the caller's
    file.truncate(ctypes.sizeof(Counters))
    return file


def counters_in(descriptor: int) -> Counters:
    """The counters in a file, shared with every process that maps it."""
    return Counters.from_buffer(mmap.mmap(descriptor, ctypes.sizeof(Counters)))


_POLL = 0.001  # s
_HANDOVER = 2.0  # s


class _SoundSettings(ctypes.Structure):
    _fields_ = (
        ("rate", ctypes.c_uint32),
        ("channels", ctypes.c_uint32),
        ("law", ctypes.c_uint32),
        ("protocol", ctypes.c_uint32),
        ("limit", ctypes.c_double),
        ("max_gaps", ctypes.c_uint32),
        ("is_recovering", ctypes.c_uint32),
        ("serial_number", ctypes.c_char_p),
    )


class _LinesSettings(ctypes.Structure):
    _fields_ = (
        ("terminal", ctypes.c_int),
        ("listening", ctypes.c_int),
        ("parent", ctypes.c_int),
    )


class JackCalls(ctypes.Structure):
    """`struct jack_calls`: a client, its ports, and addresses of functions of libjack."""

    _fields_ = (
        ("client", ctypes.c_void_p),
        ("ports", ctypes.c_void_p * MAX_CHANNELS),
        ("buffer", ctypes.c_void_p),
        ("cycle_times", ctypes.c_void_p),
        ("time", ctypes.c_void_p),
        ("latency", ctypes.c_void_p),
        ("is_realtime", ctypes.c_void_p),
        ("port_by_id", ctypes.c_void_p),
        ("is_mine", ctypes.c_void_p),
    )


def start_engine(
    settings: Settings,
    *,
    rate: int,
    counters: Counters,
    is_recovering: bool,
    terminal: int,
    listening: int,
    parent: int,
) -> None:
    """Start the amplifiers at a rate [Hz] and their lines; descriptors: -1 for none.

    Raises InputError, LinkError.
    """
    sound = _SoundSettings(
        rate,
        settings.channels,
        list(Law).index(settings.law),
        settings.protocol,
        settings.limit,
        settings.max_gaps,
        is_recovering,
        settings.serial_number.encode(),
    )
    lines = _LinesSettings(terminal, listening, parent)
    problem = library().sound_start(
        ctypes.byref(sound), ctypes.byref(lines), ctypes.byref(counters)
    )
    if problem:
        raise LinkError(f"soft-amp: cannot start: {os.strerror(abs(problem))}")


def take_over() -> None:
    """Let the sound thread render from now on."""
    end = time.monotonic() + _HANDOVER
    while not library().sound_take_over():
        if time.monotonic() > end:
            raise LinkError(f"soft-amp: its lines did not respond within {_HANDOVER:g} s")
        time.sleep(_POLL)
