"""One browser on a WebSocket: what it asks goes to the daemon, what happens comes back."""

import asyncio
import itertools
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

from starlette.websockets import WebSocket, WebSocketDisconnect

from controller.api.jsonrpc import (
    ErrorCode,
    Request,
    RpcError,
    error_line,
    read_params,
    read_request,
)
from controller.api.methods import METHODS, SubscribeParams, TouchParams, UnsubscribeParams
from controller.api.rate_limit import RateLimiter
from controller.api.schema import Empty, Message
from controller.gateway.outbox import Outbox
from controller.gateway.topics import OWN

REQUESTS_PER_SECOND = 200.0  # touches and stop are not counted
MOST_PENDING = 16
MOST_STOPPING = 4
MOST_TOUCH_SOURCES = 4  # of one session: a page has one
_LONGEST_NAME = 80  # characters; as the API has it
SEND_PATIENCE = 5.0  # s; for one frame to a reader that does not read

TRY_AGAIN_LATER, UNSUPPORTED_DATA = 1013, 1003  # close codes of RFC 6455 and its registry

_EVERY_ONE: frozenset[str] = frozenset({"state", "log", "link"})  # of the others only the newest
_numbers = itertools.count(1)
_logger = logging.getLogger(__name__)


class Daemon(Protocol):
    """What a session needs of the way to the daemon."""

    async def call(self, method: str, params: Message) -> dict[str, Any]:
        """Ask the daemon; raises RpcError."""


