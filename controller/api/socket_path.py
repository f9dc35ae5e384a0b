"""Where daemon and clients meet unless they are told otherwise."""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

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


def find_socket(given: Path | None) -> Path:
    """The socket to connect to: the given one, this user's, or else that of the system service."""
    if given is not None:
        return given
    own = default_socket()
    return SYSTEM_SOCKET if SYSTEM_SOCKET.exists() and not own.exists() else own
