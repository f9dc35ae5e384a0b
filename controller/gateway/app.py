"""The gateway's routes: the page, the API over HTTP with its OpenAPI description, the WebSocket."""

import asyncio
import contextlib
import json
import math
import operator
import time
from functools import partial
from pathlib import Path
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST
from pydantic.json_schema import models_json_schema
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from controller.api.async_client import AsyncClient
from controller.api.client_protocol import RESPONSE_TIMEOUT, Unreachable, read_line, result_of
from controller.api.jsonrpc import (
    ERROR_MEANINGS,
    ErrorCode,
    ErrorData,
    RpcError,
    error_line,
    parse_json,
    read_params,
    read_request,
    request_line,
    unknown_method,
)
from controller.api.methods import METHODS, SILENCING, Method, StatusResult
from controller.api.schema import API_VERSION, Message
from controller.api.summaries import SUMMARIES
from controller.gateway.access import SUBPROTOCOL, Access
from controller.gateway.bridge import KeptLink, bridge, client_name
from controller.gateway.field import DrawnField
from controller.gateway.metrics import exposition
from controller.gateway.settings import Settings
from controller.process.rate_limit import RateLimiter, Rates

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
        "summary": SUMMARIES[name],
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


MAX_BODY = 1 << 16  # bytes
MAX_SESSIONS = 24  # WebSockets; the daemon has 32 connections, and some for stops
MAX_OPENING_RATE, OPENING_BURST = 10.0, 32.0  # 1/s; of a host's connections to the daemon, and in
# a burst
MAX_TOTAL_RATE, TOTAL_BURST = 16.0, 48.0  # the same of all hosts together: fewer than the daemon
# accepts of one process, so that there are always some for the gateway's own
_METRICS_TIME = 0.5  # s; for which the same metrics are given
_MAX_DISARMS = 8  # at once; the daemon carries out as many of one client
TRY_AGAIN_LATER = 1013  # close code in the registry of RFC 6455

_PAGE = Path(__file__).parent / "page"


