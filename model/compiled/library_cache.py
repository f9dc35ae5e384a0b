"""Libraries compiled by the machine's compiler at first use, kept in the user's cache folder.

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
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from model.caching import cache_folder
from model.errors import InputError

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
