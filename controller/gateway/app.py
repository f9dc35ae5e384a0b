"""The gateway's routes and process: page, API over HTTP, WebSocket and metrics.

`Gateway` holds the routes, `serve` runs them in aiohttp until SIGINT or SIGTERM and ends within a
second.
"""

import asyncio
import contextlib
import json
import logging
import mimetypes
import os
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import HttpVersion11, WSCloseCode, web
from aiohttp.http import HttpProcessingError
from aiohttp.typedefs import Handler
from prometheus_client import CONTENT_TYPE_LATEST

from controller.api.client import AsyncClient
from controller.api.jsonrpc import (
    ErrorCode,
    RpcError,
    error_line,
    parse_json,
    read_params,
    request_of,
    unknown_method,
)
from controller.api.link import RESPONSE_TIMEOUT, Unreachable
from controller.api.methods import METHODS, SILENCING
from controller.api.schema import ApiMessage
from controller.api.silencing import readable_params
from controller.gateway.access import SUBPROTOCOL, Access
from controller.gateway.bridge import MAX_READ_FRAME, BrowserSocket, bridge
from controller.gateway.connections import (
    CLIENT_TIMEOUT,
    CONNECTION,
    ClientConnection,
    Connections,
)
from controller.gateway.field import DrawnField
from controller.gateway.gateway_settings import GatewaySettings
from controller.gateway.metrics import exposition
from controller.gateway.openapi import HTTP_METHODS, HTTP_STATUS, openapi
from controller.process.daemon_process import allow_many_descriptors
from model.errors import InputError
from registry.threads import no_long_collections, stop_accepting

MAX_BODY = 1 << 16  # bytes
MAX_REQUESTS = 256  # simultaneous, to the daemon
MAX_SESSIONS = 24  # WebSockets; the daemon has 32 connections, and some for stops
METRICS_INTERVAL = 0.5  # s; for which metrics are cached
_MAX_DISARMS = 8  # simultaneous, so that the daemon always reads a stop that follows
_STOP_DELAY = 0.01  # s; maximum wait for a body with the name of the stopping client
_HEARTBEAT = 10.0  # s; without a frame from a browser, until a ping is sent
_CLOSE_TIMEOUT = 0.3  # s; for a browser to close its side
_PAGE = Path(__file__).parent / "page"

_MAX_LINE = 1 << 13  # bytes; of the head of a request
_MAX_LINES = 64
_QUEUE = 512  # connections that wait to be accepted
_ACCEPTED = 4  # connections per iteration of the event loop
_NICENESS = 10  # added, so that the daemon's control loop has priority
_SHUTDOWN_TIMEOUT = 0.3  # s; for requests to finish


