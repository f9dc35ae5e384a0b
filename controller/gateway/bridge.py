"""The bridge between a browser's WebSocket and the daemon: it passes on lines of the API.

Frames that silence are passed on before all others, even if they are invalid or the browser has
left.
"""

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http import WSMessageNoDecodeText

from controller.api.jsonrpc import RpcError, request_line
from controller.api.link import DaemonLink, Unreachable
from controller.api.silencing import read_silencing
from controller.gateway.field import DrawnField
from controller.gateway.turns import Turns

BrowserSocket: TypeAlias = "web.WebSocketResponse[Literal[False]]"
"""A WebSocket whose frames of text are bytes."""

MAX_FRAME = 1 << 16  # bytes
MAX_READ_FRAME = 1 << 20  # bytes; a longer frame than MAX_FRAME is rejected, unless it silences
SEND_TIMEOUT = 5.0  # s; for one frame
NO_DAEMON = 4001  # close code for private use; the page then reconnects

_NEXT_FRAME_TIMEOUT = 0.1  # s; for the next frame of a browser whose bridge ends
_LAST_FRAMES_TIMEOUT = 1.0  # s; for all frames of such a browser
_TYPES_WITH_CONTENT = (WSMsgType.TEXT, WSMsgType.BINARY)

_browser_numbers = itertools.count(1)


async def bridge(
    socket: BrowserSocket,
    client: str,
    daemon: Path,
    field: DrawnField | None,
    turns: Turns,
) -> None:
    """Pass frames and lines on until the browser or the daemon closes its connection.

    client: address of the browser; daemon: its socket; field: vibration to be sent as pictures,
    None for none; turns: of frames that do not silence.
    The first frame that the browser gets is the daemon's reply to a hello, whose id is the
    browser's name in the daemon's log. When the browser leaves, the daemon carries out all
    earlier requests, and lifts the browser's fingers.
    """
    try:
        link = await DaemonLink.open(daemon, f"web:{next(_browser_numbers)} {client}")
        with contextlib.closing(link):
            try:
                await socket.send_str(link.hello.decode())
                await _pass_on(socket, link, field, turns)
            finally:
                await _pass_on_last_silencing(socket, link)
    except* (RpcError, Unreachable):
        await socket.close(code=NO_DAEMON, message=b"the daemon does not respond")
    except* (TimeoutError, ConnectionError):
        pass  # the browser has closed its connection, or does not read


async def _pass_on(
    socket: BrowserSocket, link: DaemonLink, field: DrawnField | None, turns: Turns
) -> None:
    """Pass frames, lines and pictures on; ends with the exception of the first that fails."""
    send_text = partial(socket.send_frame, opcode=WSMsgType.TEXT)
    async with asyncio.TaskGroup() as directions:
        directions.create_task(_to_daemon(socket, link, turns))
        directions.create_task(_to_browser(link.next_line, send_text))
        if field is not None:
            next_picture = field.frames().__anext__
            directions.create_task(_to_browser(next_picture, socket.send_bytes))


async def _to_daemon(socket: BrowserSocket, link: DaemonLink, turns: Turns) -> None:
    """Pass the browser's frames on; raises ConnectionResetError after the last one."""
    async for message in socket:
        frame = _content(message)
        if read_silencing(frame) is None:
            await turns.take()
        close_code = _rejection(message.type, frame)
        if close_code is None:
            await link.send(frame + b"\n")
        else:
            _send_if_silencing(frame, link)
            reason = b"send text frames of one line, in UTF-8 and of 64 KiB at most"
            await socket.close(code=close_code, message=reason)  # no effect if it was closed
    await socket.close(drain=False)
    raise ConnectionResetError


def _content(message: WSMessageNoDecodeText) -> bytes:
    """The content of a frame of text or binary data, nothing of other frames."""
    return message.data if message.type in _TYPES_WITH_CONTENT else b""


def _rejection(kind: WSMsgType, frame: bytes) -> WSCloseCode | None:
    """The close code with which a frame is rejected; None if it is one line of text."""
    if len(frame) > MAX_FRAME:
        return WSCloseCode.MESSAGE_TOO_BIG
    if kind is not WSMsgType.TEXT or b"\n" in frame:
        return WSCloseCode.UNSUPPORTED_DATA
    try:
        frame.decode()
    except UnicodeDecodeError:
        return WSCloseCode.INVALID_TEXT
    return None


def _send_if_silencing(frame: bytes, link: DaemonLink) -> None:
    """Send the daemon the request of a frame that silences, in a form that it certainly reads."""
    request = read_silencing(frame)
    if request is not None and link.is_open:
        params = request.params.model_dump_json(exclude_none=True).encode()
        link.write(request_line(None, request.method, params))


async def _pass_on_last_silencing(socket: BrowserSocket, link: DaemonLink) -> None:
    """Send the daemon the requests that silence of frames that wait when the bridge ends."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + _LAST_FRAMES_TIMEOUT
    with contextlib.suppress(TimeoutError):  # no further frame waits
        async with asyncio.timeout(_NEXT_FRAME_TIMEOUT) as limit:
            async for message in socket:
                _send_if_silencing(_content(message), link)
                await asyncio.sleep(0)
                limit.reschedule(min(deadline, loop.time() + _NEXT_FRAME_TIMEOUT))


async def _to_browser(
    take: Callable[[], Awaitable[bytes]], send: Callable[[bytes], Awaitable[None]]
) -> None:
    """Pass the daemon's lines, or pictures, on; raises TimeoutError if nothing reads them."""
    while True:
        message = await take()
        async with asyncio.timeout(SEND_TIMEOUT):
            await send(message)
        # The event loop notices here that the browser has left, before the next line is sent.
        await asyncio.sleep(0)
