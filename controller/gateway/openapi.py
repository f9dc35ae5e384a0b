"""The OpenAPI description of the gateway, from the same models as everything else."""

from typing import Any

from pydantic.json_schema import models_json_schema

from controller.api.jsonrpc import ERROR_MEANINGS, ErrorCode, ErrorData
from controller.api.methods import METHODS, Method
from controller.api.schema import API_VERSION, Empty, Message

NOT_OVER_HTTP = frozenset({"subscribe", "unsubscribe"})
"""What only makes sense where notifications arrive."""

STATUS_OF = {
    ErrorCode.PARSE: 400,
    ErrorCode.INVALID_REQUEST: 400,
    ErrorCode.UNKNOWN_METHOD: 404,
    ErrorCode.INVALID_PARAMS: 422,
    ErrorCode.INTERNAL: 500,
    ErrorCode.WRONG_STATE: 409,
    ErrorCode.LEASE: 409,
    ErrorCode.REFUSED: 409,
    ErrorCode.LINK: 503,
    ErrorCode.BUSY: 429,
}
"""The HTTP status of each error of the API."""

_OF_THE_GATEWAY = {
    400: "the body is no JSON object",
    401: "the token is missing or another",
    403: "the page that calls is one of others",
    413: "the body is too large",
    415: "the body is not application/json",
    421: "the host that was called is not this gateway's",
}


class ErrorAnswer(Message):
    """Why a request failed."""

    error: str
    code: int | None = None
    data: ErrorData | None = None


def openapi() -> dict[str, Any]:
    """The description, OpenAPI 3.1."""
    methods = {name: method for name, method in METHODS.items() if name not in NOT_OVER_HTTP}
    models = {method.params for method in methods.values()}
    results = {method.result for method in methods.values()} | {ErrorAnswer}
    references, definitions = models_json_schema(
        [(model, "validation") for model in sorted(models, key=_name)]
        + [(model, "serialization") for model in sorted(results, key=_name)],
        ref_template="#/components/schemas/{model}",
    )
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "era-haptics gateway",
            "version": API_VERSION,
            "description": (
                "The API of the daemon over HTTP. The same methods and, beside them, notifications "
                "go over the WebSocket /api/v1/ws, see docs/reference/gateway.md. This is an "
                "operational interface, not an emergency stop."
            ),
        },
        "security": [{"token": []}],
        "paths": {
            f"/api/v1/{name}": {"post": _operation(name, method, references)}
            for name, method in methods.items()
        },
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": definitions["$defs"],
        },
    }


def _name(model: type[Message]) -> str:
    return model.__name__


def _operation(name: str, method: Method, references: Any) -> dict[str, Any]:
    """What one method takes and gives."""
    refusals = dict(_OF_THE_GATEWAY)
    for code, status in STATUS_OF.items():
        refusals[status] = "; ".join(filter(None, (refusals.get(status), ERROR_MEANINGS[code])))
    failure = {"application/json": {"schema": references[ErrorAnswer, "serialization"]}}
    success = {"application/json": {"schema": references[method.result, "serialization"]}}
    return {
        "operationId": name,
        "summary": method.meaning,
        "requestBody": {
            "required": method.params is not Empty,
            "content": {"application/json": {"schema": references[method.params, "validation"]}},
        },
        "responses": {
            "200": {"description": "done", "content": success},
            **{
                str(status): {"description": meaning, "content": failure}
                for status, meaning in sorted(refusals.items())
            },
        },
    }
