"""The place where clients find the daemon: one socket, for one daemon."""

import fcntl
import os
import socket
import stat
from pathlib import Path
from typing import IO

from model.errors import InputError

_LONGEST_PATH = 107  # bytes that a Unix socket's name may have


class SocketLock:
    """A socket's path that belongs to this process until `leave`.

    The lock on a file beside it, not the socket, says that somebody is there: the system takes it
    from a process that dies, however that is. Raises InputError where a daemon runs already, or
    where no socket can be.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if len(os.fsencode(path)) > _LONGEST_PATH:
            raise InputError(
                f"{path}: a socket's path has at most {_LONGEST_PATH} bytes; name a shorter one "
                "with socket: in the daemon's file"
            )
        if os.path.lexists(path) and not path.is_socket():
            raise InputError(
                f"{path}: something else than a socket is there; move it away, or name another "
                "path with socket: in the daemon's file"
            )
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            _check_folder(path.parent)
            self._lock: IO[str] = path.with_name(f"{path.name}.lock").open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"{error.filename}: {error.strerror}; name another path with socket: in the "
                "daemon's file"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.seek(0)
            owner = self._lock.read(20).strip()
            self._lock.close()
            raise InputError(
                f"a daemon runs already at {path} (process {owner or 'unknown'}); end that one "
                "first, or give this one another socket: in its file"
            ) from None
        self._lock.truncate(0)
        self._lock.write(f"{os.getpid()}\n")
        self._lock.flush()
        if path.is_socket():
            path.unlink()  # of a daemon that was killed

    def bound(self) -> socket.socket:
        """A socket at the path that only this user may open, and a group whom its folder is for.

        Raises InputError.
        """
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        # A folder for a group and nobody else, such as systemd makes with mode 0750, is meant so.
        folder = self.path.parent.stat().st_mode
        is_shared = folder & stat.S_IXGRP and not folder & stat.S_IRWXO
        before = os.umask(0o117 if is_shared else 0o177)
        try:
            bound.bind(str(self.path))
        except OSError as error:
            bound.close()
            raise InputError(
                f"{self.path}: no socket can be here ({error.strerror}); name another path with "
                "socket: in the daemon's file"
            ) from error
        finally:
            os.umask(before)
        return bound

    def leave(self) -> None:
        """Give the place back."""
        if self.path.is_socket():
            self.path.unlink()
        self._lock.close()


def _check_folder(folder: Path) -> None:
    """Refuse a folder in which somebody else could put a socket of theirs for ours."""
    status, link = folder.stat(), folder.lstat()  # whoever owns a link can turn it elsewhere
    is_theirs = not {status.st_uid, link.st_uid} <= {0, os.getuid()}
    if is_theirs or status.st_mode & stat.S_IWOTH:
        raise InputError(
            f"{folder}: others may write here, or it is theirs; name another path with socket: in "
            "the daemon's file, in a folder of your own"
        )