class Gateway:
    """State shared by the routes; `app` is the ASGI application, `run` to be run beside it."""

    def __init__(self, settings: Settings) -> None:
        self.field = DrawnField(settings.socket)
        self._daemon = settings.socket
        self._session_count = 0
        # Of connections to the daemon, by host.
        self._rates = Rates(MAX_OPENING_RATE, burst=OPENING_BURST, clock=time.monotonic)
        self._rate = RateLimiter(MAX_TOTAL_RATE, burst=TOTAL_BURST, clock=time.monotonic)
        # For what must not wait for a new connection, which the daemon may refuse.
        self._own = AsyncClient(settings.socket, name="gateway", timeout=RESPONSE_TIMEOUT)
        self._disarms = asyncio.Semaphore(_MAX_DISARMS)
        self._reading = asyncio.Lock()
        self._read_at = -math.inf  # s; when the metrics were read
        self._exposition = b""
        self.app = Starlette(
            routes=[
                Mount(
                    "/api/v1",
                    routes=[
                        Route("/openapi.json", JSONResponse(openapi())),
                        Route("/{method}", self._call, methods=["POST"]),
                        WebSocketRoute("/ws", self._serve),
                    ],
                ),
                Route("/metrics", self._metrics),
                Mount("/", StaticFiles(directory=_PAGE, html=True)),
            ],
            middleware=[
                Middleware(Access, settings=settings),
                Middleware(
                    CORSMiddleware,
                    allow_origins=settings.origins,
                    allow_methods=["POST"],
                    allow_headers=["Authorization", "Content-Type"],
                ),
            ],
            exception_handlers={HTTPException: _http_error},
        )

    async def run(self) -> None:
        """Keep what it has of the daemon for all browsers, until cancelled."""
        async with asyncio.TaskGroup() as own:
            own.create_task(self.field.run())
            own.create_task(self._keep_connected())

    async def _keep_connected(self) -> None:
        """Connect again after every loss, so that no stop has to wait for it."""
        while True:
            with contextlib.suppress(RpcError, Unreachable):
                await self._own.next_event()  # it subscribes to none

    async def _metrics(self, _: Request) -> Response:
        """The daemon's status for Prometheus, read once for all who need it: it needs no token."""
        async with self._reading:
            if time.monotonic() >= self._read_at + _METRICS_TIME:
                self._exposition = exposition(await self._status())
                self._read_at = time.monotonic()
        return Response(self._exposition, media_type=CONTENT_TYPE_LATEST)

    async def _status(self) -> StatusResult | None:
        """The daemon's status, None without a daemon."""
        try:
            return await self._own.status()
        except (RpcError, Unreachable):
            return None

    async def _call(self, request: Request) -> Response:
        """Call one method of the API; its parameters are the body."""
        method = request.path_params["method"]
        try:
            if method not in HTTP_METHODS:
                raise unknown_method(method, HTTP_METHODS)
            return JSONResponse(await self._request(request, method, await _body(request)))
        except RpcError as error:
            failed = json.loads(error_line(None, error))["error"]
            content = {"error": failed["message"], "code": failed["code"], "data": failed["data"]}
            return JSONResponse(content, HTTP_STATUS[error.code])
        except (ClientDisconnect, asyncio.CancelledError):  # cancelled when the gateway ends
            return Response(status_code=400)  # sent to nowhere

    async def _request(self, request: Request, method: str, params: bytes) -> Any:
        """The daemon's result, over the connection that this one keeps; raises RpcError."""
        name = client_name("http", request)
        try:
            if method in SILENCING:  # over the own connection, from any client
                return await self._silence(name, method, params)
            kept: KeptLink = request.state.daemon
            line = await kept.request(
                self._daemon, name, method, params, may_open=partial(self.may_connect, request)
            )
            return result_of(read_line(line))
        except Unreachable as error:
            raise RpcError(ErrorCode.LINK, str(error)) from error

    async def _silence(self, name: str, method: str, params: bytes) -> Any:
        """The result of a stop or disarm of a client; raises RpcError and Unreachable."""
        read = read_request(request_line(name, method, params))
        given = read_params(METHODS[method].params, read)
        given = given.model_copy(update={"client": read.params.get("client") or name})
        async with contextlib.nullcontext() if method == "stop" else self._disarms:
            result = await self._own.call(method, given, METHODS[method].result)
        return result.model_dump(mode="json")

    async def _serve(self, socket: WebSocket) -> None:
        """Serve one browser."""
        if SUBPROTOCOL not in socket.scope["subprotocols"]:
            await socket.close(1002, f"the subprotocol must be {SUBPROTOCOL}")
            return
        if self._session_count >= MAX_SESSIONS or not self.may_connect(socket):
            await socket.close(TRY_AGAIN_LATER, "too many clients")
            return
        self._session_count += 1  # before the first await, so that the limit holds
        try:
            await socket.accept(subprotocol=SUBPROTOCOL)
            await bridge(socket, self._daemon, self.field)
        finally:
            self._session_count -= 1

    def may_connect(self, client: HTTPConnection) -> bool:
        """Whether a client's host may open a connection to the daemon; counts it."""
        host = "" if client.client is None else client.client.host
        return self._rates.of(host).take() and self._rate.take()


async def _body(request: Request) -> bytes:
    """A request's body on one line, by default an empty object; raises HTTPException and RpcError.

    It is parsed here, so that lines and columns of an error are those of the body.
    """
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in ("application/json", ""):
        raise HTTPException(415, "the content type must be application/json")
    too_large = HTTPException(413, f"the body must have at most {MAX_BODY} bytes")
    if int(request.headers.get("content-length", "0")) > MAX_BODY:  # checked to be a number
        raise too_large
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY:
            raise too_large
    if body and not media:  # an empty body needs no type
        raise HTTPException(415, "the content type must be application/json")
    parse_json(body or b"{}")
    return body.replace(b"\n", b"\r") or b"{}"  # both are spaces, and neither is within a text


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 (registered for this class alone)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)
