"""Where the daemon's socket is by default, and whether the process behind it is to be believed."""

import os
import pwd
import socket
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path

from controller.api.client_protocol import Unreachable
from model.errors import expect_path

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


SERVICE_USER_VARIABLE = "ERA_HAPTICS_USER"
_SERVICE_USER = "era-haptics"  # as the system service is installed
_CREDENTIALS = struct.Struct("3i")  # process, user, group


def check_peer(
    path: Path, connected: socket.socket, *, environment: Mapping[str, str] = os.environ
) -> None:
    """Check the peer of a connected socket; raises Unreachable.

    Folder, socket and process must have one owner: root, the caller, or the user of the service,
    `era-haptics` unless the variable ERA_HAPTICS_USER names another. Otherwise any user could pose
    as the daemon in a folder that all may write to.
    """
    service = environment.get(SERVICE_USER_VARIABLE, _SERVICE_USER)
    owners = {"folder": path.parent.stat().st_uid, "socket": path.stat().st_uid}
    credentials = credentials_of(connected)
    if credentials is not None:
        owners["process"] = credentials[1]
    trusted = {0, os.geteuid(), _uid(service)}
    if len(set(owners.values())) == 1 and set(owners.values()) <= trusted:
        return
    found = ", ".join(f"its {what} belongs to {_name(uid)}" for what, uid in owners.items())
    raise Unreachable(
        f"{path} must belong, with its folder and process, to root, to you, or to the service's "
        f"user {service}, but {found}; give another socket, or name the service's user in "
        f"{SERVICE_USER_VARIABLE}"
    )


def credentials_of(connected: socket.socket) -> tuple[int, int] | None:
    """Process and user ids of the peer of a socket; None where the system does not give them."""
    option = getattr(socket, "SO_PEERCRED", None)  # of Linux
    if option is None:
        return None
    raw = connected.getsockopt(socket.SOL_SOCKET, option, _CREDENTIALS.size)
    process, user, _ = _CREDENTIALS.unpack(raw)
    return process, user


def _uid(user: str) -> int | None:
    """The id of a user by name, or None."""
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        return None


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"
