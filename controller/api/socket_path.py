"""Where the daemon's socket is by default."""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from model.arguments import expect_path

SYSTEM_SOCKET = Path("/run/era-haptics/daemon.sock")
"""The socket of the system service."""

SOCKET_VARIABLE = "ERA_HAPTICS_SOCKET"
"""The environment variable that names the socket of a daemon and of its clients."""


def default_socket(environment: Mapping[str, str] = os.environ) -> Path:
    """The socket of this user's daemon, unless its file or an option names another."""
    named = environment.get(SOCKET_VARIABLE)
    if named:
        return Path(named)
    runtime = environment.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "era-haptics" / "daemon.sock"
    folder = Path(f"/run/user/{os.getuid()}")
    if folder.is_dir():
        return folder / "era-haptics" / "daemon.sock"
    return Path(tempfile.gettempdir()) / f"era-haptics-{os.getuid()}" / "daemon.sock"


def find_socket(given: Path | str | None) -> Path:
    """The socket to connect to: the given one, the environment's, this user's, or the service's."""
    if given is not None:
        return expect_path(given, what="path")
    own = default_socket()
    is_named = bool(os.environ.get(SOCKET_VARIABLE))
    return own if is_named or own.exists() or not _exists(SYSTEM_SOCKET) else SYSTEM_SOCKET


def _exists(path: Path) -> bool:
    """Whether a path exists, also in a folder that only other users may read."""
    try:
        path.stat()
    except PermissionError:
        return True  # connecting reports whose it is
    except OSError:
        return False
    return True
