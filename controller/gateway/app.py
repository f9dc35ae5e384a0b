"""The gateway's routes: the page, the API over HTTP, and the WebSocket."""

import json
import time
from pathlib import Path
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from controller.api.client_protocol import Unreachable, read_result
from controller.api.jsonrpc import (
    ErrorCode,
    RpcError,
    error_data,
    parse_json,
    read_params,
    unknown_method,
)
from controller.api.jsonrpc import Request as RpcRequest
from controller.api.methods import ArmParams, StatusResult
from controller.api.rate_limit import RateLimiter
from controller.api.schema import Empty, Message
from controller.gateway.access import MAX_BODY, SUBPROTOCOL, Access
from controller.gateway.metrics import exposition
from controller.gateway.mirror import DaemonMirror
from controller.gateway.openapi import HTTP_METHODS, HTTP_STATUS, openapi
from controller.gateway.session import (
    TRY_AGAIN_LATER,
    Session,
    arm_for,
    in_name_of,
    name_client,
    touch_params,
)
from controller.gateway.settings import Settings

MAX_SESSIONS = 32
MAX_HTTP_RATE = 500.0  # 1/s; of all clients together, of what is not UNLIMITED
UNLIMITED = frozenset({"stop", "disarm"})

_PAGE = Path(__file__).parent / "page"


class Gateway:
    """State shared by the routes; `app` is the ASGI application."""

    def __init__(self, settings: Settings) -> None:
        self._sessions: set[Session] = set()
        self._mirror = DaemonMirror(settings.socket, publish=self._publish)
        self._rate = RateLimiter(MAX_HTTP_RATE, clock=time.monotonic)
        self._openapi = json.dumps(openapi()).encode()
        self.app = Starlette(
            routes=[
                Mount(
                    "/api/v1",
                    routes=[
                        Route("/openapi.json", self._describe),
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

    async def follow(self) -> None:
        """Follow the daemon until cancelled."""
        await self._mirror.run()

    def _publish(self, topic: str, frame: str | bytes) -> None:
        for session in self._sessions:
            session.publish(topic, frame)

    async def _describe(self, _: Request) -> Response:
        return Response(self._openapi, media_type="application/json")

    async def _metrics(self, _: Request) -> Response:
        """Read the daemon's status for Prometheus."""
        if not self._rate.take():
            raise HTTPException(429, "too many requests; send fewer per second")
        try:
            found = await self._mirror.daemon.call("status", Empty())
            status = read_result(found, StatusResult)
        except (RpcError, Unreachable):
            status = None
        return Response(exposition(status), media_type=CONTENT_TYPE_LATEST)

    async def _call(self, request: Request) -> Response:
        """Call one method of the API; its parameters are the body."""
        method = request.path_params["method"]
        try:
            if method not in HTTP_METHODS:
                raise unknown_method(method, HTTP_METHODS)
            body = await _body(request)
            if method not in UNLIMITED and not self._rate.take():
                raise RpcError(ErrorCode.BUSY, "too many requests", remedy="send fewer per second")
            call = RpcRequest(method, body, None, expects_response=True)
            client = name_client("http", request)
            if method == "touch":  # fingers belong to the connection
                params: Message = touch_params(call, client)
            else:
                params = in_name_of(client, read_params(HTTP_METHODS[method].params, call))
            if isinstance(params, ArmParams):
                daemon, has_left = self._mirror.daemon, request.is_disconnected
                return JSONResponse(await arm_for(daemon, params, has_left=has_left))
            return JSONResponse(await self._mirror.daemon.call(method, params))
        except RpcError as error:
            return _api_error(error)
        except ClientDisconnect:
            return Response(status_code=400)  # sent to nowhere

    async def _serve(self, socket: WebSocket) -> None:
        """Serve one browser."""
        if SUBPROTOCOL not in socket.scope["subprotocols"]:
            await socket.close(1002, f"the subprotocol must be {SUBPROTOCOL}")
            return
        if len(self._sessions) >= MAX_SESSIONS:
            await socket.close(TRY_AGAIN_LATER, "too many clients")
            return
        session = Session(
            socket, self._mirror.daemon, current=self._mirror.current, clock=time.monotonic
        )
        self._sessions.add(session)  # before the first await, so that the limit holds
        try:
            await socket.accept(subprotocol=SUBPROTOCOL)
            await session.run()
        finally:
            self._sessions.discard(session)


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object in a request's body; raises HTTPException."""
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in ("application/json", ""):
        raise HTTPException(415, "the content type must be application/json")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY:
            raise HTTPException(413, f"the body must have at most {MAX_BODY} bytes")
    if body and not media:  # an empty body needs no type
        raise HTTPException(415, "the content type must be application/json")
    try:
        params = parse_json(body or b"{}")
    except RpcError as error:
        raise HTTPException(400, f"the body must be a JSON object: {error}") from error
    if not isinstance(params, dict):
        raise HTTPException(400, "the body must be a JSON object")
    return params


def _api_error(error: RpcError) -> Response:
    return JSONResponse(
        {"error": str(error), "code": int(error.code), "data": error_data(error)},
        HTTP_STATUS[error.code],
    )


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 (registered for this class alone)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)
