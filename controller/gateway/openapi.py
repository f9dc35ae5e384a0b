"""The API over HTTP: its methods, the status of each error, and its OpenAPI description."""

from typing import Any

from pydantic.json_schema import JsonSchemaMode, models_json_schema

from controller.api.jsonrpc import ERROR_MEANINGS, ErrorCode, ErrorData
from controller.api.methods import METHODS, Method
from controller.api.schema import API_VERSION, ApiMessage
from controller.api.summaries import SUMMARIES

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


class ErrorBody(ApiMessage):
    """Body of a response with an error status."""

    error: str
    code: int | None = None
    data: ErrorData | None = None


def openapi() -> dict[str, Any]:
    """Return the OpenAPI 3.1 description of the API."""
    references, definitions = _schemas()
    paths = {}
    for name, method in HTTP_METHODS.items():
        paths[f"/api/v1/{name}"] = {"post": _operation(name, method, references)}
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
        "paths": paths,
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": definitions["$defs"],
        },
    }


def _schemas() -> tuple[Any, dict[str, Any]]:
    """Return references to the schemas of all bodies, by model and mode, and the schemas."""
    params: set[type[ApiMessage]] = set()
    results: set[type[ApiMessage]] = {ErrorBody}
    for method in HTTP_METHODS.values():
        params.add(method.params)
        results.add(method.result)
    models: list[tuple[type[ApiMessage], JsonSchemaMode]] = []
    for model in sorted(params, key=repr):
        models.append((model, "validation"))
    for model in sorted(results, key=repr):
        models.append((model, "serialization"))
    template = "#/components/schemas/{model}"
    return models_json_schema(models, ref_template=template)


def _operation(name: str, method: Method, references: Any) -> dict[str, Any]:
    """Return the request and responses of a method."""
    errors = dict(_GATEWAY_ERRORS)
    for code, status in HTTP_STATUS.items():
        meanings = [ERROR_MEANINGS[code]]
        if status in errors:
            meanings.insert(0, errors[status])
        errors[status] = "; ".join(meanings)
    success = _json_content(references[method.result, "serialization"])
    failure = _json_content(references[ErrorBody, "serialization"])
    responses: dict[str, Any] = {"200": {"description": "done", "content": success}}
    for status, meaning in sorted(errors.items()):
        responses[str(status)] = {"description": meaning, "content": failure}
    fields = method.params.model_fields.values()
    return {
        "operationId": name,
        "summary": SUMMARIES[name],
        "requestBody": {
            "required": any(field.is_required() for field in fields),
            "content": _json_content(references[method.params, "validation"]),
        },
        "responses": responses,
    }


def _json_content(schema: Any) -> dict[str, Any]:
    """Return the description of a body in JSON."""
    return {"application/json": {"schema": schema}}
