"""The client's side of the API without I/O: arguments to parameters, lines to responses and events.

A daemon of a later minor version sends keys that this program does not know: they are ignored here,
whereas the server is strict about every request.
"""

import json
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from controller.api.jsonrpc import ErrorCode, RpcError, read_error
from controller.api.registered import METHODS
from controller.api.schema import API_VERSION, Message, TouchPoint
from drivers.errors import LinkError
from model.errors import InputError, shown
from registry.wording import first_problem

RESPONSE_TIMEOUT = 5.0  # s; arming takes longest, some tenths of a second

_MessageT = TypeVar("_MessageT", bound=Message)


class Unreachable(LinkError):
    """No daemon answers at the socket, or one of an incompatible version."""

    @classmethod
    def at(cls, path: Path, error: OSError) -> "Unreachable":
        """The failure to talk to a daemon at a socket, with its remedy."""
        if path.exists() and not path.is_socket():
            return cls(f"{path} is not a socket; give the one that `era daemon` printed")
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
    """The daemon closed a connection, or has too many clients at once."""


class LeaseLost(RpcError):
    """The lease of `armed` ended within its block: vibration has stopped."""

    def __init__(self, what: str) -> None:
        super().__init__(ErrorCode.LEASE, f"lease lost: {what}", remedy="arm again")


@dataclass(frozen=True)
class Notification:
    """An event: topic, time [s], number of events dropped before it, data."""

    topic: str
    time: float
    lost: int
    data: Mapping[str, Any]


def read_line(line: bytes) -> Mapping[str, Any] | Notification:
    """Read a line of a daemon, a response or an event; raises Unreachable for what is neither."""
    try:
        content: dict[str, Any] = json.loads(line)
        if content.get("method") != "event":
            content["id"]  # None: of a request that could not be read
            return content
        params = content["params"]
        return Notification(params["topic"], params["time_s"], params["lost"], params["data"])
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise _not_understood() from error


def result_of(response: Any) -> Any:
    """The result of a response; raises the RpcError that it holds instead."""
    try:
        if "error" not in response:
            return response["result"]
        error = read_error(response["error"])
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise _not_understood() from problem
    raise error


def make_params(method: str, **values: object) -> Message:
    """The parameters of a method; raises InputError with the key and the value that is wrong."""
    try:
        return METHODS[method].params(**values)
    except ValidationError as error:
        key, problem = first_problem(error)
        value = error.errors()[0]["input"]
        raise InputError(f"{method}: {key} {problem}, got {shown(value)}") from None


def touches_at(positions: Iterable[tuple[float, float]]) -> list[TouchPoint]:
    """Fingers at x, y [m] of a touch frame; raises InputError."""
    if not isinstance(positions, Iterable):
        raise InputError(
            f"touch: positions must be a list of x, y in metres, got {shown(positions)}"
        )
    points = [as_position(position) for position in positions]
    return [TouchPoint(id=id, x_m=x, y_m=y) for id, (x, y) in enumerate(points, start=1)]


def as_position(position: object) -> tuple[float, float]:
    """A finger's x, y [m]; raises InputError."""
    got = shown(position)
    with suppress(TypeError, ValueError, OverflowError):
        x, y = (float(each) for each in cast("Iterable[float]", position))
        if math.isfinite(x) and math.isfinite(y):
            return x, y
        got = f"({x:g}, {y:g})"
    raise InputError(
        "a finger's position must be x, y in metres from the plate's south-west corner, such as "
        f"(0.10, 0.05), got {got}"
    )


def read_result(result: object, model: type[_MessageT]) -> _MessageT:
    """Validate a result, ignoring unknown keys; raises Unreachable."""
    try:
        return model.model_validate_json(json.dumps(result), extra="ignore")
    except ValidationError as error:
        raise _not_understood() from error


def check_version(hello: object, path: Path) -> None:
    """Check the daemon's major version in the result of `hello`; raises Unreachable."""
    version = hello.get("api_version") if isinstance(hello, dict) else None
    if not isinstance(version, str):
        raise _not_understood()
    if version.partition(".")[0] != API_VERSION.partition(".")[0]:
        raise Unreachable(
            f"the daemon at {path} speaks version {version:.20} of the API, this program "
            f"{API_VERSION}; update the older of the two"
        )


def _not_understood() -> Unreachable:
    return Unreachable(
        "the daemon sent a line that this program does not understand; update the older of the two"
    )
