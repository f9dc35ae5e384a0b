"""Safe opening of files named by users, and file locks.

Only regular files of limited size are opened, and opening never blocks. Locks need a POSIX system.
"""

import errno
import os
import stat
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO


def regular_file(name: str, flags: int) -> int:
    """Open a file, as `opener` of `open`; raises OSError for a pipe, a socket or a device.

    Opening a pipe would block until another program writes to it. A device can be endless.
    """
    flags |= getattr(os, "O_NONBLOCK", 0)  # not on Windows
    descriptor = os.open(name, flags, 0o666)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):  # `open` rejects a folder
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "must be a regular file, got a pipe or a device", name)


def open_regular(path: Path, max_bytes: int) -> BinaryIO:
    """Open a file for reading; raises OSError like `regular_file`, and for a larger file.

    The error's `strerror` states the rule.
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
    if len(content) > max_bytes:  # the file has grown, or its system reports no size
        raise _too_long(path, max_bytes)
    return content


class LineTooLong(ValueError):
    """A line of text that is too long."""

    def __init__(self, line: int, max_length: int) -> None:
        self.line = line
        """Number of the line, from 1."""
        super().__init__(f"line must have less than {max_length} characters")


def lines_of(stream: TextIO, max_length: int) -> Iterator[str]:
    """Yield the lines of a text without line ends; raises LineTooLong.

    A line of a binary file can be as long as the file.
    """
    for number, line in enumerate(iter(partial(stream.readline, max_length), ""), start=1):
        if len(line) == max_length and not line.endswith("\n"):
            raise LineTooLong(number, max_length)
        yield line.removesuffix("\n")


def _too_long(path: Path, max_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"must be up to {max_bytes >> 20} MiB long", str(path))


def lock(file: IO[Any]) -> None:
    """Lock an open file until it is closed or the process ends, even if it crashes.

    Raises BlockingIOError if the file is already locked, OSError if its file system has no locks.
    """
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


_POSIX_MODULES = frozenset(("fcntl", "pwd", "resource", "termios", "tty"))


def posix_needed(error: BaseException) -> str | None:
    """Return the message for an import error due to a missing POSIX module; None for others."""
    if not isinstance(error, ModuleNotFoundError) or error.name not in _POSIX_MODULES:
        return None
    return f"wires, daemon and clients need Linux or macOS (no module {error.name} here); use WSL"
