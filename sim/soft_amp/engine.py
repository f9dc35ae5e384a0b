"""The engine of a software amplifier: its library, settings and counters.

The library is `firmware/ports/sound/sound.h`, compiled when era-haptics is installed
(`build_libraries.py`).
"""

import ctypes
import os
from functools import cache
from pathlib import Path

from drivers.errors import LinkError
from model.errors import InputError
from sim.soft_amp.settings import Law, SoftAmplifierLine, SoftAmplifierSettings

ENGINE_FILE = Path(__file__).with_name("sound-engine.so")


@cache
def library() -> ctypes.CDLL:
    """Load the library; raises InputError."""
    if not ENGINE_FILE.exists():
        raise InputError(
            "soft-amp: its engine is compiled when era-haptics is installed, and there was no C "
            "compiler; install one (Debian: apt install gcc libc6-dev), then reinstall era-haptics"
        )
    try:
        return ctypes.CDLL(str(ENGINE_FILE))
    except OSError as error:
        raise InputError(
            f"soft-amp: {ENGINE_FILE} cannot be loaded: {error}; reinstall era-haptics"
        ) from None


def callback_address(name: str) -> int:
    """Return the address of a callback in the library."""
    address = ctypes.cast(getattr(library(), name), ctypes.c_void_p).value
    assert address is not None  # noqa: S101  of a function
    return address


class Counters(ctypes.Structure):
    """`struct counters` of firmware/ports/sound/counters.h."""

    _fields_ = (
        ("blocks", ctypes.c_uint64),
        ("frames", ctypes.c_uint64),
        ("gaps", ctypes.c_uint64),
        ("xruns", ctypes.c_uint64),
        ("clipped", ctypes.c_uint64),
        ("requests", ctypes.c_uint64),
        ("is_realtime", ctypes.c_uint32),
        ("block", ctypes.c_uint32),
    )


class _SoundSettings(ctypes.Structure):
    _fields_ = (
        ("rate", ctypes.c_uint32),
        ("channels", ctypes.c_uint32),
        ("law", ctypes.c_uint32),
        ("protocol", ctypes.c_uint32),
        ("limit", ctypes.c_double),
        ("max_gaps", ctypes.c_uint32),
        ("serial_number", ctypes.c_char_p),
    )


class _LinesSettings(ctypes.Structure):
    _fields_ = (
        ("terminal", ctypes.c_int),
        ("listening", ctypes.c_int),
    )


def start_engine(
    settings: SoftAmplifierSettings, line: SoftAmplifierLine, *, rate: int, counters: Counters
) -> None:
    """Start the amplifiers at a sample rate [Hz], and serve their line; raises LinkError.

    Requests of hosts take effect when the callback renders a block. A process has one engine, which
    runs until the process ends.
    """
    sound = _SoundSettings(
        rate,
        settings.channels,
        list(Law).index(settings.law),
        settings.protocol,
        settings.limit,
        settings.max_gaps,
        settings.serial_number.encode(),
    )
    lines = _LinesSettings(line.terminal, line.listening)
    problem = library().sound_start(
        ctypes.byref(sound), ctypes.byref(lines), ctypes.byref(counters)
    )
    if problem:
        raise LinkError(f"soft-amp: cannot start: {os.strerror(problem)}")
