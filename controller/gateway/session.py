"""One browser on a WebSocket: its requests go to the daemon, the daemon's events to it."""

import asyncio
import itertools
import json
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Annotated, Any, Literal

from pydantic import Field
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocket, WebSocketDisconnect

from controller.api.jsonrpc import (
    ErrorCode,
    Id,
    InvalidRequest,
    Request,
    RpcError,
    error_line,
    read_params,
    read_request,
    result_line,
    unknown_method,
)
from controller.api.methods import (
    METHODS,
    ArmParams,
    DisarmParams,
    HelloParams,
    RequestedBy,
    TouchParams,
)
from controller.api.rate_limit import RateLimiter
from controller.api.schema import MAX_RATE, Message, Topic
from controller.api.waiting_touches import add_frame
from controller.gateway.daemon_link import DaemonLink
from controller.gateway.outbox import Outbox

MAX_REQUEST_RATE = 200.0  # 1/s; touches and stops are not counted
MAX_PENDING = 16
MAX_PENDING_STOPS = 64  # above it no further frame is read
MAX_TOUCH_SOURCES = 4  # a page has one
SEND_TIMEOUT = 5.0  # s; for one frame
_MAX_NAME = 80  # characters; as in the API
_ITERATIONS = 10  # of the event loop, in which the end of a connection is received

TRY_AGAIN_LATER, UNSUPPORTED_DATA = 1013, 1003  # close codes of RFC 6455 and its registry

# Of other topics the latest alone.
_ALL_SENT: frozenset[str] = frozenset({"state", "log", "link", "plate"})
_BUSY = RpcError(ErrorCode.BUSY, "too many requests", remedy="send fewer per second")
_session_numbers = itertools.count(1)
_logger = logging.getLogger(__name__)

_Topics = Annotated[list[Literal[Topic, "hello", "field"]], Field(min_length=1, max_length=16)]


class SessionTopics(Message):
    """Topics of the daemon or the gateway; the gateway has one rate for all browsers."""

    topics: _Topics
    rate_hz: Annotated[float, Field(ge=1, le=MAX_RATE)] | None = None


