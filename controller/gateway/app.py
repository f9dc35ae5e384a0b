"""The gateway's routes: the page, the API over HTTP, and the WebSocket."""

import json
import time
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from controller.api.jsonrpc import ErrorCode, RpcError, read_params
from controller.api.jsonrpc import Request as RpcRequest
from controller.api.methods import METHODS, TouchParams
from controller.api.rate_limit import RateLimiter
from controller.gateway.access import LARGEST_BODY, SUBPROTOCOL, Access
from controller.gateway.mirror import DaemonMirror
from controller.gateway.openapi import NOT_OVER_HTTP, STATUS_OF, openapi
from controller.gateway.session import TRY_AGAIN_LATER, Session, told_apart
from controller.gateway.settings import Settings

MAX_SESSIONS = 32
HTTP_REQUESTS_PER_SECOND = 500.0  # of everybody together; a stop is not counted

_PAGE = Path(__file__).parent / "page"


class Gateway:
    """Everything that the routes share; `app` is the ASGI application."""

    def __init__(self, settings: Settings) -> None:
        self._sessions: set[Session] = set()
        self._picture = DaemonMirror(settings.socket, tell=self._tell)
        self._rate = RateLimiter(HTTP_REQUESTS_PER_SECOND, clock=time.monotonic)
        self._description = json.dumps(openapi()).encode()
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
            exception_handlers={HTTPException: _refused},
        )

    async def follow(self) -> None:
        """Reach for the daemon, and follow what it tells, until cancelled."""
        await self._picture.run()

    def _tell(self, topic: str, frame: str | bytes) -> None:
        for session in self._sessions:
            session.tell(topic, frame)

    async def _describe(self, _: Request) -> Response:
        return Response(self._description, media_type="application/json")

    async def _call(self, request: Request) -> Response:
        """One method of the API, its parameters in the body."""
        method = request.path_params["method"]
        try:
            if method not in METHODS or method in NOT_OVER_HTTP:
                known = ", ".join(name for name in METHODS if name not in NOT_OVER_HTTP)
                raise RpcError(
                    ErrorCode.UNKNOWN_METHOD,
                    f"there is no method {method[:40]!a}",
                    remedy=f"known are {known}",
                )
            params = await _body(request)
            if method != "stop" and not self._rate.take():
                raise RpcError(ErrorCode.BUSY, "too many requests", remedy="ask less often")
            asked = read_params(
                METHODS[method].params, RpcRequest(method, params, None, wants_answer=True)
            )
            if isinstance(asked, TouchParams):
                asked = told_apart(asked, "http")
            return JSONResponse(await self._picture.daemon.call(method, asked))
        except RpcError as error:
            return _failed(STATUS_OF[error.code], error)
        except ClientDisconnect:
            return Response(status_code=400)  # which nobody will read

    async def _serve(self, socket: WebSocket) -> None:
        """One browser."""
        if SUBPROTOCOL not in socket.scope["subprotocols"]:
            await socket.close(1002, f"speak the subprotocol {SUBPROTOCOL}")
            return
        if len(self._sessions) >= MAX_SESSIONS:
            await socket.close(TRY_AGAIN_LATER, "too many clients")
            return
        session = Session(
            socket, self._picture.daemon, current=self._picture.current, clock=time.monotonic
        )
        self._sessions.add(session)  # before anything waits, or more would come in than may
        try:
            await socket.accept(subprotocol=SUBPROTOCOL)
            await session.run()
        finally:
            self._sessions.discard(session)


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object in a request's body; raises RpcError and HTTPException."""
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in ("application/json", ""):
        raise HTTPException(415, "the body is of another type; send application/json")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            raise HTTPException(413, f"a request has at most {LARGEST_BODY} bytes")
    if body and not media:  # what has no parameters needs no type either
        raise HTTPException(415, "the body has no type; send application/json")
    try:
        params = json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, "the body is no JSON; send one JSON object") from error
    if not isinstance(params, dict):
        raise HTTPException(400, "the body is no JSON object; send one, such as {}")
    return params


def _failed(status: int, error: RpcError) -> Response:
    """An error of the API."""
    return JSONResponse(
        {"error": str(error), "code": int(error.code), "data": error.data.model_dump()}, status
    )


async def _refused(_: Request, error: Exception) -> Response:
    """An error of HTTP."""
    assert isinstance(error, HTTPException)  # noqa: S101 (it is registered for these alone)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)
