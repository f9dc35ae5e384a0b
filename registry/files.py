"""Open user-named files safely (regular files only, limited in size, never blocking); lock files.

Locks exist on POSIX systems only. Wires, daemon, clients and gateway need them; the plate, its
tables, answers and designs do not, and a missing module is explained (`posix_needed`).
"""

import errno
import os
import stat
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO


def regular_file(name: str, flags: int) -> int:
    """Open a file as `opener` of `open`; raises OSError for a pipe, a socket or a device.

    A pipe would be waited for until something writes into it, and a device may never end.
    """
    flags |= getattr(os, "O_NONBLOCK", 0)  # not on Windows
    descriptor = os.open(name, flags, 0o666)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):  # `open` refuses a folder
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "must be a regular file, got a pipe or a device", name)


def open_regular(path: Path, max_bytes: int) -> BinaryIO:
    """Open a file for reading; raises OSError like `regular_file`, and for a larger file.

    `strerror` states the rule. A sparse file can be long without using the disk.
    """
    stream = open(path, "rb", opener=regular_file)  # noqa: SIM115
    if os.fstat(stream.fileno()).st_size > max_bytes:
        stream.close()
        raise _too_long(path, max_bytes)
    return stream


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Read a whole file; raises OSError like `open_regular`."""
    with open_regular(path, max_bytes) as stream:
        content = stream.read(max_bytes + 1)
    if len(content) > max_bytes:  # of a length that no system states
        raise _too_long(path, max_bytes)
    return content


class LineTooLong(ValueError):
    """A line of text that is longer than expected; its number is in `line`."""

    def __init__(self, line: int, max_length: int) -> None:
        self.line = line
        super().__init__(f"line must have less than {max_length} characters")


def lines_of(stream: TextIO, max_length: int) -> Iterator[str]:
    """Yield the lines of a text without their ends; raises LineTooLong.

    A line of a binary or hostile file may be as long as the file.
    """
    for number, line in enumerate(iter(partial(stream.readline, max_length), ""), start=1):
        if len(line) == max_length and not line.endswith("\n"):
            raise LineTooLong(number, max_length)
        yield line.removesuffix("\n")


def _too_long(path: Path, max_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"must be up to {max_bytes >> 20} MiB long", str(path))


_MODULES = frozenset(("fcntl", "pwd", "resource", "termios", "tty"))


def lock(file: IO[Any]) -> None:
    """Lock an open file until it is closed or its process ends, even by a crash.

    Raises BlockingIOError if it is locked already, OSError if its file system does not lock.
    """
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def posix_needed(error: BaseException) -> str | None:
    """Return the remedy for a missing POSIX module; None for other errors."""
    if not isinstance(error, ModuleNotFoundError) or error.name not in _MODULES:
        return None
    return f"wires, daemon and clients need Linux or macOS (no module {error.name} here); use WSL"
