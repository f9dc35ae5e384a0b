"""Client side of the API: find the daemon's socket, and exchange lines with it.

`find_socket` chooses the socket; `check_peer` decides whether to trust the process behind it.
`DaemonLink` is a connection under a client's name that passes lines on unchanged. Functions without
I/O convert arguments to parameters (`make_params`, `touches_at`) and lines to responses and
notifications (`read_line`, `result_of`, `read_result`). Unknown keys from a daemon of a later minor
version are ignored here; the server validates every request strictly.
"""

import asyncio
import json
import math
import os
import pwd
import socket
import struct
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from pydantic import ValidationError

from controller.api.jsonrpc import ErrorCode, RpcError, read_error, request_line
from controller.api.methods import METHODS
from controller.api.schema import API_VERSION, ApiMessage, TouchPoint
from drivers.errors import LinkError
from model.errors import InputError, expect_path, shown
from registry.wording import first_problem

RESPONSE_TIMEOUT = 5.0  # s; arming takes the longest, some tenths of a second
_QUEUE_INTERVAL = 0.002  # s
_READ = 1 << 16  # bytes; read-ahead, and the rest of an incomplete line

SYSTEM_SOCKET = Path("/run/era-haptics/daemon.sock")
"""The socket of the system service."""

SOCKET_VARIABLE = "ERA_HAPTICS_SOCKET"
"""Environment variable with the socket path, for the daemon and its clients."""

SERVICE_USER_VARIABLE = "ERA_HAPTICS_USER"
_SERVICE_USER = "era-haptics"  # default of the system service
_CREDENTIALS = struct.Struct("3i")  # process, user, group

_MessageT = TypeVar("_MessageT", bound=ApiMessage)


class Unreachable(LinkError):
    """No daemon responds at the socket, or its version is incompatible."""

    @classmethod
    def at(cls, path: Path, error: OSError) -> "Unreachable":
        """Return the error for a failed connection to a socket, with its remedy."""
        if path.exists() and not path.is_socket():
            return cls(f"{path} is not a socket; give the socket that `era daemon` printed")
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return cls(
                f"no daemon runs at {path}; start one (era daemon CONFIG), or give the socket of "
                "the running one (--socket PATH)"
            )
        if isinstance(error, PermissionError):
            return cls(f"{path} belongs to another user; run as the user of the daemon")
        if isinstance(error, TimeoutError):
            return cls(f"the daemon at {path} does not respond; see its log, or restart it")
        reason = error.strerror or error
        return ConnectionLost(
            f"connection to the daemon at {path} lost ({reason}); see its log, or restart it"
        )


class ConnectionLost(Unreachable):
    """The daemon closed a connection, or has too many clients."""


class LeaseLost(RpcError):
    """The lease of `armed` ended within its block: vibration has stopped."""

    def __init__(self, cause: str) -> None:
        super().__init__(ErrorCode.LEASE, f"lease lost: {cause}", remedy="arm again")


@dataclass(frozen=True)
class Notification:
    """An event: topic, time [s], number of events dropped before it, data."""

    topic: str
    time: float
    lost: int
    data: Mapping[str, Any]


@contextmanager
def _expected() -> Iterator[None]:
    """Raise Unreachable if a line from the daemon does not have the expected form."""
    try:
        yield
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise Unreachable(
            "the daemon sent a line that this program does not understand; update the older of the "
            "two"
        ) from error


@_expected()
def read_line(line: bytes) -> Mapping[str, Any] | Notification:
    """Parse a line of the daemon as a response or event; raises Unreachable if it is neither."""
    content: dict[str, Any] = json.loads(line)
    if content.get("method") != "event":
        content["id"]  # None: the request could not be parsed
        return content
    params = content["params"]
    return Notification(params["topic"], params["time_s"], params["lost"], params["data"])


@_expected()
def result_of(response: Any) -> Any:
    """Return the result of a response, or raise its RpcError."""
    if "error" in response:
        raise read_error(response["error"])
    return response["result"]


