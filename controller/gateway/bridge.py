"""Clients' connections to the daemon: of a browser on a WebSocket, and those that HTTP keeps.

On a WebSocket frames are lines of the API to the daemon, and the other way.
"""

import asyncio
import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path

from starlette.requests import HTTPConnection
from starlette.websockets import WebSocket, WebSocketDisconnect

from controller.api.client_protocol import Unreachable
from controller.api.jsonrpc import ErrorCode, RpcError, read_request
from controller.api.link import DaemonLink
from controller.api.methods import SILENCING
from controller.gateway.field import DrawnField

SEND_TIMEOUT = 5.0  # s; for one frame
_LAST_FRAMES = 0.1  # s; for those that a browser which is given up has sent
_MAX_NAME = 80  # characters; as in the API

UNSUPPORTED_DATA = 1003  # close code of RFC 6455
NO_DAEMON = 4001  # one of those for private use; the page connects again

_numbers = itertools.count(1)


async def bridge(socket: WebSocket, daemon: Path, field: DrawnField) -> None:
    """Pass frames and lines on until the browser or the daemon at a socket closes.

    The first frame is the daemon's reply to a hello, whose id is the browser's name in the daemon's
    log. The daemon carries out what it was sent before the browser left, and lifts its fingers.
    """
    try:
        link = await DaemonLink.open(daemon, client_name(f"web:{next(_numbers)}", socket))
        with contextlib.closing(link):
            try:
                await socket.send_text(link.hello.decode())
                async with asyncio.TaskGroup() as ways:
                    ways.create_task(_to_daemon(socket, link))
                    ways.create_task(_to_browser(socket, link))
                    if "field" in socket.query_params:
                        ways.create_task(_draw(socket, field))
            finally:
                await _silence(socket, link)
    except* (RpcError, Unreachable):
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # closed already
            await socket.close(NO_DAEMON, "the daemon does not respond")
    except* (TimeoutError, RuntimeError, WebSocketDisconnect):
        pass  # closed, or does not read


async def _to_daemon(socket: WebSocket, link: DaemonLink) -> None:
    """Pass the browser's frames on; raises WebSocketDisconnect."""
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message["code"])
        text = message.get("text")
        if text is None or "\n" in text:
            await socket.close(UNSUPPORTED_DATA, "send text frames of one line")
            raise WebSocketDisconnect(UNSUPPORTED_DATA)
        await link.send(text.encode() + b"\n")


async def _silence(socket: WebSocket, link: DaemonLink) -> None:
    """Send the daemon what may silence of the frames that still wait, whoever else is at an end."""
    with contextlib.suppress(RuntimeError, TimeoutError):  # it has left, or there is no further one
        async with asyncio.timeout(_LAST_FRAMES):
            while link.is_open:
                text = (await socket.receive()).get("text") or ""
                line = text.encode()
                if b"\n" not in line and _method_of(line) in SILENCING:
                    link.write(line + b"\n")


def _method_of(line: bytes) -> str:
    try:
        return read_request(line).method
    except RpcError:
        return ""


async def _to_browser(socket: WebSocket, link: DaemonLink) -> None:
    """Pass the daemon's lines on; raises Unreachable, and TimeoutError if one is not read."""
    while True:
        line = await link.next_line()
        async with asyncio.timeout(SEND_TIMEOUT):
            await socket.send_text(line.decode())
        await asyncio.sleep(0)  # of lines that came together none goes to a browser that has left


async def _draw(socket: WebSocket, field: DrawnField) -> None:
    """Send the plate's vibration, now and whenever it changes."""
    frame = None
    while True:
        frame = await field.newer_than(frame)
        async with asyncio.timeout(SEND_TIMEOUT):
            await socket.send_bytes(frame)


def client_name(name: str, connection: HTTPConnection) -> str:
    """A client's name for the daemon's log, with its address."""
    address = connection.client
    return name if address is None else f"{name} {address.host}:{address.port}"[:_MAX_NAME]


MAX_KEPT = 8  # connections; the daemon has 32


class KeptLink:
    """The connection to the daemon that an HTTP connection keeps, from its first request on.

    kept: those of all HTTP connections, which leave places of the daemon to others.
    """

    def __init__(self, kept: "set[KeptLink]") -> None:
        self._kept = kept
        self._link: DaemonLink | None = None
        self._is_over = False

    @property
    def is_open(self) -> bool:
        """Whether there is one now."""
        return self._link is not None and self._link.is_open

    async def request(
        self, path: Path, name: str, method: str, params: bytes, *, may_open: Callable[[], bool]
    ) -> bytes:
        """Send a request of a client by its name, and return the response.

        may_open: whether a connection may be opened now, which counts it; called only where it has
        a place. Raises RpcError and Unreachable.
        """
        try:
            if self._link is None or not self._link.is_open:
                if len(self._kept - {self}) >= MAX_KEPT or not may_open():
                    raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
                self._kept.add(self)
                self._link = await DaemonLink.open(path, name)
            if self._is_over:  # sent all the same
                asyncio.get_running_loop().call_soon(self.close)
            return await self._link.request(method, params, id=name)
        finally:
            if not self.is_open:
                self._kept.discard(self)

    def close(self) -> None:
        """Close it: the HTTP connection is over."""
        self._is_over = True
        if self._link is None:  # it may be on its way to the daemon, and has its place until then
            return
        self._kept.discard(self)
        if self._link.is_open:
            self._link.close()
