"""The library of kernels for this processor: of a wheel, or compiled at first use.

Structures and arrays as the kernels in C take them, whose headers say what is in them.

Libraries compiled by the machine's compiler at first use, kept in the user's cache folder.

They run within this process. So one is loaded only if no other user could have written it, and if
it is whole: the SHA-256 of its content is in a file beside it.
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
"""Of values that are integers, real and complex."""


def _fields(**names: str) -> list[tuple[str, Any]]:
    """Names of fields by the first letter of their kind: integers, floats, doubles, pointers."""
    kinds = {"i": c_int, "f": c_float, "d": c_double, "p": c_void_p}
    return [(name, kinds[kind[0]]) for kind, all_ in names.items() for name in all_.split()]


class Structure(ctypes.Structure):
    """A structure that keeps the arrays to which it points."""

    arrays: list[NDArray[Any]]

    def point(self, **given: NDArray[Any] | None) -> None:
        """Point to arrays as kernels read them; to none where there is none."""
        self.arrays = [*getattr(self, "arrays", [])]
        for name, array in given.items():
            if array is not None:
                kept: NDArray[Any] = np.ascontiguousarray(array, dtype=_TYPES[array.dtype.kind])
                self.arrays.append(kept)
                setattr(self, name, kept.ctypes.data)


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Values as a kernel reads them: single precision, or integers of 32 bits, one by one."""
    return np.ascontiguousarray(values, dtype=_TYPES[values.dtype.kind])


class TouchedPlates(Structure):
    """`plates`: the plate on its ERAs, with fingers on it."""

    _fields_ = [
        *_fields(i="n b k r t off rows lanes kept", f="load_std"),
        *_fields(p="receptance by_force coupling moved minus_omega2 forces strokes by_damping"),
        *_fields(p="by_stiffness by_loss attached shapes centres stiffness of_blocks"),
    ]


class PointGroups(Structure):
    """`grouped`: groups of points whose expected powers are wanted."""

    _fields_ = [
        *_fields(i="groups p fine others", f="gain_variance ridge"),
        *_fields(p="points fine_points weights error shares is_fine", i="rim"),
    ]


class PlateDraws(Structure):
    """`draws`: plates within the uncertainty."""

    _fields_ = _fields(
        i="count bases nodes width first_base first_node amplifiers",
        p="node loss damping own gains errors harmonics delays amplifier",
    )


class Sensors(Structure):
    """`sensors`: points of all fingers."""

    _fields_ = _fields(i="points", p="rows weights error threshold")


class WeightSearch(Structure):
    """`method`: weights that are tried at each frequency."""

    _fields_ = _fields(i="steps limited", f="variance gain reserve growth most")


class Rules(Structure):
    """`rules`: how tones are chosen."""

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
    """`raster`: shapes of the plate, and how they are read under a fingertip."""

    _fields_ = _fields(
        i="nx ny side_x side_y r few fine",
        d="length width radius",
        p="points weights nodes shapes",
    )


class GivenQuestion(Structure):
    """`question`: fingers, and what each is to feel; what is found first is not named."""

    _fields_ = [
        *_fields(i="contents bands fingers quiet_count candidates combinations", f="apart"),
        *_fields(p="numbers level places stiffness at_harmonics background judging promise"),
    ]


class FoundTones(Structure):
    """`answered`: tones, and what is felt of them."""

    _fields_ = _fields(i="is_apart", p="rows figures")


class Shaping(Structure):
    """`shaping`: how knots are found."""

    _fields_ = _fields(
        i="samples steps knots ending_knots iterations", f="ridge penalty relaxation", p="rise"
    )


class ShapedTone(Structure):
    """`shaped_tone`: a tone whose onset or ending is shaped."""

    _fields_ = [
        *_fields(i="eras targets rows combinations", f="gain_variance weight"),
        *_fields(p="hats steady amplitudes", i="total"),
        *_fields(p="active residual"),
    ]


_COMPILERS = ("cc", "gcc", "clang")
_TIMEOUT = 120.0  # s


def compile_library(
    path: Path, sources: Iterable[Path], *, flags: Sequence[str], what: str
) -> None:
    """Compile C sources to a shared library; what: its name in messages. Raises InputError."""
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None or not shutil.which(compiler.split()[0]):
        raise InputError(
            f"{what} is compiled at first use and there is no C compiler "
            f"({compiler or ', '.join(_COMPILERS)}); install one (Debian: apt install gcc "
            "libc6-dev; macOS: xcode-select --install)"
        )
    # Of its own, since threads and processes may compile the same at once.
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        made = Path(folder) / path.name
        _compile(made, compiler.split(), sources, flags=flags, what=what)
        with made.open("r+b") as file:  # Windows writes what is open for writing alone to the disk
            os.fsync(file.fileno())  # a name must not outlive a power failure without its content
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
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{what} must be compiled within {_TIMEOUT:g} s, got no end of {' '.join(compiler)}; "
            "set CC to another compiler"
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
    """Load the library of C sources, compiled where the cache holds none that is safe and whole.

    Where the cache cannot be used it is compiled to a folder of its own, for this process only.
    what: its name in messages. Raises InputError.
    """
    sources = list(sources)
    file = f"{name}-{_libc()}-{_digest([*sources, *headers], flags)}.so"
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
    """Raise PermissionError if another user but root could have written a file or folder.

    sticky: whether others may write to a folder with the sticky bit, where they cannot rename what
    is not theirs.
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
        raise PermissionError(f"{path} must be writable by its owner only, got {mode}; {remedy}")


def _own_folder(folder: Path) -> Path:
    """Make a folder, checked with its parents and all links on its way; returns it without these.

    Who owns a link, or writes where it is, could lead to a library that the user only keeps.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_own(folder)
    ways = [folder.absolute()]
    for way in ways:  # and where each link leads to
        for each in (way, *way.parents):
            check_own(each, sticky=True)
            if each.is_symlink():
                ways.append(each.parent / each.readlink())
    return folder.resolve()


def _load(path: Path) -> ctypes.CDLL:
    """Load a library; raises OSError where it is not safe, not whole or not there."""
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


def _libc() -> str:
    """The C library and its version, where it has one: `glibc2.36`."""
    return "".join(platform.libc_ver()) or str(sysconfig.get_config_var("HOST_GNU_TYPE"))


def _digest(files: Iterable[Path], flags: Sequence[str]) -> str:
    """Sixteen digits that change with the files, the flags, CC and the architecture."""
    made_of = hashlib.sha256(repr((*flags, os.environ.get("CC"), sys.platform)).encode())
    made_of.update(platform.machine().encode())
    for path in sorted(files):
        made_of.update(path.name.encode() + path.read_bytes())
    return made_of.hexdigest()[:16]


_HERE = Path(__file__).parent
_SOURCES = tuple(sorted(_HERE.glob("*.c")))
_HEADERS = tuple(sorted(_HERE.glob("*.h")))
_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_WHAT = "the library of kernels"


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