@_expected()
def read_result(result: object, model: type[_MessageT]) -> _MessageT:
    """Validate a result, ignoring unknown keys; raises Unreachable."""
    return model.model_validate_json(json.dumps(result), extra="ignore")


@_expected()
def check_version(hello: Any, path: Path) -> None:
    """Check the daemon's major version in the result of `hello`; raises Unreachable."""
    version: str = hello["api_version"]
    if version.partition(".")[0] != API_VERSION.partition(".")[0]:
        raise Unreachable(
            f"the daemon at {path} uses API version {version:.20}, this program "
            f"{API_VERSION}; update the older of the two"
        )


def make_params(method: str, **values: object) -> ApiMessage:
    """Make the parameters of a method; raises InputError with the invalid key and value."""
    try:
        return METHODS[method].params(**values)
    except ValidationError as error:
        key, problem = first_problem(error)
        value = error.errors()[0]["input"]
        raise InputError(f"{method}: {key} {problem}, got {shown(value)}") from None


def touches_at(positions: Iterable[tuple[float, float]]) -> list[TouchPoint]:
    """Make the touch points of a frame from positions x, y [m]; raises InputError."""
    if not isinstance(positions, Iterable):
        raise InputError(
            f"touch: positions must be a list of x, y in meters, got {shown(positions)}"
        )
    points = []
    for number, position in enumerate(positions, start=1):
        x, y = as_position(position)
        points.append(TouchPoint(id=number, x_m=x, y_m=y, radius_m=None))
    return points


def as_position(position: object) -> tuple[float, float]:
    """Convert a position to x, y [m]; raises InputError."""
    got = shown(position)
    with suppress(TypeError, ValueError, OverflowError):
        x, y = map(float, cast("Iterable[float]", position))
        if math.isfinite(x) and math.isfinite(y):
            return x, y
        got = f"({x:g}, {y:g})"
    raise InputError(
        "a finger's position must be x, y in meters from the plate's south-west corner, such as "
        f"(0.10, 0.05), got {got}"
    )


