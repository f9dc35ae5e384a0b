"""JSON-RPC 2.0, one object per line: bytes to requests, results and errors to bytes.

UTF-8; a line feed ends a message; no batches, no repeated keys; an id is a short text or an
integer; a request without an id gets no response. NaN and infinity are refused. Length, depth and
number of keys are bounded before anything is parsed.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from controller.api.schema import AmplifierSilence, ApiMessage
from registry.wording import reworded

MAX_LINE_LENGTH = 1 << 16  # bytes, with the line feed
MAX_OPENINGS = 510  # [ and { of a request: 500 points have 503; bounds the depth too
MAX_SEPARATORS = 2100  # : and , of a request: 500 points have up to 2015
_MAX_ERROR_TEXT = 600  # characters of an error's message

Id: TypeAlias = int | str | None
_MessageT = TypeVar("_MessageT", bound=ApiMessage)
_ModelT = TypeVar("_ModelT", bound=BaseModel)


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
    NOT_SILENT = 1006


ERROR_MEANINGS = {
    ErrorCode.PARSE: "the line is not valid JSON, too long, or has too many keys",
    ErrorCode.INVALID_REQUEST: "the JSON is not a JSON-RPC 2.0 request",
    ErrorCode.UNKNOWN_METHOD: "the method does not exist",
    ErrorCode.INVALID_PARAMS: "a parameter is missing, unknown or out of range",
    ErrorCode.INTERNAL: "a bug in the daemon; its log has the details",
    ErrorCode.WRONG_STATE: "the daemon's state does not allow it, such as not being armed",
    ErrorCode.LEASE: "the lease has expired, or belongs to another client",
    ErrorCode.REFUSED: "a limit or an amplifier refused",
    ErrorCode.LINK: "the link to an amplifier failed",
    ErrorCode.BUSY: "too many requests or connections",
    ErrorCode.NOT_SILENT: "after a stop, an amplifier is not confirmed silent",
}
"""Meaning of each error code."""


class ErrorData(ApiMessage):
    """Place and remedy of an error; after a stop, the silence of every amplifier."""

    what: str
    where: str | None = None
    remedy: str | None = None
    amplifiers: dict[str, AmplifierSilence] | None = Field(
        default=None, description="by name; of error 1006 only"
    )


class RpcError(Exception):
    """A request that failed.

    Raised by the server's methods, and by clients when the daemon responds with an error.
    """

    def __init__(
        self,
        code: ErrorCode,
        what: str,
        *,
        where: str | None = None,
        remedy: str | None = None,
        amplifiers: dict[str, AmplifierSilence] | None = None,
    ) -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.code = code
        self.data = ErrorData(what=what, where=where, remedy=remedy, amplifiers=amplifiers)


class NotSilent(RpcError):
    """A stop after which an amplifier is not confirmed silent; amplifiers: all, by name."""

    def __init__(self, amplifiers: Mapping[str, AmplifierSilence]) -> None:
        unconfirmed = {
            name: each for name, each in amplifiers.items() if each.silence != "confirmed_silent"
        }
        what = "not confirmed silent: " + ", ".join(
            f"{name} ({each.words}: {each.cause})" for name, each in unconfirmed.items()
        )
        self.amplifiers = dict(amplifiers)
        super().__init__(
            ErrorCode.NOT_SILENT,
            what,
            remedy="switch these amplifiers off",
            amplifiers=self.amplifiers,
        )


class InvalidRequest(RpcError):
    """A line that is not a request; id: of its response, None if it cannot be read."""

    def __init__(self, code: ErrorCode, what: str, *, remedy: str, id: Id = None) -> None:
        super().__init__(code, what, remedy=remedy)
        self.id = id


_RequestId: TypeAlias = (
    Annotated[int, Field(ge=-(2**63), lt=2**63)] | Annotated[str, Field(max_length=80)] | None
)
_REQUEST_ID: TypeAdapter[Id] = TypeAdapter(_RequestId, config=ConfigDict(strict=True))


class Request(BaseModel):
    """One request; without `expects_response` it gets none, not even an error."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    jsonrpc: Literal["2.0"]
    method: str = Field(max_length=40)
    params: dict[str, Any] = Field(default_factory=dict)
    id: _RequestId = None

    @property
    def expects_response(self) -> bool:
        """Whether it has an id; null is one."""
        return "id" in self.model_fields_set


def read_request(line: bytes) -> Request:
    """Read one line; raises InvalidRequest."""
    return request_of(parse_json(line))