class Session:
    """An accepted WebSocket; see `run`.

    current: the current frame of a topic, sent on subscription, or None.
    """

    def __init__(
        self,
        socket: WebSocket,
        daemon: DaemonLink,
        *,
        current: Callable[[str], str | bytes | None],
        clock: Callable[[], float],
    ) -> None:
        self.name = f"web:{next(_session_numbers)}"
        self._client = name_client(self.name, socket)
        self.outbox = Outbox()
        self._socket = socket
        self._daemon = daemon
        self._current = current
        self._rate = RateLimiter(MAX_REQUEST_RATE, clock=clock)
        self._topics: set[str] = set()
        self._pending: set[asyncio.Task[None]] = set()
        self._pending_stops: set[asyncio.Task[None]] = set()
        self._touches: dict[str, list[TouchParams]] = {}  # frames of each source, to be sent
        self._touching: set[str] = set()  # sources with fingers on the plate
        self._touch_task: asyncio.Task[None] | None = None
        self._is_closed = False

    async def run(self) -> None:
        """Serve until either side closes, then lift its fingers.

        Requests received by then are carried out: no stop is cancelled.
        """
        sending = asyncio.create_task(self._send())
        receiving = asyncio.create_task(self._receive())
        try:
            await asyncio.wait({sending, receiving}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._is_closed = True
            tasks = [task for task in (sending, receiving, self._touch_task) if task is not None]
            for task in tasks:
                task.cancel()
            await self._finish(*tasks)
            await self._lift()
            await self._finish(*self._pending)

    async def _finish(self, *tasks: "asyncio.Task[None]") -> None:
        """Wait for tasks, and log those that failed."""
        for result in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(result, Exception):
                _logger.error("session failed", exc_info=result)

    def publish(self, topic: str, frame: str | bytes) -> None:
        """Send a frame of a topic, if subscribed."""
        if topic not in self._topics:
            return
        if topic in _ALL_SENT:
            self.outbox.event(frame)
        else:
            self.outbox.state(topic, frame)

    async def _send(self) -> None:
        """Send frames until the browser does not read them."""
        try:
            while True:
                frame = await self.outbox.next()
                async with asyncio.timeout(SEND_TIMEOUT):
                    if isinstance(frame, str):
                        await self._socket.send_text(frame)
                    else:
                        await self._socket.send_bytes(frame)
        except (TimeoutError, OverflowError, WebSocketDisconnect, RuntimeError):
            return

    async def _receive(self) -> None:
        """Serve requests until the browser disconnects."""
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                self._is_closed = True
                return
            if message.get("text") is None:
                await self._socket.close(UNSUPPORTED_DATA, "send text frames")
                return
            self._serve(message["text"])
            await asyncio.sleep(0)  # let others run between queued messages
            while len(self._pending_stops) >= MAX_PENDING_STOPS:
                await asyncio.wait(self._pending_stops, return_when=asyncio.FIRST_COMPLETED)

    def _serve(self, text: str) -> None:
        """Serve one request, or start to."""
        request: Request | None = None
        try:
            request = read_request(text.encode())
            if request.method not in ("touch", "stop") and not self._rate.take():
                raise _BUSY
            match request.method:
                case "touch":
                    self._touch(request)
                case "subscribe":
                    self._subscribe(request)
                case "unsubscribe":
                    self._topics.difference_update(_topics(request))
                    self._respond(request, {})
                case _:
                    self._forward(request)
        except InvalidRequest as error:
            self._rate.take()
            self._respond_error(error.id, error)
        except RpcError as error:
            if request is not None and request.expects_response:
                self._respond_error(request.id, error)

    def _subscribe(self, request: Request) -> None:
        topics = _topics(request)
        self._topics.update(topics)
        self._respond(request, {})
        for topic in sorted(topics):
            frame = self._current(topic)
            if frame is not None:
                self.publish(topic, frame)

    def _touch(self, request: Request) -> None:
        """Keep the frames of a source that count; one at a time is sent to the daemon."""
        params = touch_params(request, self.name)
        sources = self._touches.keys() | self._touching
        if params.source not in sources and len(sources) >= MAX_TOUCH_SOURCES:
            raise RpcError(ErrorCode.BUSY, "too many touch sources", remedy="use one or two")
        add_frame(self._touches.setdefault(params.source, []), params)
        self._respond(request, {})
        if self._touch_task is None or self._touch_task.done():
            self._touch_task = self._start(self._send_touches())

    async def _send_touches(self) -> None:
        """Send frames to the daemon until none is left."""
        while self._touches:
            source = next(iter(self._touches))
            waiting = self._touches.pop(source)
            params = waiting.pop(0)
            if waiting:
                self._touches[source] = waiting
            if params.touches:
                self._touching.add(source)
            else:
                self._touching.discard(source)
            try:
                await self._daemon.call("touch", params)
            except RpcError as error:
                self.outbox.state("touch-error", error_line(None, error).decode())

    async def _lift(self) -> None:
        """Lift the browser's fingers; if that fails, the daemon lifts them after 150 ms."""
        for source in self._touching:
            try:
                await self._daemon.call("touch", TouchParams(source=source, touches=[]))
            except RpcError:
                return

    def _forward(self, request: Request) -> None:
        """Forward a request to the daemon, in the name of this browser."""
        method = METHODS.get(request.method)
        if method is None:
            raise unknown_method(request.method, METHODS)
        params = in_name_of(self._client, read_params(method.params, request))
        if isinstance(params, HelloParams):
            self._client = name_client(f"{params.client[:30]}, {self.name}", self._socket)
        if request.method == "arm" and not request.expects_response:
            return  # without a response the browser has no lease to renew or end
        if request.method != "stop" and len(self._pending) >= MAX_PENDING:
            raise RpcError(ErrorCode.BUSY, "too many pending requests", remedy="await responses")
        task = self._start(self._complete(request, params))
        if request.method == "stop":
            self._pending_stops.add(task)
            task.add_done_callback(self._pending_stops.discard)

    async def _complete(self, request: Request, params: Message) -> None:
        try:
            if isinstance(params, ArmParams):
                result = await arm_for(self._daemon, params, has_left=self._has_left)
            else:
                result = await self._daemon.call(request.method, params)
        except RpcError as error:
            if request.expects_response:
                self._respond_error(request.id, error)
        else:
            self._respond(request, result)

    async def _has_left(self) -> bool:
        return self._is_closed

    def _start(self, work: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        task = asyncio.create_task(work)
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)
        return task

    def _respond(self, request: Request, result: object) -> None:
        if request.expects_response:
            self.outbox.respond(result_line(request.id, json.dumps(result)).decode())

    def _respond_error(self, id: Id, error: RpcError) -> None:
        self.outbox.respond(error_line(id, error).decode())


def touch_params(request: Request, client: str) -> TouchParams:
    """A touch frame, its source prefixed by the client: all share one connection to the daemon."""
    params = read_params(TouchParams, request)
    return params.model_copy(update={"source": f"{client}:{params.source}"[:_MAX_NAME]})


def name_client(name: str, connection: HTTPConnection) -> str:
    """A client's name for the daemon's log, with its address."""
    address = connection.client
    return name if address is None else f"{name} {address.host}:{address.port}"[:_MAX_NAME]


def in_name_of(client: str, params: Message) -> Message:
    """Parameters with the client that requests it, for the daemon's log."""
    if isinstance(params, RequestedBy):
        return params.model_copy(update={"client": client})
    if isinstance(params, ArmParams):
        owner = f"{params.owner[: _MAX_NAME - len(client) - 3]} ({client})"
        return params.model_copy(update={"owner": owner})
    return params


async def arm_for(
    daemon: DaemonLink, params: ArmParams, *, has_left: Callable[[], Awaitable[bool]]
) -> Any:
    """Arm for a client unless it has left, and disarm if it leaves meanwhile; raises RpcError."""
    for _ in range(_ITERATIONS):
        await asyncio.sleep(0)
    if await has_left():
        raise RpcError(ErrorCode.LEASE, "the client has left", remedy="stay to renew the lease")
    result = await daemon.call("arm", params)
    if await has_left():  # the lease can no longer be renewed
        await daemon.call("disarm", DisarmParams(lease=result["lease"]))
    return result


def _topics(request: Request) -> set[str]:
    return set(read_params(SessionTopics, request).topics)
