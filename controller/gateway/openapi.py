"""The OpenAPI description of the gateway, from the API's message models."""

import operator
from typing import Any

from pydantic.json_schema import models_json_schema

from controller.api.jsonrpc import ERROR_MEANINGS, ErrorCode, ErrorData
from controller.api.methods import METHODS, Method
from controller.api.schema import API_VERSION, Message

HTTP_METHODS = {name: method for name, method in METHODS.items() if method.over_http}
"""Methods available over HTTP: notifications need a WebSocket."""

HTTP_STATUS = {
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
    ErrorCode.NOT_SILENT: 503,
}
"""HTTP status of each error of the API."""

_GATEWAY_ERRORS = {
    400: "the body is not a JSON object",
    401: "the token is missing or wrong",
    403: "the origin is not allowed",
    413: "the body is too large",
    415: "the content type is not application/json",
    421: "the Host header does not name this gateway",
}


class ErrorBody(Message):
    """Body of a response with an error status."""

    error: str
    code: int | None = None
    data: ErrorData | None = None


def openapi() -> dict[str, Any]:
    """The description, OpenAPI 3.1."""
    params = {method.params for method in HTTP_METHODS.values()}
    results = {method.result for method in HTTP_METHODS.values()} | {ErrorBody}
    by_name = operator.attrgetter("__name__")
    references, definitions = models_json_schema(
        [(model, "validation") for model in sorted(params, key=by_name)]
        + [(model, "serialization") for model in sorted(results, key=by_name)],
        ref_template="#/components/schemas/{model}",
    )
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "era-haptics gateway",
            "version": API_VERSION,
            "description": (
                "The daemon's API over HTTP. The WebSocket /api/v1/ws has the same methods and "
                "notifications, see docs/reference/gateway.md. This is an operational interface, "
                "not an emergency stop."
            ),
        },
        "security": [{"token": []}],
        "paths": {
            f"/api/v1/{name}": {"post": _operation(name, method, references)}
            for name, method in HTTP_METHODS.items()
        },
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": definitions["$defs"],
        },
    }


def _operation(name: str, method: Method, references: Any) -> dict[str, Any]:
    """Request and responses of one method."""
    errors = dict(_GATEWAY_ERRORS)
    for code, status in HTTP_STATUS.items():
        errors[status] = "; ".join(filter(None, (errors.get(status), ERROR_MEANINGS[code])))
    failure = {"application/json": {"schema": references[ErrorBody, "serialization"]}}
    success = {"application/json": {"schema": references[method.result, "serialization"]}}
    return {
        "operationId": name,
        "summary": method.summary,
        "requestBody": {
            "required": any(field.is_required() for field in method.params.model_fields.values()),
            "content": {"application/json": {"schema": references[method.params, "validation"]}},
        },
        "responses": {
            "200": {"description": "done", "content": success},
            **{
                str(status): {"description": meaning, "content": failure}
                for status, meaning in sorted(errors.items())
            },
        },
    }
