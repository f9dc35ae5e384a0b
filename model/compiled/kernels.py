"""C kernels: their structures, and the library for this processor.

`kernels` loads the library from the wheel, or compiles it at first use with the machine's compiler
and caches it in the user's cache folder. It runs within this process, so it is loaded only if no
other user could have written it and if it is complete: the SHA-256 of its content is in a second
file. The kernels' headers describe the fields of the structures.
"""

import ctypes
import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from ctypes import c_double, c_float, c_int, c_void_p
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.caching import cache_folder
from model.errors import InputError

FOUND, NO_MEMORY = 0, -1

_TYPES = {"i": np.int32, "f": np.float32, "c": np.complex64}
"""Types of arrays for kernels, by numpy's kind: integers, real and complex numbers."""


def _fields(**names: str) -> list[tuple[str, Any]]:
    """Make fields from names by kind: i: integers, f: floats, d: doubles, p: pointers."""
    kinds = {"i": c_int, "f": c_float, "d": c_double, "p": c_void_p}
    return [(name, kinds[kind[0]]) for kind, all_ in names.items() for name in all_.split()]


class Structure(ctypes.Structure):
    """A structure that keeps the arrays to which it points."""

    arrays: list[NDArray[Any]]

    def point(self, **given: NDArray[Any] | None) -> None:
        """Set pointers to arrays, which are converted for kernels; None leaves a null pointer."""
        self.arrays = [*getattr(self, "arrays", [])]
        for name, array in given.items():
            if array is not None:
                kept = as_given(array)
                self.arrays.append(kept)
                setattr(self, name, kept.ctypes.data)


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Convert values for kernels: contiguous, in single precision or integers of 32 bits."""
    return np.ascontiguousarray(values, dtype=_TYPES[values.dtype.kind])


class TouchedPlates(Structure):
    """The plate on its ERAs with fingers on it: `plates` in C."""

    _fields_ = [
        *_fields(i="n b k r t off rows lanes kept"),
        *_fields(p="receptance by_force coupling moved minus_omega2 forces strokes by_damping"),
        *_fields(p="by_stiffness by_loss attached shapes centres stiffness load_std of_blocks"),
    ]


class PointGroups(Structure):
    """Groups of points whose expected powers are wanted: `grouped` in C."""

    _fields_ = [
        *_fields(i="groups p fine others", f="gain_variance ridge"),
        *_fields(p="points fine_points weights error shares is_fine", i="rim"),
    ]


class PlateDraws(Structure):
    """Plates within the uncertainty: `draws` in C."""

    _fields_ = _fields(
        i="count bases nodes width first_base first_node amplifiers",
        p="node loss damping own gains errors harmonics delays amplifier",
    )


class Sensors(Structure):
    """Points of all fingers: `sensors` in C."""

    _fields_ = _fields(i="points", p="rows weights error threshold")


class WeightSearch(Structure):
    """How weights are computed at each frequency: `method` in C."""

    _fields_ = _fields(i="steps limited", f="variance gain reserve growth most")


class Rules(Structure):
    """How tones are chosen: `rules` in C."""

    _fields_ = [
        *_fields(i="kept missing max_by_point pruning_step"),
        *_fields(i="rim_count is_deep others"),
        *_fields(f="gain_variance ridge margin highest reached"),
        *_fields(f="judged promised", i="starts iterations again"),
        ("one_finger", WeightSearch),
        ("several", WeightSearch),
        ("within", 3 * WeightSearch),
        *_fields(i="groups sets", p="rim group threshold error shares frequencies sensitivities"),
        *_fields(p="harmonic_sensitivities search_error harmonic_threshold at_harmonics"),
    ]


class GivenRaster(Structure):
    """Shapes of the plate, and how they are read under a fingertip: `raster` in C."""

    _fields_ = _fields(
        i="nx ny side_x side_y r few fine",
        d="length width radius",
        p="points weights nodes shapes",
    )


class GivenQuestion(Structure):
    """Fingers and their requests: `question` in C, without its trailing results."""

    _fields_ = [
        *_fields(i="contents bands fingers quiet_count candidates combinations", f="apart"),
        *_fields(p="numbers level places stiffness at_harmonics load_std background"),
        *_fields(p="judging promise"),
    ]


class FoundTones(Structure):
    """Tones and their sensations: `answered` in C."""

    _fields_ = _fields(i="is_apart", p="rows figures")


class Shaping(Structure):
    """How knots are computed: `shaping` in C."""

    _fields_ = _fields(
        i="samples steps knots ending_knots iterations", f="ridge penalty relaxation", p="rise"
    )


class ShapedTone(Structure):
    """A tone whose onset or ending is shaped: `shaped_tone` in C."""

    _fields_ = [
        *_fields(i="eras targets rows combinations", f="gain_variance weight"),
        *_fields(p="hats steady amplitudes", i="total"),
        *_fields(p="active residual"),
    ]


_COMPILERS = ("cc", "gcc", "clang")
COMPILE_TIMEOUT = 120.0  # s


def compile_library(
    path: Path, sources: Iterable[Path], *, flags: Sequence[str], what: str
) -> None:
    """Compile C sources to a shared library; raises InputError.

    what: its name in messages.
    """
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None or not shutil.which(compiler.split()[0]):
        raise InputError(
            f"{what} is compiled at first use and there is no C compiler "
            f"({compiler or ', '.join(_COMPILERS)}); install one (Debian: apt install gcc "
            "libc6-dev; macOS: xcode-select --install)"
        )
    # A separate folder, since threads and processes can compile the same library simultaneously.
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        made = Path(folder) / path.name
        _compile(made, compiler.split(), sources, flags=flags, what=what)
        with made.open("r+b") as file:  # Windows flushes only files that are open for writing
            os.fsync(
                file.fileno()
            )  # after a power failure the name must not be without its content
        made.replace(path)


def _compile(
    made: Path,
    compiler: Sequence[str],
    sources: Iterable[Path],
    *,
    flags: Sequence[str],
    what: str,
) -> None:
    files = map(str, (made, *sorted(sources)))
    command = [*compiler, *flags, "-fPIC", "-shared", "-o", *files, "-lm"]
    try:
        done = subprocess.run(  # noqa: S603  the user's compiler
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=COMPILE_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{what} must be compiled within {COMPILE_TIMEOUT:g} s, got no end of "
            f"{' '.join(compiler)}; set CC to another compiler"
        ) from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise InputError(
            f"{what} could not be compiled by {' '.join(compiler)}: {first}; install the C headers "
            "(Debian: apt install gcc libc6-dev)"
        )


MAX_KEPT_LIBRARIES = 8  # the least recently used go first

_logger = logging.getLogger(__name__)


def kept_library(
    name: str,
    sources: Iterable[Path],
    headers: Iterable[Path] = (),
    *,
    flags: Sequence[str],
    what: str,
) -> ctypes.CDLL:
    """Load the library of C sources; compile it if the cache has none that is safe and complete.

    If the cache cannot be used, compile to a temporary folder, for this process only. what: name of
    the library in messages. Raises InputError.
    """
    sources = list(sources)
    # The C library and its version, if known: glibc2.36.
    libc = "".join(platform.libc_ver()) or str(sysconfig.get_config_var("HOST_GNU_TYPE"))
    file = f"{name}-{libc}-{_digest([*sources, *headers], flags)}.so"
    try:
        folder = _own_folder(cache_folder())
    except OSError as error:
        _logger.warning("%s: compiled at every start: %s", what, error)
    else:
        path = folder / file
        with suppress(OSError):
            return _load(path)
        with suppress(OSError):  # no space
            _compile_with_sum(path, sources, flags=flags, what=what)
            return _load(path)
    with tempfile.TemporaryDirectory(prefix="era-haptics-", ignore_cleanup_errors=True) as own:
        try:
            path = _own_folder(Path(own)) / file
            _compile_with_sum(path, sources, flags=flags, what=what)
            return _load(path)
        except OSError as error:
            raise InputError(f"{what} cannot be loaded: {error}") from None


def check_own(path: Path, *, sticky: bool = False) -> None:
    """Raise PermissionError if a user other than this one and root could write a file or folder.

    sticky: whether others can write to a folder with the sticky bit, in which they cannot rename
    other users' files.
    """
    if not hasattr(os, "geteuid"):  # Windows: its cache folders are the user's own
        return
    status, owners = path.stat(), {path.stat().st_uid, path.lstat().st_uid}
    remedy = f"chown it to {os.geteuid()}, chmod go-w it, or set XDG_CACHE_HOME"
    if not owners <= {0, os.geteuid()}:
        raise PermissionError(f"{path} must belong to the user, got {max(owners)}; {remedy}")
    if sticky and status.st_mode & stat.S_ISVTX:
        return
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        mode = stat.filemode(status.st_mode)
        raise PermissionError(f"{path} must be writable only for the owner, got {mode}; {remedy}")


def _own_folder(folder: Path) -> Path:
    """Make a folder and check it with its parents and all links on the way; return it resolved.

    The owner of a link, or of the folder that it is in, could point it to another library.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_own(folder)
    ways = [folder.absolute()]
    for way in ways:  # grows by the targets of links
        for each in (way, *way.parents):
            check_own(each, sticky=True)
            if each.is_symlink():
                ways.append(each.parent / each.readlink())
    return folder.resolve()


