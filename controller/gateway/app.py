"""The gateway's routes: the page, the API over HTTP, and the WebSocket."""

import asyncio
import contextlib
import json
import math
import time
from pathlib import Path
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST
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
    ErrorCode,
    RpcError,
    error_line,
    read_params,
    read_request,
    request_line,
    unknown_method,
)
from controller.api.methods import METHODS, SILENCING, StatusResult
from controller.api.rate_limit import RateLimiter, Rates
from controller.gateway.access import SUBPROTOCOL, Access
from controller.gateway.bridge import bridge, client_name
from controller.gateway.field import DrawnField
from controller.gateway.kept_links import KeptLink
from controller.gateway.metrics import exposition
from controller.gateway.openapi import HTTP_METHODS, HTTP_STATUS, openapi
from controller.gateway.settings import Settings

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
            if not (kept.is_open or self._may_connect(request)):
                raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
            return result_of(read_line(await kept.request(self._daemon, name, method, params)))
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
        if self._session_count >= MAX_SESSIONS or not self._may_connect(socket):
            await socket.close(TRY_AGAIN_LATER, "too many clients")
            return
        self._session_count += 1  # before the first await, so that the limit holds
        try:
            await socket.accept(subprotocol=SUBPROTOCOL)
            await bridge(socket, self._daemon, self.field)
        finally:
            self._session_count -= 1

    def _may_connect(self, client: HTTPConnection) -> bool:
        """Whether a client's host may open a connection to the daemon; counts it."""
        host = "" if client.client is None else client.client.host
        return self._rates.of(host).take() and self._rate.take()


async def _body(request: Request) -> bytes:
    """A request's body on one line, by default an empty object; raises HTTPException."""
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
    return body.replace(b"\n", b"\r") or b"{}"  # both are spaces, and neither is within a text


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 (registered for this class alone)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)
