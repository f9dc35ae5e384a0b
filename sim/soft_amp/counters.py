"""What a running software amplifier counts, in memory shared with the process that watches it."""

import ctypes
import mmap
import os
import tempfile
from typing import IO


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
    blocks: int
    frames: int
    gaps: int
    xruns: int
    clipped: int
    requests: int
    is_streaming: int
    is_lost: int
    is_realtime: int
    block: int


def new_file() -> IO[bytes]:
    """A file without a name, of the size of the counters, all zero."""
    file = tempfile.TemporaryFile()  # noqa: SIM115  the caller's
    file.truncate(ctypes.sizeof(Counters))
    return file


def counters_in(descriptor: int) -> Counters:
    """The counters in a file, shared with every process that maps it."""
    os.fstat(descriptor)
    return Counters.from_buffer(mmap.mmap(descriptor, ctypes.sizeof(Counters)))
