"""An HTTP server for one page on the loopback, bounded in connections, bytes and time."""

import asyncio
import re
from collections.abc import Awaitable, Callable
from http import HTTPStatus

MAX_CONNECTIONS = 8
_TIMEOUT = 5.0  # s; of a connection, from its start to the last byte of the response
_MAX_REQUEST = 8192  # bytes
_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")


class PageServer:
    """Serves one page to GET requests with a Host on the loopback, which stops DNS rebinding.

    page: returns its content; it may be called by several connections at a time. Of too many
    connections the oldest is closed.
    """

    def __init__(self, path: str, page: Callable[[], Awaitable[bytes]], *, content: str) -> None:
        self._path = path
        self._page = page
        self._content = content
        self._open: dict[asyncio.StreamWriter, None] = {}  # oldest first

    async def start(self, port: int) -> asyncio.Server:
        """Listen on a port of 127.0.0.1; raises OSError."""
        return await asyncio.start_server(self._serve, "127.0.0.1", port, limit=_MAX_REQUEST)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._open) >= MAX_CONNECTIONS:
            next(iter(self._open)).transport.abort()
        self._open[writer] = None
        try:
            async with asyncio.timeout(_TIMEOUT):
                request = await reader.readuntil(b"\r\n\r\n")
                status, body = await self._respond(request.decode("latin-1"))
                head = (
                    f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {self._content}\r\n"
                    f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
                )
                writer.write(head.encode() + body)
                await writer.drain()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            writer.transport.abort()
        finally:
            self._open.pop(writer, None)
            writer.close()

    async def _respond(self, request: str) -> tuple[HTTPStatus, bytes]:
        """Return status and body for the head of a request."""
        first, *headers = request.splitlines()
        method, _, rest = first.partition(" ")
        hosts = [line[5:].strip() for line in headers if line.lower().startswith("host:")]
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return HTTPStatus.MISDIRECTED_REQUEST, b"Host must be on the loopback\n"
        if method != "GET":
            return HTTPStatus.METHOD_NOT_ALLOWED, b""
        if rest.partition(" ")[0].partition("?")[0] != self._path:
            return HTTPStatus.NOT_FOUND, f"see {self._path}\n".encode()
        return HTTPStatus.OK, await self._page()
