"""The daemon's Unix socket, its descriptors and its lock."""

import contextlib
import os
import socket
import stat
from pathlib import Path
from typing import IO

from model.errors import InputError
from registry import files

_STAGED = "~"  # appended to the socket's name until it listens
_MAX_PATH = 107 - len(_STAGED)  # bytes in sockaddr_un
_REMEDY = "set another socket: in the daemon's file"

MIN_DESCRIPTORS = 64
_MAX_DESCRIPTORS = 65_536


def check_socket_path(path: Path) -> None:
    """Raise InputError for an invalid socket path."""
    length = len(os.fsencode(path))
    if length > _MAX_PATH:
        raise InputError(
            f"{path}: socket path must have at most {_MAX_PATH} bytes, got {length}; {_REMEDY}"
        )
    if os.path.lexists(path) and not path.is_socket():
        raise InputError(f"{path}: is not a socket; move it away or {_REMEDY}")


class SocketLock:
    """Reserves a socket path for this process until `release`.

    The lock is held on a file next to the socket, so that the kernel releases it when the process
    exits, however it exits. Raises InputError if a daemon is running already or no socket can be
    created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        check_socket_path(path)
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            # In a folder of another user, the socket could be replaced, or a link to it redirected.
            folder = path.parent.stat()
            owners = {folder.st_uid, path.parent.lstat().st_uid}
            is_foreign = not owners <= {0, os.getuid()}
            if is_foreign or folder.st_mode & stat.S_IWOTH:
                raise InputError(f"{path.parent}: other users can write to this folder; {_REMEDY}")
            self._lock = _open_lock(path.with_name(f"{path.name}.lock"))
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror}; {_REMEDY}") from error
        try:
            files.lock(self._lock)
        except BlockingIOError:
            self._lock.seek(0)
            owner = self._lock.read(20).strip()
            self._lock.close()
            raise InputError(
                f"{path}: a daemon is running already (process {owner or 'unknown'}); stop it, or "
                f"{_REMEDY}"
            ) from None
        except OSError as error:
            self._lock.close()
            raise InputError(
                f"{path}: its file system does not lock files ({error.strerror}); {_REMEDY}"
            ) from error
        try:
            self._lock.truncate(0)
            os.write(self._lock.fileno(), f"{os.getpid()}\n".encode())
        except OSError as error:
            self._lock.close()
            raise InputError(f"{path}.lock: not written: {error.strerror}; {_REMEDY}") from error
        _remove(path)  # left behind by a killed daemon

    def bind(self) -> socket.socket:
        """Bind a socket with mode 0600, or 0660 in a folder that is accessible to a group only.

        It listens under another name first: a client that sees the file is never refused. Raises
        InputError.
        """
        staged = self.path.with_name(self.path.name + _STAGED)
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # systemd's RuntimeDirectoryMode=0750 shares the folder with the service's group.
        folder = self.path.parent.stat().st_mode
        is_shared = folder & stat.S_IXGRP and not folder & stat.S_IRWXO
        umask = os.umask(0o117 if is_shared else 0o177)
        try:
            _remove(staged)  # left behind by a killed daemon
            bound.bind(str(staged))
            bound.listen()
            staged.rename(self.path)
        except OSError as error:
            bound.close()
            _remove(staged)
            raise InputError(f"{staged}: bind failed: {error.strerror}; {_REMEDY}") from error
        finally:
            os.umask(umask)
        return bound

    def release(self) -> None:
        """Remove the socket and release the lock."""
        _remove(self.path)
        self._lock.close()


def _remove(path: Path) -> None:
    """Remove a socket's file if there is one."""
    if path.is_socket():
        path.unlink()


def _open_lock(file: Path) -> IO[str]:
    """Open a lock that no other user can take; raises OSError, InputError."""
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    descriptor = os.open(file, flags, 0o600)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
        os.close(descriptor)
        raise InputError(f"{file}: must be a file of this user; remove it or {_REMEDY}")
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "a+", encoding="utf-8")


def allow_many_descriptors() -> int:
    """Raise the limit, so that idle connections do not use it up; return it."""
    import resource  # of POSIX alone; a configuration is checked elsewhere, too

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = _MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else hard
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        return limit
    return soft
