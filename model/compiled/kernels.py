"""The library of kernels for this processor: of a wheel, or compiled at first use."""

import ctypes
import platform
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from model.compiled.compiler import compile_library, kept_library
from model.errors import InputError

_HERE = Path(__file__).parent
_SOURCES = tuple(sorted(_HERE.glob("*.c")))
_HEADERS = (_HERE / "lanes.h",)
_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_WHAT = "the library of kernels"


@dataclass(frozen=True)
class Version:
    """Kernels for processors with some features.

    lanes: cases at once, as many as fill one register of the processor; more are many times slower.
    """

    name: str
    lanes: int
    features: frozenset[str] = frozenset()

    @property
    def file(self) -> str:
        """Name of the library in a wheel of one platform."""
        return f"kernels-{self.name}.so"

    @property
    def flags(self) -> tuple[str, ...]:
        """Flags of the compiler."""
        needed = (f"-m{feature}" for feature in sorted(self.features))
        return (*_FLAGS, f"-DLANES={self.lanes}", *needed)


_AVX2 = frozenset({"avx2", "fma"})
_AVX512 = _AVX2 | {"avx512f", "avx512dq", "avx512vl"}
_PLAIN = Version("plain", 4)
_OF_X86 = (Version("avx512", 16, _AVX512), Version("avx2", 8, _AVX2), _PLAIN)


def versions() -> tuple[Version, ...]:
    """Those for processors of this architecture, the fastest first."""
    return _OF_X86 if platform.machine().lower() in ("x86_64", "amd64") else (_PLAIN,)


def processor_features() -> AbstractSet[str]:
    """What this processor can do, where Linux names it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return next((set(line.split()) for line in lines if line.startswith("flags")), frozenset())


@dataclass(frozen=True, eq=False)
class Kernels:
    """The library, and the cases that its kernels take at once."""

    library: ctypes.CDLL
    lanes: int


@cache
def kernels() -> Kernels | None:
    """Those for this processor; None where there is no compiler, and numpy has to do."""
    has = processor_features()
    version = next(each for each in versions() if each.features <= has)
    own = _HERE / version.file
    try:
        path = own if own.exists() else _compiled(version)
        return Kernels(ctypes.CDLL(str(path)), version.lanes)
    except (InputError, OSError):
        return None


def compile_kernels(folder: Path) -> list[Path]:
    """Compile all versions for this architecture to files in a folder. Raises InputError."""
    paths = [folder / version.file for version in versions()]
    for path, version in zip(paths, versions(), strict=True):
        compile_library(path, _SOURCES, flags=version.flags, what=_WHAT)
    return paths


def _compiled(version: Version) -> Path:
    name = f"kernels-{version.name}"
    return kept_library(name, _SOURCES, _HEADERS, flags=version.flags, what=_WHAT)