def request_of(document: Any) -> Request:
    """Validate the document of a line; raises InvalidRequest."""
    return _validated(
        Request,
        document,
        lambda _, problem: InvalidRequest(
            ErrorCode.INVALID_REQUEST,
            f"not a JSON-RPC 2.0 request: {problem}",
            remedy='send {"jsonrpc": "2.0", "id": 1, "method": ..., "params": {...}}; no batches',
            id=_readable_id(document),
        ),
    )


def read_params(model: type[_MessageT], request: Request) -> _MessageT:
    """Validate the parameters of a request; raises RpcError."""
    return _validated(
        model,
        request.params,
        lambda key, problem: RpcError(
            ErrorCode.INVALID_PARAMS,
            f"{request.method}: {problem}",
            where=key,
            remedy="see the method in docs/reference/api.md",
        ),
    )


def _validated(
    model: type[_ModelT], content: Any, refusal: Callable[[str | None, str], RpcError]
) -> _ModelT:
    """Validate a message, or raise its refusal by key and description of the first problem.

    Of many unknown keys the first alone is described, in bounded time; no input is quoted.
    """
    keys = content if isinstance(content, dict) else ()
    unknown = [key for key in keys if key not in model.model_fields][:1]
    try:
        return model.model_validate(dict.fromkeys(unknown) if unknown else content)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        problem = next((each for each in problems if each["loc"] == (*unknown,)), problems[0])
        name = _printable(".".join(str(part) for part in problem["loc"]))
        text = reworded(problem["msg"])
        raise refusal(name or None, f"{name}: {text}" if name else text) from error


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
        "data": error.data.model_dump(exclude=None if error.data.amplifiers else {"amplifiers"}),
    }
    return json.dumps({"jsonrpc": "2.0", "id": id, "error": content}).encode() + b"\n"


def read_error(error: Mapping[str, Any]) -> RpcError:
    """The error of a response; raises KeyError, TypeError or ValueError for anything else."""
    data = error.get("data") or {}
    code = ErrorCode(error["code"])
    if code is ErrorCode.NOT_SILENT:
        return NotSilent(
            {
                name: AmplifierSilence.model_validate(each, extra="ignore")
                for name, each in data["amplifiers"].items()
            }
        )
    what = data.get("what", error["message"])
    return RpcError(code, what, where=data.get("where"), remedy=data.get("remedy"))


def request_line(id: Id, method: str, params: bytes) -> bytes:
    """A request as clients send it; params: as JSON."""
    # Before the parameters, which may be unread: a key that they repeat is refused.
    head = {"jsonrpc": "2.0", "id": id, "method": method}
    return json.dumps(head)[:-1].encode() + b',"params":' + params + b"}\n"


def event_line(topic: str, *, time: float, lost: int, data: bytes) -> bytes:
    """An `event` notification; data: as JSON, serialised once for all subscribers; time [s]."""
    head = f'{{"jsonrpc":"2.0","method":"event","params":{{"topic":"{topic}","time_s":{time:.6f}'
    return f'{head},"lost":{lost},"data":'.encode() + data + b"}}\n"


def parse_json(line: bytes) -> Any:
    """Parse bounded JSON without repeated keys, NaN and infinity; raises InvalidRequest."""
    problems: list[str] = []

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            counts = Counter(key for key, _ in pairs)
            problems.append(f"key {_printable(counts.most_common(1)[0][0])} is repeated")
        return content

    def refuse_constant(name: str) -> None:
        problems.append(f"{name} is not JSON")

    if (
        len(line) > MAX_LINE_LENGTH
        or line.count(b",") > MAX_SEPARATORS  # counted alone, as it mostly suffices
        or sum(map(line.count, b":,")) > MAX_SEPARATORS
        or sum(map(line.count, b"{[")) > MAX_OPENINGS
    ):
        raise InvalidRequest(
            ErrorCode.PARSE, "too many keys or values", remedy="send fewer touches per frame"
        )
    try:
        document = json.loads(
            line.decode(), object_pairs_hook=unique, parse_constant=refuse_constant
        )
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(
            ErrorCode.PARSE,
            f"not valid JSON: {error!s:.200}",
            remedy="send one JSON object per line, in UTF-8",
        ) from error
    if problems:
        raise InvalidRequest(
            ErrorCode.PARSE,
            problems[0],
            remedy="give every key once, and finite numbers",
            id=_readable_id(document),
        )
    return document


def _readable_id(document: object) -> Id:
    """The id of a document that is not a request, if it has one."""
    try:
        return _REQUEST_ID.validate_python(document["id"] if isinstance(document, dict) else None)
    except (KeyError, ValidationError):
        return None


def _printable(name: str) -> str:
    """A key, shortened and free of control characters."""
    return (name if name.isprintable() else ascii(name))[:80]