def _load(path: Path) -> ctypes.CDLL:
    """Load a library; raises OSError if it is not safe, not complete or does not exist."""
    checksum = _checksum_file(path)
    for each in (path, checksum):
        check_own(each)
    if hashlib.sha256(path.read_bytes()).hexdigest() != checksum.read_bytes().decode().strip():
        raise OSError(f"{path} must have the SHA-256 in {checksum.name}")
    found = ctypes.CDLL(str(path))
    os.utime(path)
    return found


def _compile_with_sum(
    path: Path, sources: Sequence[Path], *, flags: Sequence[str], what: str
) -> None:
    compile_library(path, sources, flags=flags, what=what)
    with tempfile.NamedTemporaryFile("wb", prefix=".", dir=path.parent, delete=False) as file:
        file.write(hashlib.sha256(path.read_bytes()).hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())
    Path(file.name).replace(_checksum_file(path))
    _clean_up(path.parent)


def _clean_up(folder: Path) -> None:
    """Remove all libraries but the most recently used ones."""
    libraries = sorted(folder.glob("*.so"), key=lambda path: path.stat().st_mtime)
    for path in libraries[:-MAX_KEPT_LIBRARIES]:
        path.unlink(missing_ok=True)
        _checksum_file(path).unlink(missing_ok=True)