def default_socket(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the default socket of this user's daemon."""
    socket_name = environment.get(SOCKET_VARIABLE)
    if socket_name:
        return Path(socket_name)
    folder_name = environment.get("XDG_RUNTIME_DIR")
    folder = Path(folder_name or f"/run/user/{os.getuid()}")
    if folder_name or folder.is_dir():
        return folder / "era-haptics" / "daemon.sock"
    return Path(tempfile.gettempdir()) / f"era-haptics-{os.getuid()}" / "daemon.sock"


def find_socket(path: Path | str | None) -> Path:
    """Find the socket: at a path, from the environment, of this user, or of the service."""
    if path is not None:
        return expect_path(path, what="path")
    user_socket = default_socket()
    if os.environ.get(SOCKET_VARIABLE) or user_socket.exists():
        return user_socket
    try:
        SYSTEM_SOCKET.stat()
    except PermissionError:
        pass  # the folder belongs to another user: connecting reports the owner
    except OSError:
        return user_socket
    return SYSTEM_SOCKET


def check_peer(
    path: Path, connected: socket.socket, *, environment: Mapping[str, str] = os.environ
) -> None:
    """Check the peer of a connected socket; raises Unreachable.

    Folder, socket and process must have the same owner: root, the caller, or the service's user
    (the variable ERA_HAPTICS_USER, by default `era-haptics`). Otherwise any user could impersonate
    the daemon in a folder that all users can write to.
    """
    service = environment.get(SERVICE_USER_VARIABLE, _SERVICE_USER)
    owners = {"folder": path.parent.stat().st_uid, "socket": path.stat().st_uid}
    credentials = credentials_of(connected)
    if credentials is not None:
        owners["process"] = credentials[1]
    trusted = {0, os.geteuid(), _user_id(service)}
    if len(set(owners.values())) == 1 and set(owners.values()) <= trusted:
        return
    owned = [f"its {part} belongs to {_user_name(uid)}" for part, uid in owners.items()]
    raise Unreachable(
        f"{path} must belong, with its folder and process, to root, to you, or to the service's "
        f"user {service}, but {', '.join(owned)}; give another socket, or name the service's user "
        f"in {SERVICE_USER_VARIABLE}"
    )


def credentials_of(connected: socket.socket) -> tuple[int, int] | None:
    """Return process and user ids of the peer of a socket; None if the system lacks them."""
    option = getattr(socket, "SO_PEERCRED", None)  # Linux only
    if option is None:
        return None
    raw = connected.getsockopt(socket.SOL_SOCKET, option, _CREDENTIALS.size)
    process, user, _ = _CREDENTIALS.unpack(raw)
    return process, user


def _user_id(name: str) -> int | None:
    """Return the id of a user; None if there is no such user."""
    try:
        return pwd.getpwnam(name).pw_uid
    except KeyError:
        return None


def _user_name(uid: int) -> str:
    """Return the name of a user, or the id without one."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"


class DaemonLink:
    """A connection to the daemon under a client's name, made by `open`.

    hello: the daemon's reply to `hello`, without its line feed; the name is its id.
    """

    def __init__(
        self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.hello = b""
        self._path = path
        self._reader = reader
        self._writer = writer
        self._received = b""

    @classmethod
    async def open(cls, path: Path, name: str) -> Self:
        """Connect, check the peer, and introduce a client under its name.

        Raises InputError for the name, RpcError and Unreachable.
        """
        params = make_params("hello", client=name).model_dump_json()
        connecting = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connecting.setblocking(False)
        link: Self | None = None
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):  # the daemon's queue may be full
                while True:  # asyncio would mistake a full queue for a connection in progress
                    try:
                        connecting.connect(str(path))
                        break
                    except BlockingIOError:
                        await asyncio.sleep(_QUEUE_INTERVAL)
                check_peer(path, connecting)
                link = cls(path, *await asyncio.open_unix_connection(sock=connecting))
                link.write(request_line(name, "hello", params.encode()))
                link.hello = await link.next_line()
            check_version(result_of(read_line(link.hello)), path)
        except BaseException as error:
            connecting.close() if link is None else link.abort()
            if isinstance(error, OSError) and not isinstance(error, Unreachable):
                raise Unreachable.at(path, error) from error
            raise
        return link

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it."""
        return not (self._writer.is_closing() or self._reader.at_eof() or self._reader.exception())

    def closed_by_daemon(self) -> Unreachable:
        """Return the error of requests after the daemon has closed the connection."""
        return Unreachable.at(self._path, ConnectionResetError("closed by the daemon"))

    async def send(self, line: bytes) -> None:
        """Send a line with its line feed once the daemon reads; raises Unreachable."""
        self.write(line)
        try:
            await self._writer.drain()
        except OSError as error:
            raise Unreachable.at(self._path, error) from error

    def write(self, line: bytes) -> None:
        """Send a line with its line feed without waiting; `close` still delivers it."""
        self._writer.write(line)

    async def next_line(self) -> bytes:
        """Wait for a line and return it without its line feed; raises Unreachable."""
        while b"\n" not in self._received:
            try:
                data = await self._reader.read(_READ)
            except OSError as error:
                raise Unreachable.at(self._path, error) from error
            if not data:
                raise self.closed_by_daemon()
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        return line

    def close(self) -> None:
        """Close once the daemon has carried out all requests, or after a timeout.

        To the daemon, the client has left: its fingers are lifted, its pending arm is cancelled.
        """
        self._writer.write_eof()
        asyncio.get_running_loop().call_later(RESPONSE_TIMEOUT, self.abort)

    def abort(self) -> None:
        """Close immediately; the daemon lifts this client's fingers."""
        self._writer.transport.abort()
