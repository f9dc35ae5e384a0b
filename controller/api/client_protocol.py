"""What clients make of the daemon's lines.

A daemon of a later minor version says more than this program knows of: that is ignored here, while
the server itself is strict about everything that it is asked.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from pydantic import ValidationError

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.schema import API_VERSION, Message
from drivers.errors import LinkError

_MessageT = TypeVar("_MessageT", bound=Message)


class Unreachable(LinkError):
    """Nobody answers at the daemon's socket, or not any more, or nobody who can be understood."""

    @classmethod
    def at(cls, path: Path, error: OSError) -> "Unreachable":
        """With what to do about it."""
        if path.exists() and not path.is_socket():
            return cls(f"{path} is no socket; give the one that `era daemon` says it serves at")
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return cls(
                f"no daemon runs at {path}; start one (era daemon CONFIG), or give the socket of "
                "the one that runs (--socket PATH)"
            )
        if isinstance(error, PermissionError):
            return cls(f"{path} belongs to somebody else; ask whoever runs the daemon")
        if isinstance(error, TimeoutError):
            return cls(f"the daemon at {path} does not answer; see its log, or start it anew")
        why = error.strerror or error
        return cls(f"the daemon at {path} is gone ({why}); see its log, or start it anew")


@dataclass(frozen=True)
class Notification:
    """What the daemon tells of a topic: when [s], how many were lost before it, and its data."""

    topic: str
    time: float
    lost: int
    data: Mapping[str, Any]


@dataclass(frozen=True)
class Response:
    """What the daemon says to the request of a number; of None: to whatever it was."""

    number: int | None
    said: Mapping[str, Any]


Reply: TypeAlias = Response | Notification


class Greeting(Message):
    """Of what `hello` answers the one thing that every version has."""

    api_version: str


def reply_of(line: bytes) -> Reply:
    """What a line is; raises Unreachable for one that a daemon would not say."""
    try:
        said = json.loads(line)
        if said.get("method") != "event":
            return Response(said["id"], said)
        params = said["params"]
        return Notification(params["topic"], params["time_s"], params["lost"], params["data"])
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise _foreign() from error


def result_of(said: Mapping[str, Any], model: type[_MessageT]) -> _MessageT:
    """The result that an answer tells; raises the RpcError that it tells instead."""
    try:
        if "error" in said:
            raise _error_of(said["error"])
        return model.model_validate_json(json.dumps(said["result"]), extra="ignore")
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        raise _foreign() from error


def check_version(greeting: Greeting, at: Path) -> None:
    """Raise Unreachable for a daemon at a socket that speaks another major version."""
    theirs = greeting.api_version
    if theirs.partition(".")[0] != API_VERSION.partition(".")[0]:
        raise Unreachable(
            f"the daemon at {at} speaks version {theirs:.20} of the API, this program "
            f"{API_VERSION}; update the older of the two"
        )


def _error_of(error: Mapping[str, Any]) -> RpcError:
    data = error.get("data") or {}
    return RpcError(
        ErrorCode(error["code"]),
        data.get("what", error["message"]),
        where=data.get("where"),
        remedy=data.get("remedy"),
    )


def _foreign() -> Unreachable:
    return Unreachable(
        "the daemon answered something that this program does not understand; update the older of "
        "the two"
    )
