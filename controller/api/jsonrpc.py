"""JSON-RPC 2.0, one object per line: bytes to requests, results and errors to bytes.

UTF-8; a line feed ends a message; no batches, no repeated keys; an id is a short text or an
integer; a request without an id gets no response. NaN and infinity are refused. Length, depth and
number of keys are bounded before anything is parsed.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
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
    ErrorCode.PARSE: "the line is not valid JSON, is too long, or has too many keys",
    ErrorCode.INVALID_REQUEST: "the JSON is not a JSON-RPC 2.0 request",
    ErrorCode.UNKNOWN_METHOD: "the method does not exist",
    ErrorCode.INVALID_PARAMS: "a parameter is missing, unknown or out of range",
    ErrorCode.INTERNAL: "a bug in the daemon; its log has the details",
    ErrorCode.WRONG_STATE: "the daemon's state does not allow the request",
    ErrorCode.LEASE: "the lease has expired, or belongs to another client",
    ErrorCode.REFUSED: "a limit or an amplifier rejected the request",
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
    amplifiers: dict[str, AmplifierSilence] | None = None
    """by name; of error 1006 only"""


class RpcError(Exception):
    """A request that failed.

    Raised by the server's methods, and by clients when the daemon responds with an error.
    """

    def __init__(
        self,
        code: ErrorCode,
        problem: str,
        *,
        where: str | None = None,
        remedy: str | None = None,
        amplifiers: dict[str, AmplifierSilence] | None = None,
    ) -> None:
        super().__init__(f"{problem}; {remedy}" if remedy else problem)
        self.code = code
        self.data = ErrorData(what=problem, where=where, remedy=remedy, amplifiers=amplifiers)


class NotSilent(RpcError):
    """A stop after which an amplifier is not confirmed silent; amplifiers: all, by name."""

    def __init__(self, amplifiers: Mapping[str, AmplifierSilence]) -> None:
        unconfirmed = []
        for name, amplifier in amplifiers.items():
            if amplifier.silence != "confirmed_silent":
                unconfirmed.append(f"{name} ({amplifier.words}: {amplifier.cause})")
        self.amplifiers = dict(amplifiers)
        super().__init__(
            ErrorCode.NOT_SILENT,
            f"not confirmed silent: {', '.join(unconfirmed)}",
            remedy="switch these amplifiers off",
            amplifiers=self.amplifiers,
        )


class InvalidRequest(RpcError):
    """A line that is not a request; id: of its response, None if it cannot be read."""

    def __init__(self, code: ErrorCode, problem: str, *, remedy: str, id: Id = None) -> None:
        super().__init__(code, problem, remedy=remedy)
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
    try:
        return _validated(Request, document)
    except _InvalidMessage as problem:
        raise InvalidRequest(
            ErrorCode.INVALID_REQUEST,
            f"not a JSON-RPC 2.0 request: {problem}",
            remedy='send {"jsonrpc": "2.0", "id": 1, "method": ..., "params": {...}}; no batches',
            id=_readable_id(document),
        ) from problem


def read_params(model: type[_MessageT], request: Request) -> _MessageT:
    """Validate the parameters of a request; raises RpcError."""
    try:
        return _validated(model, request.params)
    except _InvalidMessage as problem:
        raise RpcError(
            ErrorCode.INVALID_PARAMS,
            f"{request.method}: {problem}",
            where=problem.key,
            remedy="see the method in docs/reference/api.md",
        ) from problem


class _InvalidMessage(Exception):
    """A message that does not fit its model; key: of the first problem, None for the whole."""

    def __init__(self, key: str | None, text: str) -> None:
        super().__init__(text if key is None else f"{key}: {text}")
        self.key = key


def _validated(model: type[_ModelT], content: Any) -> _ModelT:
    """Validate a message; raises _InvalidMessage, which quotes no input.

    If there are unknown keys, only the first is reported, so that the time is bounded.
    """
    unknown = _unknown_key(model, content)
    try:
        return model.model_validate(content if unknown is None else {unknown: None})
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        first = problems[0]
        for problem in problems:
            if problem["loc"] == (unknown,):
                first = problem
        key = _printable(".".join(map(str, first["loc"])))
        raise _InvalidMessage(key or None, reworded(first["msg"])) from error


def _unknown_key(model: type[BaseModel], content: object) -> str | None:
    """Return the first key of an object that its model does not have."""
    if isinstance(content, dict):
        for key in content:
            if key not in model.model_fields:
                return str(key)
    return None


def unknown_method(method: str, methods: Iterable[str]) -> RpcError:
    """The error for a method that does not exist."""
    return RpcError(
        ErrorCode.UNKNOWN_METHOD,
        f"unknown method {method[:40]!a}",
        remedy=f"use one of {', '.join(methods)}",
    )


def result_line(id: Id, result: str) -> bytes:
    """The response to a request; result: as JSON."""
    return f'{{"jsonrpc":"2.0","id":{json.dumps(id)},"result":{result}}}\n'.encode()


def error_line(id: Id, error: RpcError) -> bytes:
    """The response to a request that failed; id None if it could not be read."""
    data = error.data.model_dump()
    if not error.data.amplifiers:
        del data["amplifiers"]
    message = str(error)[:_MAX_ERROR_TEXT]
    content = {"code": int(error.code), "message": message, "data": data}
    return json.dumps({"jsonrpc": "2.0", "id": id, "error": content}).encode() + b"\n"


def read_error(error: Mapping[str, Any]) -> RpcError:
    """The error of a response; raises KeyError, TypeError or ValueError for anything else."""
    data = error.get("data") or {}
    code = ErrorCode(error["code"])
    if code is ErrorCode.NOT_SILENT:
        amplifiers = {}
        for name, silence in data["amplifiers"].items():
            amplifiers[name] = AmplifierSilence.model_validate(silence, extra="ignore")
        return NotSilent(amplifiers)
    problem = data.get("what", error["message"])
    return RpcError(code, problem, where=data.get("where"), remedy=data.get("remedy"))


def request_line(id: Id, method: str, params: bytes) -> bytes:
    """A request as clients send it; params: as JSON."""
    # Before the parameters, which may be unread: a key that they repeat is refused.
    head = {"jsonrpc": "2.0", "id": id, "method": method}
    return json.dumps(head)[:-1].encode() + b',"params":' + params + b"}\n"


def event_line(topic: str, *, time: float, lost: int, data: bytes) -> bytes:
    """An `event` notification; data: as JSON, serialized once for all subscribers; time [s]."""
    head = f'{{"jsonrpc":"2.0","method":"event","params":{{"topic":"{topic}","time_s":{time:.6f}'
    return f'{head},"lost":{lost},"data":'.encode() + data + b"}}\n"


def parse_json(line: bytes) -> Any:
    """Parse bounded JSON without repeated keys, NaN and infinity; raises InvalidRequest."""
    if not _is_bounded(line):
        raise InvalidRequest(
            ErrorCode.PARSE, "too many keys or values", remedy="send fewer touches per frame"
        )
    problems = []

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            counts = Counter(key for key, _ in pairs)
            [(repeated, _)] = counts.most_common(1)
            problems.append(f"key {_printable(repeated)} is repeated")
        return content

    def refuse_constant(name: str) -> None:
        problems.append(f"{name} is not JSON")

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


def _is_bounded(line: bytes) -> bool:
    """Whether a line is short, with few keys, values and levels, so that parsing is fast."""
    if len(line) > MAX_LINE_LENGTH:
        return False
    commas = line.count(b",")
    if commas > MAX_SEPARATORS:  # counts no colons in a hostile line
        return False
    separators = commas + line.count(b":")
    openings = line.count(b"{") + line.count(b"[")
    return separators <= MAX_SEPARATORS and openings <= MAX_OPENINGS


def _readable_id(document: object) -> Id:
    """The id of a document that is not a request, if it has one."""
    if not isinstance(document, dict):
        return None
    try:
        return _REQUEST_ID.validate_python(document.get("id"))
    except ValidationError:
        return None


def _printable(name: str) -> str:
    """A key, shortened and free of control characters."""
    printable = name if name.isprintable() else ascii(name)
    return printable[:80]
