"""JSON-RPC 2.0, one object a line: bytes into requests, results and errors into bytes.

The rules it lives by: UTF-8, a line feed ends a message, at most 64 KiB with it; no batches; an id
is a short text or a whole number; a request without an id gets no answer. No NaN, no infinity.
Nothing here knows what a method means.
"""

import json
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from controller.api.schema import Message
from model.errors import in_our_words

MAX_LINE_LENGTH = 1 << 16  # bytes, with the line feed
_LONGEST_TEXT = 600  # characters of an error's message

Id: TypeAlias = int | str | None


class ErrorCode(IntEnum):
    """Codes of JSON-RPC 2.0, and from 1001 on our own."""

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
    ErrorCode.PARSE: "the line is no JSON, or longer than 64 KiB",
    ErrorCode.INVALID_REQUEST: "the JSON is no request",
    ErrorCode.UNKNOWN_METHOD: "there is no such method",
    ErrorCode.INVALID_PARAMS: "the parameters are not those of the method",
    ErrorCode.INTERNAL: "a bug in the daemon; its log has the details",
    ErrorCode.WRONG_STATE: "the daemon's state does not allow it, such as not being armed",
    ErrorCode.LEASE: "the lease is lost, or somebody else's",
    ErrorCode.REFUSED: "the guard, a limit or an amplifier refused",
    ErrorCode.LINK: "the link to an amplifier failed",
    ErrorCode.BUSY: "too many requests or connections at once",
}
"""What each error code means."""


class ErrorData(Message):
    """What went wrong, where, and what to do."""

    what: str
    where: str | None = None
    remedy: str | None = None


class RpcError(Exception):
    """A request that failed, as it is told to whoever asked.

    Raised by the server's methods, and by clients when the daemon answers so.
    """

    def __init__(
        self, code: ErrorCode, what: str, *, where: str | None = None, remedy: str | None = None
    ) -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.code = code
        self.data = ErrorData(what=what, where=where, remedy=remedy)


class _Envelope(BaseModel):
    """The members of a request."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    jsonrpc: Literal["2.0"]
    method: str = Field(max_length=40)
    params: dict[str, Any] = Field(default_factory=dict)
    id: (
        Annotated[int, Field(ge=-(2**63), lt=2**63)] | Annotated[str, Field(max_length=80)] | None
    ) = None


@dataclass(frozen=True, slots=True)
class Request:
    """One request; wants_answer is False for a notification, which gets none, not even an error."""

    method: str
    params: dict[str, Any]
    id: Id
    wants_answer: bool


def read_request(line: bytes) -> Request:
    """Read one line; raises RpcError."""
    try:
        said = from_json(line, allow_inf_nan=False)
    except ValueError as error:
        raise RpcError(
            ErrorCode.PARSE,
            f"the line is no JSON: {error!s:.200}",
            remedy="send one JSON object a line, in UTF-8",
        ) from error
    try:
        envelope = _Envelope.model_validate(said)
    except ValidationError as error:
        raise RpcError(
            ErrorCode.INVALID_REQUEST,
            f"this is no request of JSON-RPC 2.0: {_first_problem(error)}",
            remedy='send {"jsonrpc": "2.0", "id": 1, "method": ..., "params": {...}}; no batches',
        ) from error
    return Request(envelope.method, envelope.params, envelope.id, "id" in said)


def read_params(model: type[Message], request: Request) -> Message:
    """The parameters of a request by their model; raises RpcError."""
    try:
        return model.model_validate(request.params)
    except ValidationError as error:
        raise RpcError(
            ErrorCode.INVALID_PARAMS,
            f"{request.method}: {_first_problem(error)}",
            where=_where(error),
            remedy="see the method in docs/reference/api.md",
        ) from error


def result_line(id: Id, result: Message) -> bytes:
    """The answer to a request."""
    return _line(f'{{"jsonrpc":"2.0","id":{json.dumps(id)},"result":{result.model_dump_json()}}}')


def error_line(id: Id, error: RpcError) -> bytes:
    """The answer to a request that failed; id None where it could not be read."""
    said = {
        "code": int(error.code),
        "message": str(error)[:_LONGEST_TEXT],
        "data": error.data.model_dump(),
    }
    return _line(json.dumps({"jsonrpc": "2.0", "id": id, "error": said}))


def request_line(id: Id, method: str, params: Message) -> bytes:
    """A request, as a client sends it; id None for one that wants no answer."""
    identified = "" if id is None else f'"id":{json.dumps(id)},'
    return _line(
        f'{{"jsonrpc":"2.0",{identified}"method":{json.dumps(method)},'
        f'"params":{params.model_dump_json(exclude_none=True)}}}'
    )


def event_line(topic: str, *, time: float, lost: int, data: bytes) -> bytes:
    """A notification; data: a topic's data as JSON already, for it goes to many; time [s]."""
    head = f'{{"jsonrpc":"2.0","method":"event","params":{{"topic":"{topic}","time_s":{time:.6f}'
    return f'{head},"lost":{lost},"data":'.encode() + data + b"}}\n"


def _line(text: str) -> bytes:
    return text.encode() + b"\n"


def _first_problem(error: ValidationError) -> str:
    """The first thing that is wrong, and how many more there are; nothing of the input is said."""
    problems = error.errors(include_url=False, include_context=False, include_input=False)
    more = f" ({len(problems) - 1} more)" if len(problems) > 1 else ""
    where = _where(error)
    return f"{where + ': ' if where else ''}{in_our_words(problems[0]['msg'])}{more}"


def _where(error: ValidationError) -> str | None:
    """The key of the first problem, shortened and without what could garble a log."""
    location = error.errors(include_url=False, include_context=False, include_input=False)[0]["loc"]
    name = ".".join(str(part) for part in location)
    shown = name if name.isprintable() else ascii(name)
    return shown[:80] or None