class Gateway:
    """State shared by the routes; run `field.run` and `keep_connected` concurrently with `app`."""

    def __init__(self, settings: GatewaySettings) -> None:
        self.field = DrawnField(settings.socket)
        self._access = Access(settings)
        self._daemon = settings.socket
        self._sessions: set[BrowserSocket] = set()
        self._places = asyncio.Semaphore(MAX_REQUESTS)
        self._connections = Connections(settings.socket)
        # For requests that must not wait for a new connection, which the daemon may reject.
        self._own = AsyncClient(settings.socket, name="gateway", timeout=RESPONSE_TIMEOUT)
        self._disarms = asyncio.Semaphore(_MAX_DISARMS)
        self._reading = asyncio.Lock()
        self._read_at = float("-inf")  # s; when the metrics were read
        self._exposition = b""
        self._files = {file.name: file.read_bytes() for file in _PAGE.iterdir()}
        self._files["openapi.json"] = json.dumps(openapi()).encode()
        self.app = web.Application(middlewares=[self._answer], client_max_size=MAX_BODY)
        later: dict[str, Any] = {"expect_handler": _continue_later}
        self.app.add_routes(
            [
                web.get("/api/v1/{file:openapi.json}", self._file),
                web.get("/api/v1/ws", self._serve, allow_head=False, **later),
                web.options("/api/v1/{method}", self._access.preflight),
                web.post("/api/v1/{method}", self._call, **later),
                web.get("/metrics", self._metrics, **later),
                web.get("/{file:[^/]*}", self._file),
            ]
        )
        self.app.on_response_prepare.append(self._access.protect)
        self.app.on_shutdown.append(self._end_sessions)

    def connection(self, make_server: Callable[[], web.RequestHandler]) -> ClientConnection:
        """Make a connection with the web server's protocol."""
        return ClientConnection(make_server, self._connections)

    async def keep_connected(self) -> None:
        """Reconnect to the daemon after every loss, so that no stop has to wait for that."""
        while True:
            with contextlib.suppress(RpcError, Unreachable):
                await self._own.next_event()  # without subscriptions

    @web.middleware
    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request and respond. A stop is carried out even if its client has left."""
        connection = CONNECTION.get()
        connection.start_request(request)
        try:
            method = _method_that_silences(request)
            if method is not None and self._access.allows(request):
                connection.admit()
                return await self._silence(request, method)
            if method is not None:
                await connection.wait_for_turn()
            connection.admit()
            self._access.check_form(request)
            self._access.check(request)
            return await handler(request)
        except web.HTTPException as error:
            status = 403 if "Upgrade" in request.headers else error.status
            allowed = error.headers.getall("Allow", [])
            headers = [("Allow", methods) for methods in allowed]
            return web.json_response({"error": error.text}, status=status, headers=headers)
        finally:
            connection.finish()

    async def _file(self, request: web.Request) -> web.Response:
        """A file of the page, or the description."""
        name = request.match_info["file"] or "index.html"
        if name not in self._files:
            raise web.HTTPNotFound
        media, _ = mimetypes.guess_type(name)
        return web.Response(body=self._files[name], content_type=media, charset="utf-8")

    async def _metrics(self, _: web.Request) -> web.Response:
        """Return the daemon's status for Prometheus, cached because it needs no token."""
        async with self._reading:
            if time.monotonic() >= self._read_at + METRICS_INTERVAL:
                try:
                    self._exposition = exposition(await self._own.status())
                except (RpcError, Unreachable):
                    self._exposition = exposition(None)
                self._read_at = time.monotonic()
        return web.Response(body=self._exposition, headers={"Content-Type": CONTENT_TYPE_LATEST})

    async def _call(self, request: web.Request) -> web.Response:
        """Call one method of the API; its parameters are the body."""
        method = request.match_info["method"]
        try:
            if method not in HTTP_METHODS:
                raise unknown_method(method, HTTP_METHODS)
            if self._places.locked():
                raise web.HTTPServiceUnavailable(
                    text="too many simultaneous requests; try again later"
                )
            async with self._places:
                _check_media(request)
                params = _read_params(method, await _read_body(request))
                result = await CONNECTION.get().request(method, params)
            return web.json_response(result)
        except (RpcError, Unreachable) as error:
            return _failure(error)

    async def _silence(self, request: web.Request, method: str) -> web.Response:
        """Call a method that silences, then report the errors of the request.

        Uses the gateway's own connection to the daemon. Only access was checked before.
        """
        reading = asyncio.create_task(self._read(request))
        try:
            # A stop does not wait for its body, which only names the client. The body of a disarm
            # can restrict it to a lease.
            timeout = _STOP_DELAY if method == "stop" else None
            await asyncio.wait({reading}, timeout=timeout)
            result = await self._request_silence(method, _body_read(reading))
            if request.method != "POST":
                raise web.HTTPMethodNotAllowed(request.method, ["POST"])
            _check_media(request)
            _read_params(method, await reading)
            return web.json_response(result)
        except (RpcError, Unreachable) as error:
            return _failure(error)
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    async def _read(self, request: web.Request) -> bytes:
        self._access.check_form(request)
        return await _read_body(request)

    async def _request_silence(self, method: str, body: object) -> Any:
        """Return the daemon's result, for the readable parameters of a body."""
        params = readable_params(method, body)
        if getattr(params, "client", None) is None:
            params = params.model_copy(update={"client": f"http {CONNECTION.get().address}"})
        async with contextlib.nullcontext() if method == "stop" else self._disarms:
            return await self._own.request(method, params)

    async def _serve(self, request: web.Request) -> BrowserSocket:
        """Serve one browser."""
        connection = CONNECTION.get()
        socket: BrowserSocket = web.WebSocketResponse(
            protocols=[SUBPROTOCOL],
            compress=False,  # no decompression bombs
            heartbeat=_HEARTBEAT,
            max_msg_size=MAX_READ_FRAME,
            decode_text=False,  # invalid text is first searched for requests that silence
            timeout=_CLOSE_TIMEOUT,
            autoclose=False,  # by the bridge
        )
        if len(self._sessions) >= MAX_SESSIONS:
            raise web.HTTPForbidden(text="too many clients")
        subprotocols = request.headers.get("Sec-WebSocket-Protocol", "").split(",")
        key = request.headers.get("Sec-WebSocket-Key", "")
        if not (
            request.version == HttpVersion11
            and SUBPROTOCOL in map(str.strip, subprotocols)
            and key.isascii()
            and socket.can_prepare(request)
            and not request.can_read_body
        ):
            raise web.HTTPForbidden(text=f"it must be a WebSocket of {SUBPROTOCOL}")
        self._sessions.add(socket)  # before the first await, so that the limit holds
        connection.upgrade()
        try:
            await socket.prepare(request)
            await bridge(
                socket,
                connection.address,
                self._daemon,
                field=self.field if "field" in request.query else None,
                turns=self._connections.turns,
            )
        finally:
            self._sessions.discard(socket)
            connection.end_websocket()
        return socket

    async def _end_sessions(self, _: web.Application) -> None:
        closing = [socket.close(code=WSCloseCode.SERVICE_RESTART) for socket in self._sessions]
        with contextlib.suppress(TimeoutError):  # a client may not read
            async with asyncio.timeout(_CLOSE_TIMEOUT):
                await asyncio.gather(*closing, return_exceptions=True)


