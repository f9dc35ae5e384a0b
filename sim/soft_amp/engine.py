"""The engine of a software amplifier: its library, settings and counters.

The library is `firmware/ports/sound/sound.h`, from a wheel of this platform or compiled at first
use.
"""

import ctypes
import os
from functools import cache
from pathlib import Path

from drivers.errors import LinkError
from model.compiled.kernels import compile_library, kept_library
from model.errors import InputError
from sim.soft_amp.settings import Law, SoftAmplifierLine, SoftAmplifierSettings

ENGINE = "sound-engine.so"
"""File of the library in a platform wheel; a module name would hide this module."""

_HERE = Path(__file__).parent
_FOLDERS = (_HERE / "firmware", _HERE.parents[1] / "firmware")  # of a wheel, of a checkout
_PARTS = ("core", "wire", "ports/sound")
_CORE = ("channel", "layers", "set", "sine", "states", "voice")
_WIRE = ("crc", "mbap", "messages", "modbus", "serial")
_FLAGS = (
    "-std=c99",
    "-O2",
    "-fno-math-errno",
    "-pthread",
    '-DCONFIG_FILE="sound_config.h"',
)
_WHAT = "soft-amp: its engine"


@cache
def library() -> ctypes.CDLL:
    """Load the library, and compile it if necessary; raises InputError."""
    own = _HERE / ENGINE
    if own.exists():
        try:
            return ctypes.CDLL(str(own))
        except OSError as problem:
            raise InputError(
                f"soft-amp: {own} cannot be loaded: {problem}; reinstall era-haptics"
            ) from None
    sources, headers, flags = _recipe()
    return kept_library("soft-amp", sources, headers, flags=flags, what=_WHAT)


def callback_address(name: str) -> int:
    """Return the address of a callback in the library."""
    address = ctypes.cast(getattr(library(), name), ctypes.c_void_p).value
    assert address is not None  # noqa: S101  of a function
    return address


def compile_engine(path: Path) -> None:
    """Compile the library to a file; raises InputError."""
    sources, _, flags = _recipe()
    compile_library(path, sources, flags=flags, what=_WHAT)


def _recipe() -> tuple[list[Path], list[Path], list[str]]:
    """Sources, headers and flags of the compiler; raises InputError."""
    folder = _source_folder()
    sources = [folder / "core" / f"{name}.c" for name in _CORE]
    sources += [folder / "wire" / f"{name}.c" for name in _WIRE]
    sources += (folder / "ports" / "sound").glob("*.c")
    headers: list[Path] = []
    flags = list(_FLAGS)
    for part in _PARTS:
        headers += (folder / part).glob("*.h")
        flags.append(f"-I{folder / part}")
    return sources, headers, flags


def _source_folder() -> Path:
    """The folder of the C sources; raises InputError."""
    for folder in _FOLDERS:
        if (folder / "ports" / "sound").is_dir():
            return folder
    raise InputError(f"soft-amp: its C sources are missing in {_FOLDERS[0]}; reinstall era-haptics")


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
