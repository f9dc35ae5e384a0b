"""Where daemon and clients meet unless they are told otherwise."""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from model.arguments import expect_path

SYSTEM_SOCKET = Path("/run/era-haptics/daemon.sock")
"""Where it is as a system service."""


def default_socket(environment: Mapping[str, str] = os.environ) -> Path:
    """The socket of this user's daemon."""
    runtime = environment.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "era-haptics" / "daemon.sock"
    folder = Path(f"/run/user/{os.getuid()}")
    if folder.is_dir():
        return folder / "era-haptics" / "daemon.sock"
    return Path(tempfile.gettempdir()) / f"era-haptics-{os.getuid()}" / "daemon.sock"


def find_socket(given: Path | str | None) -> Path:
    """The socket to connect to: the given one, this user's, or else that of the system service."""
    if given is not None:
        return expect_path(given, what="path")
    own = default_socket()
    return own if own.exists() or not _is_there(SYSTEM_SOCKET) else SYSTEM_SOCKET


def _is_there(path: Path) -> bool:
    """Whether there is a socket; also in a folder of others: connecting tells that it is theirs."""
    try:
        path.stat()
    except PermissionError:
        return True
    except OSError:
        return False
    return True
