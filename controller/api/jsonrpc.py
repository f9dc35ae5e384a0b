"""JSON-RPC 2.0, one object per line: bytes to requests, results and errors to bytes.

UTF-8; a line feed ends a message; a request line has at most 64 KiB; no batches; an id is a short
text or an integer; a request without an id gets no response. NaN and infinity are refused.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from controller.api.schema import Message
from model.errors import in_our_words

MAX_LINE_LENGTH = 1 << 16  # bytes, with the line feed
_MAX_ERROR_TEXT = 600  # characters of an error's message

Id: TypeAlias = int | str | None
_MessageT = TypeVar("_MessageT", bound=Message)


class ErrorCode(IntEnum):
    """Codes of JSON-RPC 2.0, and our own from 1001 on."""

    PARSE = -32700
    INVALID_REQUEST = -32600
    UNKNOWN_METHOD = -32601
    INVALID_PARAMS = -32602
    INTERNAL = -32603
    WRONG_STATE = 1001
    LEASE = 1002
    REFUSED = 1003
    LINK = 1004
    BUSY = 1005


ERROR_MEANINGS = {
    ErrorCode.PARSE: "the line is not valid JSON, or longer than 64 KiB",
    ErrorCode.INVALID_REQUEST: "the JSON is not a JSON-RPC 2.0 request",
    ErrorCode.UNKNOWN_METHOD: "the method does not exist",
    ErrorCode.INVALID_PARAMS: "a parameter is missing, unknown or out of range",
    ErrorCode.INTERNAL: "a bug in the daemon; its log has the details",
    ErrorCode.WRONG_STATE: "the daemon's state does not allow it, such as not being armed",
    ErrorCode.LEASE: "the lease has expired, or belongs to another client",
    ErrorCode.REFUSED: "the guard, a limit or an amplifier refused",
    ErrorCode.LINK: "the link to an amplifier failed",
    ErrorCode.BUSY: "too many requests or connections at once",
}
"""Meaning of each error code."""


class ErrorData(Message):
    """What is wrong, where, and the remedy."""

    what: str
    where: str | None = None
    remedy: str | None = None


class RpcError(Exception):
    """A request that failed.

    Raised by the server's methods, and by clients when the daemon responds with an error.
    """

    def __init__(
        self, code: ErrorCode, what: str, *, where: str | None = None, remedy: str | None = None
    ) -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.code = code
        self.data = ErrorData(what=what, where=where, remedy=remedy)


class _Envelope(BaseModel):
    """Members of a request."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    jsonrpc: Literal["2.0"]
    method: str = Field(max_length=40)
    params: dict[str, Any] = Field(default_factory=dict)
    id: (
        Annotated[int, Field(ge=-(2**63), lt=2**63)] | Annotated[str, Field(max_length=80)] | None
    ) = None


@dataclass(frozen=True, slots=True)
class Request:
    """One request; without `expects_response` it gets none, not even an error."""

    method: str
    params: dict[str, Any]
    id: Id
    expects_response: bool


def read_request(line: bytes) -> Request:
    """Read one line; raises RpcError."""
    try:
        document = from_json(line, allow_inf_nan=False)
    except ValueError as error:
        raise RpcError(
            ErrorCode.PARSE,
            f"the line is not valid JSON: {error!s:.200}",
            remedy="send one JSON object per line, in UTF-8",
        ) from error
    try:
        envelope = _Envelope.model_validate(document)
    except ValidationError as error:
        raise RpcError(
            ErrorCode.INVALID_REQUEST,
            f"not a JSON-RPC 2.0 request: {_first_problem(error)}",
            remedy='send {"jsonrpc": "2.0", "id": 1, "method": ..., "params": {...}}; no batches',
        ) from error
    return Request(envelope.method, envelope.params, envelope.id, "id" in document)


def read_params(model: type[_MessageT], request: Request) -> _MessageT:
    """Validate the parameters of a request; raises RpcError."""
    try:
        return model.model_validate(request.params)
    except ValidationError as error:
        raise RpcError(
            ErrorCode.INVALID_PARAMS,
            f"{request.method}: {_first_problem(error)}",
            where=_key(error),
            remedy="see the method in docs/reference/api.md",
        ) from error


def unknown_method(method: str, known: Iterable[str]) -> RpcError:
    """The error for a method that does not exist."""
    return RpcError(
        ErrorCode.UNKNOWN_METHOD,
        f"unknown method {method[:40]!a}",
        remedy=f"use one of {', '.join(known)}",
    )


def result_line(id: Id, result: str) -> bytes:
    """The response to a request; result: as JSON."""
    return f'{{"jsonrpc":"2.0","id":{json.dumps(id)},"result":{result}}}\n'.encode()


def error_line(id: Id, error: RpcError) -> bytes:
    """The response to a request that failed; id None if it could not be read."""
    content = {
        "code": int(error.code),
        "message": str(error)[:_MAX_ERROR_TEXT],
        "data": error.data.model_dump(),
    }
    return json.dumps({"jsonrpc": "2.0", "id": id, "error": content}).encode() + b"\n"


def request_line(id: Id, method: str, params: Message) -> bytes:
    """A request as clients send it; id None for one that expects no response."""
    member = "" if id is None else f'"id":{json.dumps(id)},'
    return (
        f'{{"jsonrpc":"2.0",{member}"method":{json.dumps(method)},'
        f'"params":{params.model_dump_json(exclude_none=True)}}}\n'
    ).encode()


def event_line(topic: str, *, time: float, lost: int, data: bytes) -> bytes:
    """An `event` notification; data: as JSON, serialised once for all subscribers; time [s]."""
    head = f'{{"jsonrpc":"2.0","method":"event","params":{{"topic":"{topic}","time_s":{time:.6f}'
    return f'{head},"lost":{lost},"data":'.encode() + data + b"}}\n"


def _first_problem(error: ValidationError) -> str:
    """Describe the first problem and count the others, without quoting the input."""
    problems = error.errors(include_url=False, include_context=False, include_input=False)
    more = f" ({len(problems) - 1} more)" if len(problems) > 1 else ""
    key = _key(error)
    return f"{key + ': ' if key else ''}{in_our_words(problems[0]['msg'])}{more}"


def _key(error: ValidationError) -> str | None:
    """The key of the first problem, shortened and free of control characters."""
    location = error.errors(include_url=False, include_context=False, include_input=False)[0]["loc"]
    name = ".".join(str(part) for part in location)
    printable = name if name.isprintable() else ascii(name)
    return printable[:80] or None
