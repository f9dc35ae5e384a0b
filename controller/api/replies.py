"""What both clients make of the daemon's lines."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.parts import Message, TouchPoint
from drivers.errors import LinkError

_ResultT = TypeVar("_ResultT", bound=Message)


class Unreachable(LinkError):
    """Nobody answers at the daemon's socket, or not any more."""

    @classmethod
    def at(cls, path: Path, error: OSError) -> "Unreachable":
        """With what to do about it."""
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return cls(f"no daemon runs at {path}; start one with  era daemon CONFIG")
        if isinstance(error, PermissionError):
            return cls(f"{path} belongs to somebody else; ask whoever runs the daemon")
        if isinstance(error, TimeoutError):
            return cls(f"the daemon at {path} does not answer; see its log, or start it anew")
        return cls(f"the daemon at {path} is gone ({error}); see its log, or start it anew")


@dataclass(frozen=True)
class Notification:
    """What the daemon tells of a topic: when [s], how many were lost before it, and its data."""

    topic: str
    time: float
    lost: int
    data: Mapping[str, Any]


def notification_of(said: Mapping[str, Any]) -> Notification | None:
    """The notification that a line is; None for an answer."""
    if said.get("method") != "event":
        return None
    params = said["params"]
    return Notification(params["topic"], params["time_s"], params["lost"], params["data"])


def error_of(said: Mapping[str, Any]) -> RpcError:
    """The error that a line tells."""
    error = said["error"]
    data = error.get("data") or {}
    return RpcError(
        ErrorCode(error["code"]),
        data.get("what", error["message"]),
        where=data.get("where"),
        remedy=data.get("remedy"),
    )


def result_of(said: Mapping[str, Any], model: type[_ResultT]) -> _ResultT:
    """The result that a line tells; keys of a later minor version are ignored."""
    try:
        return model.model_validate_json(json.dumps(said["result"]), extra="ignore")
    except (KeyError, ValidationError) as error:
        raise Unreachable(
            "the daemon answered something that this program does not understand; update the older "
            "of the two"
        ) from error


def touch_points(places: Sequence[tuple[float, float]]) -> list[TouchPoint]:
    """Fingers 1, 2, ... at x, y [m]."""
    return [TouchPoint(id=id, x_m=x, y_m=y) for id, (x, y) in enumerate(places, start=1)]
