"""Libraries compiled at first use and kept in the user's cache folder.

They run within this process. So one is loaded only if no other user could have written it, and if
it is whole: the SHA-256 of its content is in a file beside it.
"""

import ctypes
import hashlib
import logging
import os
import platform
import stat
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import platformdirs

from model.compiled.compiler import compile_library
from model.errors import InputError

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
        folder = _own_folder(platformdirs.user_cache_path("era-haptics", appauthor=False))
    except OSError as error:
        _logger.warning("%s: compiled at every start: %s", what, error)
    else:
        path = folder / file
        with suppress(OSError):
            return _load(path)
        with suppress(OSError):  # no space
            _compile(path, sources, flags=flags, what=what)
            return _load(path)
    with tempfile.TemporaryDirectory(prefix="era-haptics-") as own:
        try:
            path = _own_folder(Path(own)) / file
            _compile(path, sources, flags=flags, what=what)
            return _load(path)
        except OSError as error:
            raise InputError(f"{what} cannot be loaded: {error}") from None


def check_own(path: Path, *, sticky: bool = False) -> None:
    """Raise PermissionError if another user but root could have written a file or folder.

    sticky: whether others may write to a folder with the sticky bit, where they cannot rename what
    is not theirs.
    """
    if sys.platform == "win32":  # its cache folders are the user's own
        return
    status = path.stat()
    remedy = f"chown it to {os.geteuid()}, chmod go-w it, or set XDG_CACHE_HOME"
    if status.st_uid not in (0, os.geteuid()):
        raise PermissionError(f"{path} must belong to the user, got {status.st_uid}; {remedy}")
    if sticky and status.st_mode & stat.S_ISVTX:
        return
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        mode = stat.filemode(status.st_mode)
        raise PermissionError(f"{path} must be writable by its owner only, got {mode}; {remedy}")


def _own_folder(folder: Path) -> Path:
    """Make a folder, checked with its parents; returns it without links in its path."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder = folder.resolve()
    check_own(folder)
    for parent in folder.parents:
        check_own(parent, sticky=True)
    return folder


def _load(path: Path) -> ctypes.CDLL:
    """Load a library; raises OSError where it is not safe, not whole or not there."""
    checksum = _checksum_file(path)
    for each in (path, checksum):
        check_own(each)
    if hashlib.sha256(path.read_bytes()).hexdigest() != checksum.read_text().strip():
        raise OSError(f"{path} must have the SHA-256 in {checksum.name}")
    found = ctypes.CDLL(str(path))
    os.utime(path)
    return found


def _compile(path: Path, sources: Sequence[Path], *, flags: Sequence[str], what: str) -> None:
    compile_library(path, sources, flags=flags, what=what)
    with tempfile.NamedTemporaryFile("w", prefix=".", dir=path.parent, delete=False) as file:
        file.write(hashlib.sha256(path.read_bytes()).hexdigest())
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