class Session:
    """A browser that was let in; see `run`.

    current: what subscribers of a topic are told at once, a frame for each that is so now.
    """

    def __init__(
        self,
        socket: WebSocket,
        daemon: Daemon,
        *,
        current: Callable[[str], str | bytes | None],
        clock: Callable[[], float],
    ) -> None:
        self.name = f"web:{next(_numbers)}"
        self.outbox = Outbox()
        self._socket = socket
        self._daemon = daemon
        self._current = current
        self._rate = RateLimiter(REQUESTS_PER_SECOND, clock=clock)
        self._topics: set[str] = set()
        self._pending: set[asyncio.Task[None]] = set()
        self._touches: dict[str, TouchParams] = {}  # the newest of each source, not yet told
        self._touching: set[str] = set()  # sources that have fingers down
        self._stopping = 0
        self._told: asyncio.Task[None] | None = None
        self._has_left = False

    async def run(self) -> None:
        """Serve until it leaves, or is to be left; its fingers are lifted then.

        What it has asked for by then is seen through: no stop is taken back.
        """
        sending = asyncio.create_task(self._send())
        receiving = asyncio.create_task(self._receive())
        try:
            await asyncio.wait({sending, receiving}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._has_left = True
            told = () if self._told is None else (self._told,)
            for task in (sending, receiving, *told):
                task.cancel()
            await self._end(sending, receiving, *told)
            await self._lift()
            await self._end(*self._pending)

    async def _end(self, *tasks: "asyncio.Task[None]") -> None:
        """Wait for the end of tasks, and tell of those that have failed."""
        for ended in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(ended, Exception):
                _logger.error("a session has failed", exc_info=ended)

    def tell(self, topic: str, frame: str | bytes) -> None:
        """What happened, if it wants to know."""
        if topic not in self._topics:
            return
        if topic in _EVERY_ONE:
            self.outbox.event(frame)
        else:
            self.outbox.state(topic, frame)

    async def _receive(self) -> None:
        """Take what it sends, until it leaves."""
        while True:
            said = await self._socket.receive()
            if said["type"] == "websocket.disconnect":
                return
            if said.get("text") is None:
                await self._socket.close(UNSUPPORTED_DATA, "send text frames")
                return
            self._take(said["text"])
            await asyncio.sleep(0)  # what waits already would be taken before anything else is done

    def _take(self, text: str) -> None:
        """Begin what was asked for, or say why not."""
        request: Request | None = None
        try:
            request = read_request(text.encode())
            if request.method == "touch":
                self._touch(request)
            elif request.method == "subscribe":
                self._subscribe(request)
            elif request.method == "unsubscribe":
                self._topics.difference_update(_topics(request, UnsubscribeParams))
                self._answer(request, {})
            else:
                self._ask(request)
        except RpcError as error:
            if request is None or request.wants_answer:
                self.outbox.answer(
                    error_line(None if request is None else request.id, error).decode()
                )

    def _subscribe(self, request: Request) -> None:
        topics = _topics(request, SubscribeParams)
        self._topics.update(topics)
        self._answer(request, {})
        for topic in sorted(topics):
            frame = self._current(topic)
            if frame is not None:
                self.tell(topic, frame)

    def _touch(self, request: Request) -> None:
        """Keep the newest frame of a source; one at a time is told to the daemon."""
        params = read_params(TouchParams, request)
        assert isinstance(params, TouchParams)  # noqa: S101 (read_params gives what it is given)
        params = told_apart(params, self.name)
        source = params.source
        known = self._touches.keys() | self._touching
        if source not in known and len(known) >= MOST_TOUCH_SOURCES:
            raise RpcError(ErrorCode.BUSY, "too many touch sources", remedy="use one or two")
        self._touches[source] = params
        self._answer(request, {})
        if self._told is None or self._told.done():
            self._told = asyncio.create_task(self._tell_touches())
            self._pending.add(self._told)
            self._told.add_done_callback(self._pending.discard)

    async def _tell_touches(self) -> None:
        """Tell the daemon the newest touches, until there are none newer."""
        while self._touches:
            source, params = next(iter(self._touches.items()))
            del self._touches[source]
            if params.touches:
                self._touching.add(source)
            else:
                self._touching.discard(source)
            try:
                await self._daemon.call("touch", params)
            except RpcError as error:
                self.outbox.state("touch-error", error_line(None, error).decode())

    async def _lift(self) -> None:
        """Lift its fingers; where the daemon does not hear it they are lifted after 150 ms."""
        for source in self._touching:
            try:
                await self._daemon.call("touch", TouchParams(source=source, touches=[]))
            except RpcError:
                return

    def _ask(self, request: Request) -> None:
        """Pass a request on; a stop always."""
        method = METHODS.get(request.method)
        if method is None:
            raise RpcError(
                ErrorCode.UNKNOWN_METHOD,
                f"there is no method {request.method!a}",
                remedy=f"known are {', '.join(METHODS)}",
            )
        params = read_params(method.params, request)
        if request.method == "stop":
            if self._stopping >= MOST_STOPPING:
                raise RpcError(
                    ErrorCode.BUSY, "stops are under way already", remedy="wait for their answers"
                )
            self._stopping += 1
        else:
            if not self._rate.take():
                raise RpcError(ErrorCode.BUSY, "too many requests", remedy="ask less often")
            if len(self._pending) >= MOST_PENDING:
                raise RpcError(
                    ErrorCode.BUSY, "too many requests under way", remedy="wait for answers"
                )
        task = asyncio.create_task(self._pass_on(request, params))
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)

    async def _pass_on(self, request: Request, params: Message) -> None:
        try:
            result = await self._daemon.call(request.method, params)
            if request.method == "arm" and self._has_left:  # nobody knows the lease
                await self._daemon.call("disarm", Empty())
        except RpcError as error:
            if request.wants_answer:
                self.outbox.answer(error_line(request.id, error).decode())
        else:
            self._answer(request, result)
        finally:
            self._stopping -= request.method == "stop"

    def _answer(self, request: Request, result: Mapping[str, Any]) -> None:
        if request.wants_answer:
            said = {"jsonrpc": "2.0", "id": request.id, "result": result}
            self.outbox.answer(json.dumps(said, separators=(",", ":")))

    async def _send(self) -> None:
        """Send what is to be sent, until it does not read."""
        try:
            while True:
                frame = await self.outbox.next()
                async with asyncio.timeout(SEND_PATIENCE):
                    if isinstance(frame, str):
                        await self._socket.send_text(frame)
                    else:
                        await self._socket.send_bytes(frame)
        except (TimeoutError, OverflowError, WebSocketDisconnect, RuntimeError):
            return


def told_apart(params: TouchParams, who: str) -> TouchParams:
    """Touches with whose they are in the name of their source: all go over one connection."""
    return params.model_copy(update={"source": f"{who}:{params.source}"[:_LONGEST_NAME]})


def _topics(request: Request, model: type[SubscribeParams | UnsubscribeParams]) -> set[str]:
    """The topics of a request, the gateway's own among them; raises RpcError."""
    said = request.params.get("topics")
    named = said if isinstance(said, list) else []
    own = OWN.intersection(topic for topic in named if isinstance(topic, str))
    if own:
        # `state` stands in for them, since the daemon's list must not be empty.
        others = ["state", *(topic for topic in named if topic not in own)]
        request = replace(request, params={**request.params, "topics": others})
    params = read_params(model, request)
    assert isinstance(params, model)  # noqa: S101 (read_params gives what it is given)
    stood_in = {"state"} if own and "state" not in named else set()
    return {*own, *params.topics} - stood_in