async def _continue_later(_: web.Request) -> None:
    """Leave 100 Continue to `_body`: aiohttp would send it before the token is checked."""


def _method_that_silences(request: web.Request) -> str | None:
    """The method that a request names in its path, if that silences."""
    name = request.path.removeprefix("/api/v1/")
    return name if name in SILENCING and request.method != "OPTIONS" else None


def _check_media(request: web.Request) -> None:
    """Check the content type; raises web.HTTPException."""
    media = request.headers.get("Content-Type", "").partition(";")[0].strip().lower()
    if media != "application/json" and (media or request.body_exists):
        raise web.HTTPUnsupportedMediaType(text="the content type must be application/json")


async def _read_body(request: web.Request) -> bytes:
    """Read a request's body; raises web.HTTPException."""
    if (request.content_length or 0) > MAX_BODY:
        raise web.HTTPRequestEntityTooLarge(MAX_BODY)
    if request.headers.get("Expect", "").lower() == "100-continue":
        await request.writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
        request.writer.output_size = 0
    try:
        async with asyncio.timeout(CLIENT_TIMEOUT):
            return await request.read()
    except (TimeoutError, ConnectionError) as error:
        raise web.HTTPRequestTimeout(text="the body is not complete") from error


def _read_params(method: str, body: bytes) -> ApiMessage:
    """The parameters of a method from a body, by default an empty object; raises RpcError."""
    document = {"jsonrpc": "2.0", "method": method, "params": parse_json(body or b"{}")}
    return read_params(METHODS[method].params, request_of(document))


def _body_read(reading: "asyncio.Task[bytes]") -> object:
    """Return a request's body as parsed JSON; None if it was not read."""
    if not reading.done():
        return None
    try:
        return parse_json(reading.result())
    except Exception:  # not read, or not JSON; it is reported later
        return None


def _failure(problem: RpcError | Unreachable) -> web.Response:
    """The response for a request that failed."""
    error = RpcError(ErrorCode.LINK, str(problem)) if isinstance(problem, Unreachable) else problem
    failed = json.loads(error_line(None, error))["error"]
    return web.json_response(
        {"error": failed["message"], "code": failed["code"], "data": failed["data"]},
        status=HTTP_STATUS[error.code],
    )


async def serve(settings: GatewaySettings, *, announce: Callable[[int], None]) -> None:
    """Serve until SIGINT or SIGTERM; announce: called with the port. Raises InputError."""
    with contextlib.suppress(OSError):  # a service may be forbidden to
        os.nice(_NICENESS)
    allow_many_descriptors()
    gateway = Gateway(settings)
    listening = listening_socket(settings)
    failures = logging.getLogger(f"{__name__}.requests")
    failures.addFilter(_is_own_failure)
    runner = web.AppRunner(
        gateway.app,
        access_log=None,
        logger=failures,
        auto_decompress=False,  # no decompression bombs
        max_line_size=_MAX_LINE,
        max_field_size=_MAX_LINE,
        max_headers=_MAX_LINES,
        lingering_time=CLIENT_TIMEOUT,
        read_bufsize=1 << 12,  # bytes of a body that wait to be read
        keepalive_timeout=2 * CLIENT_TIMEOUT,  # the connection's comes first
        shutdown_timeout=_SHUTDOWN_TIMEOUT,
    )
    await runner.setup()
    assert runner.server is not None  # noqa: S101 (it is set up)
    over = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    # Runs forever: a failing part ends the process, which then reports the reason.
    own = asyncio.gather(gateway.field.run(), gateway.keep_connected())
    own.add_done_callback(lambda _: over.set())
    make_server = runner.server
    # asyncio accepts as many connections per iteration as its backlog holds.
    serving = await asyncio.get_running_loop().create_server(
        lambda: gateway.connection(make_server), sock=listening, backlog=_ACCEPTED
    )
    listening.listen(_QUEUE)
    announce(listening.getsockname()[1])
    with no_long_collections():  # only connections left by a request storm need collection
        await over.wait()
    await stop_accepting(serving)
    await runner.cleanup()
    own.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await own


def _is_own_failure(record: logging.LogRecord) -> bool:
    """Whether an error is not caused by a client that left or sends invalid HTTP."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, OSError | HttpProcessingError)


def listening_socket(settings: GatewaySettings) -> socket.socket:
    """Listen on a new socket; raises InputError."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listening = socket.create_server(
            (settings.host, settings.port),
            family=family,
            backlog=_QUEUE,
            dualstack_ipv6=family == socket.AF_INET6,
        )
    except OSError as error:
        raise InputError(
            f"cannot listen on {settings.host} port {settings.port} "
            f"({os.strerror(error.errno or 0)}); stop the other program or give another port "
            "(--listen; for a daemon --dashboard, or dashboard in its file)"
        ) from error
    return listening
