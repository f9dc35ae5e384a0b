"""The library of kernels: of a wheel of this platform, or compiled at first use."""

import ctypes
from functools import cache
from pathlib import Path

from model.compiled.compiler import compile_library, kept_library
from model.errors import InputError

KERNELS = "kernels.so"
"""The file of the library in a wheel of one platform."""

_HERE = Path(__file__).parent
_SOURCES = tuple(sorted(_HERE.glob("*.c")))
_HEADERS = (_HERE / "lanes.h",)
_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_WHAT = "the library of kernels"


@cache
def kernels() -> ctypes.CDLL | None:
    """The library; None where there is no compiler, and numpy has to do."""
    try:
        own = _HERE / KERNELS
        path = (
            own
            if own.exists()
            else kept_library("kernels", _SOURCES, _HEADERS, flags=_FLAGS, what=_WHAT)
        )
        return ctypes.CDLL(str(path))
    except (InputError, OSError):
        return None


def compile_kernels(path: Path) -> None:
    """Compile the library to a file. Raises InputError."""
    compile_library(path, _SOURCES, flags=_FLAGS, what=_WHAT)
