"""Clients' connections to the daemon: of a browser on a WebSocket, and those that HTTP keeps.

On a WebSocket frames are lines of the API to the daemon, and the other way.
"""

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from aiohttp import WSCloseCode, WSMsgType, web

from controller.api.jsonrpc import ErrorCode, RpcError, read_request
from controller.api.link import DaemonLink, Unreachable
from controller.api.registered import SILENCING
from controller.gateway.field import DrawnField

SEND_TIMEOUT = 5.0  # s; for one frame
_LAST_FRAME, _LAST_FRAMES = 0.1, 1.0  # s; for the next frame of a browser which is given up, for
# all of them

_INVALID_CODES = (WSCloseCode.ABNORMAL_CLOSURE, *range(5000, 1 << 16))  # of those that aiohttp
# takes; RFC 6455 7.4: the first is never sent, and the others are not defined
NO_DAEMON = 4001  # one of those for private use; the page connects again

_numbers = itertools.count(1)


async def bridge(
    socket: web.WebSocketResponse, client: str, daemon: Path, field: DrawnField | None
) -> None:
    """Pass frames and lines on until the browser or the daemon at a socket closes.

    client: the address of the browser; field: None unless it wants the vibration.
    The first frame is the daemon's reply to a hello, whose id is the browser's name in the daemon's
    log. The daemon carries out what it was sent before the browser left, and lifts its fingers.
    """
    try:
        link = await DaemonLink.open(daemon, f"web:{next(_numbers)} {client}")
        with contextlib.closing(link):
            try:
                await socket.send_str(link.hello.decode())
                async with asyncio.TaskGroup() as ways:
                    ways.create_task(_to_daemon(socket, link))
                    ways.create_task(
                        _to_browser(
                            link.next_line, partial(socket.send_frame, opcode=WSMsgType.TEXT)
                        )
                    )
                    if field is not None:
                        ways.create_task(_to_browser(field.frames().__anext__, socket.send_bytes))
            finally:
                await _silence(socket, link)
    except* (RpcError, Unreachable):
        await socket.close(code=NO_DAEMON, message=b"the daemon does not respond")
    except* (TimeoutError, ConnectionError):
        pass  # closed, or does not read


async def _to_daemon(socket: web.WebSocketResponse, link: DaemonLink) -> None:
    """Pass the browser's frames on; raises ConnectionResetError at their end."""
    async for message in socket:
        if message.type is WSMsgType.TEXT and "\n" not in message.data:
            await link.send(message.data.encode() + b"\n")
        else:  # without effect on one that is closed for an invalid frame
            await socket.close(
                code=WSCloseCode.UNSUPPORTED_DATA, message=b"send text frames of one line"
            )
        await asyncio.sleep(0)  # between two of those that wait others are served
    is_invalid = socket.close_code in _INVALID_CODES
    await socket.close(
        code=WSCloseCode.PROTOCOL_ERROR if is_invalid else WSCloseCode.OK, drain=False
    )
    raise ConnectionResetError


async def _silence(socket: web.WebSocketResponse, link: DaemonLink) -> None:
    """Send the daemon what may silence of the frames that still wait, whoever else is at an end."""
    loop = asyncio.get_running_loop()
    end = loop.time() + _LAST_FRAMES
    with contextlib.suppress(TimeoutError):  # there is no further one
        async with asyncio.timeout(_LAST_FRAME) as limit:
            async for message in socket:
                line = message.data.encode() if message.type is WSMsgType.TEXT else b""
                with contextlib.suppress(RpcError):
                    is_whole = link.is_open and b"\n" not in line
                    if is_whole and read_request(line).method in SILENCING:
                        link.write(line + b"\n")
                await asyncio.sleep(0)
                limit.reschedule(min(end, loop.time() + _LAST_FRAME))


async def _to_browser(
    take: Callable[[], Awaitable[bytes]], send: Callable[[bytes], Awaitable[None]]
) -> None:
    """Pass the daemon's lines, or pictures, on; raises TimeoutError if one is not read."""
    while True:
        message = await take()
        async with asyncio.timeout(SEND_TIMEOUT):
            await send(message)
        await asyncio.sleep(0)  # of lines that came together none goes to a browser that has left


MAX_KEPT = 8  # connections; the daemon has 32


@dataclass(eq=False)
class KeptLink:
    """The connection to the daemon that an HTTP connection keeps, from its first request on.

    kept: those of all HTTP connections, which leave places of the daemon to others.
    """

    kept: "set[KeptLink]"
    _link: DaemonLink | None = None
    _is_over: bool = False

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
                if len(self.kept - {self}) >= MAX_KEPT or not may_open():
                    raise RpcError(ErrorCode.BUSY, "too many connections", remedy="keep one open")
                self.kept.add(self)
                self._link = await DaemonLink.open(path, name)
            if self._is_over:  # sent all the same
                asyncio.get_running_loop().call_soon(self.close)
            return await self._link.request(method, params, id=name)
        finally:
            if not self.is_open:
                self.kept.discard(self)

    def close(self) -> None:
        """Close it: the HTTP connection is over."""
        self._is_over = True
        if self._link is not None:  # else it may be on its way, and has its place until then
            self.kept.discard(self)
            if self._link.is_open:
                self._link.close()
