"""The library of kernels for this processor: of a wheel, or compiled at first use."""

import ctypes
import logging
import os
import platform
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from model.compiled.library_cache import compile_library, kept_library
from model.compiled.structures import NO_MEMORY
from model.errors import InputError

_HERE = Path(__file__).parent
_SOURCES = tuple(sorted(_HERE.glob("*.c")))
_HEADERS = tuple(sorted(_HERE.glob("*.h")))
_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_WHAT = "the library of kernels"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Version:
    """Kernels for processors with some features, by numpy's names, each with a compiler's flag.

    lanes: cases at once, as many as fill one register of the processor; more are many times slower.
    """

    name: str
    lanes: int
    features: Mapping[str, str]

    @property
    def file(self) -> str:
        """Name of the library in a wheel of one platform."""
        return f"kernels-{self.name}.so"

    @property
    def flags(self) -> tuple[str, ...]:
        """Flags of the compiler."""
        return (*_FLAGS, f"-DLANES={self.lanes}", *self.features.values())


_AVX2 = {"AVX2": "-mavx2", "FMA3": "-mfma"}
_AVX512 = {"AVX512F": "-mavx512f", "AVX512DQ": "-mavx512dq", "AVX512VL": "-mavx512vl", **_AVX2}
_PLAIN = Version("plain", 4, {})
_OF_X86 = (Version("avx512", 16, _AVX512), Version("avx2", 8, _AVX2), _PLAIN)


def versions() -> tuple[Version, ...]:
    """Those for processors of this architecture, the fastest first.

    On Windows without AVX: gcc does not align its registers on the stack there (GCC bug 54412).
    """
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    return _OF_X86 if is_x86 and os.name == "posix" else (_PLAIN,)


def processor_features() -> AbstractSet[str]:
    """What numpy knows of this processor; none where it does not say."""
    try:
        known = import_module("numpy._core._multiarray_umath").__cpu_features__
    except (ImportError, AttributeError):  # of no public interface
        return frozenset()
    return {name for name, has in known.items() if has}


@dataclass(frozen=True, eq=False)
class Kernels:
    """The library, and the cases that its kernels take at once."""

    library: ctypes.CDLL
    lanes: int


@cache
def kernels() -> Kernels | None:
    """Those for this processor; None where there is no compiler, and numpy has to do."""
    has = processor_features()
    version = next(each for each in versions() if each.features.keys() <= has)
    own = _HERE / version.file
    try:
        library = ctypes.CDLL(str(own)) if own.exists() else _compiled(version)
        return Kernels(library, version.lanes)
    except (InputError, OSError) as error:
        _logger.warning("%s: %s", WITHOUT_KERNELS, error)
        return None


WITHOUT_KERNELS = "answers take 6 to 19 times as long without kernels in C"
"""Of steady ones, from twenty fingers that share to one, beside 0 to 6 quiet ones on four and on
twelve ERAs, by both in turn (python -m benchmarks.contents --sharing); clicks take 1.3 times."""


def why_slow() -> str | None:
    """How much slower this machine is for want of a compiler, in words; None where it is not."""
    return None if kernels() else f"{WITHOUT_KERNELS}; install a C compiler, such as gcc or clang"


def run(kernel: Callable[..., int], *given: Any) -> int:
    """Run a kernel on structures and other arguments; its status. Raises MemoryError."""
    arguments = []
    for each in given:
        arguments.append(ctypes.byref(each) if isinstance(each, ctypes.Structure) else each)
    status = kernel(*arguments)
    if status == NO_MEMORY:
        raise MemoryError("kernels could not get the memory that an answer takes")
    return status


def compile_kernels(folder: Path) -> list[Path]:
    """Compile all versions for this architecture to files in a folder. Raises InputError."""
    paths = [folder / version.file for version in versions()]
    for path, version in zip(paths, versions(), strict=True):
        compile_library(path, _SOURCES, flags=version.flags, what=_WHAT)
    return paths


def _compiled(version: Version) -> ctypes.CDLL:
    name = f"kernels-{version.name}"
    return kept_library(name, _SOURCES, _HEADERS, flags=version.flags, what=_WHAT)