def _checksum_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _digest(files: Iterable[Path], flags: Sequence[str]) -> str:
    """Return sixteen digits that depend on the files, the flags, CC and the architecture."""
    made_of = hashlib.sha256(repr((*flags, os.environ.get("CC"), sys.platform)).encode())
    made_of.update(platform.machine().encode())
    for path in sorted(files):
        made_of.update(path.name.encode() + path.read_bytes())
    return made_of.hexdigest()[:16]


KERNEL_FOLDER = Path(__file__).parent
_SOURCES = tuple(sorted(KERNEL_FOLDER.glob("*.c")))
_HEADERS = tuple(sorted(KERNEL_FOLDER.glob("*.h")))
_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_WHAT = "the library of kernels"


@dataclass(frozen=True)
class Version:
    """A version of the kernels for processors with some features."""

    name: str
    lanes: int
    """Cases processed together: as many as fill a register of the processor; more are many times
    slower."""
    features: Mapping[str, str]
    """Compiler flag per feature, by numpy's feature name."""

    @property
    def file(self) -> str:
        """Name of the library in a wheel."""
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
    """Return the versions for this architecture, the fastest first.

    Without AVX on Windows, where gcc does not align its registers on the stack (GCC bug 54412).
    """
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    return _OF_X86 if is_x86 and os.name == "posix" else (_PLAIN,)


def processor_features() -> AbstractSet[str]:
    """Return the features of this processor by numpy's names; empty if numpy does not tell."""
    try:
        known = import_module("numpy._core._multiarray_umath").__cpu_features__
    except (ImportError, AttributeError):  # not a public interface
        return frozenset()
    return {name for name, has in known.items() if has}


@dataclass(frozen=True, eq=False)
class Kernels:
    """The library, and the number of cases per kernel call."""

    library: ctypes.CDLL
    lanes: int


@cache
def kernels() -> Kernels | None:
    """Load the kernels for this processor; None without a compiler, where numpy is used instead."""
    has = processor_features()
    version = next(each for each in versions() if each.features.keys() <= has)
    own = KERNEL_FOLDER / version.file
    try:
        if own.exists():
            return Kernels(ctypes.CDLL(str(own)), version.lanes)
        name = f"kernels-{version.name}"
        library = kept_library(name, _SOURCES, _HEADERS, flags=version.flags, what=_WHAT)
        return Kernels(library, version.lanes)
    except (InputError, OSError) as error:
        _logger.warning("%s: %s", WITHOUT_KERNELS, error)
        return None


WITHOUT_KERNELS = "answers take 6 to 19 times as long without kernels in C"
"""Measured for steady vibrations of one to twenty sharing fingers, with 0 to 6 quiet fingers.

On four and on twelve ERAs; clicks take 1.3 times as long.
"""


def why_slow() -> str | None:
    """Return in words how much slower this machine is without a compiler, None if it has one."""
    return None if kernels() else f"{WITHOUT_KERNELS}; install a C compiler, such as gcc or clang"


def run_kernel(kernel: Callable[..., int], *given: Any) -> int:
    """Run a kernel on structures and other arguments and return its status; raises MemoryError."""
    status = kernel(
        *[ctypes.byref(each) if isinstance(each, ctypes.Structure) else each for each in given]
    )
    if status == NO_MEMORY:
        raise MemoryError("kernels could not get the memory that an answer takes")
    return status


def compile_kernels(folder: Path) -> list[Path]:
    """Compile all versions for this architecture to files in a folder; raises InputError."""
    paths = [folder / version.file for version in versions()]
    for path, version in zip(paths, versions(), strict=True):
        compile_library(path, _SOURCES, flags=version.flags, what=_WHAT)
    return paths
