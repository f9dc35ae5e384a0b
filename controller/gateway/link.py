"""A connection to the daemon for one browser: lines of the API, passed on as they are."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Self

from controller.api.channel import connected_socket
from controller.api.client_protocol import RESPONSE_TIMEOUT, Unreachable, check_version

MAX_KEPT = 8  # connections of HTTP; the daemon has 32
_READ = 1 << 16  # bytes; read ahead, and the rest of a line that is incomplete


class DaemonLink:
    """A connection to the daemon in the name of a browser, made by `open`.

    hello: the daemon's reply to the hello of that name, a line without its line feed.
    """

    def __init__(
        self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.hello = b""
        self._path = path
        self._reader = reader
        self._writer = writer
        self._received = b""
        self._is_closed = False

    @classmethod
    async def open(cls, path: Path, name: str) -> Self:
        """Connect and introduce a browser by its name in the daemon's log; raises Unreachable."""
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):  # the daemon's queue may be full
                connected = await connected_socket(path)
        except TimeoutError as error:
            raise Unreachable.at(path, error) from error
        link = cls(path, *await asyncio.open_unix_connection(sock=connected))
        try:
            params = json.dumps({"client": name}).encode()
            link.hello = await link.request("hello", params, id=name)
            check_version(json.loads(link.hello).get("result"), path)
        except BaseException:
            link.abort()
            raise
        return link

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it."""
        is_lost = self._reader.at_eof() or self._reader.exception() is not None
        return not (self._is_closed or is_lost)

    async def request(self, method: str, params: bytes, *, id: str) -> bytes:
        """Send a request and wait for the next line, its response; raises Unreachable."""
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                await self.send(request_of(id, method, params))
                return await self.next_line()
        except TimeoutError as error:
            self.close()
            raise Unreachable.at(self._path, error) from error

    async def send(self, line: bytes) -> None:
        """Send a line, as soon as the daemon reads; raises Unreachable."""
        self.write(line)
        try:
            await self._writer.drain()
        except OSError as error:
            raise Unreachable.at(self._path, error) from error

    def write(self, line: bytes) -> None:
        """Send a line without waiting, even if it is the last before `close`."""
        self._writer.write(line + b"\n")

    async def next_line(self) -> bytes:
        """Wait for a line and return it without its line feed; raises Unreachable."""
        while b"\n" not in self._received:
            try:
                data = await self._reader.read(_READ)
            except OSError as error:
                raise Unreachable.at(self._path, error) from error
            if not data:
                raise Unreachable.at(self._path, ConnectionResetError("closed by the daemon"))
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        return line

    def close(self) -> None:
        """Close once the daemon has carried out what it was sent, at the latest after a while.

        For the daemon its client has left: its fingers are lifted, and it is not armed for.
        """
        self._is_closed = True
        self._writer.write_eof()
        asyncio.get_running_loop().call_later(RESPONSE_TIMEOUT, self.abort)

    def abort(self) -> None:
        """Close at once."""
        self._writer.transport.abort()


def request_of(id: str, method: str, params: bytes) -> bytes:
    """The line of a request, its parameters as they were received."""
    # Before the parameters, which are unread: a key that they repeat is refused.
    head = {"jsonrpc": "2.0", "id": id, "method": method}
    return json.dumps(head)[:-1].encode() + b',"params":' + params + b"}"


class HttpLinks:
    """Bounds the connections to the daemon of all HTTP connections, which has some for others."""

    def __init__(self) -> None:
        self._places = asyncio.Semaphore(MAX_KEPT)
        self._busy = 0
        self._idle: dict[KeptLink, None] = {}  # longest idle first

    @contextlib.asynccontextmanager
    async def place(self, kept: "KeptLink") -> AsyncIterator[None]:
        """Wait for a place for a request; whoever is idle longest loses its connection for it."""
        async with self._places:
            self._idle.pop(kept, None)
            self._busy += 1
            if self._busy + len(self._idle) > MAX_KEPT:
                next(iter(self._idle)).drop()
            try:
                yield
            finally:
                self._busy -= 1
                if kept.is_open:
                    self._idle[kept] = None

    def forget(self, kept: "KeptLink") -> None:
        """One has closed its connection."""
        self._idle.pop(kept, None)


class KeptLink:
    """The connection to the daemon that an HTTP connection keeps, from its first request on."""

    def __init__(self, links: HttpLinks) -> None:
        self._links = links
        self._link: DaemonLink | None = None
        self._is_over = False

    @property
    def is_open(self) -> bool:
        """Whether there is one now."""
        return self._link is not None and self._link.is_open

    async def request(self, path: Path, name: str, method: str, params: bytes) -> bytes:
        """Send a request of a client by its name, and return the response; raises Unreachable."""
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT), self._links.place(self):
                if self._link is None or not self._link.is_open:
                    self._link = await DaemonLink.open(path, name)
                if self._is_over:  # sent all the same
                    asyncio.get_running_loop().call_soon(self.drop)
                return await self._link.request(method, params, id=name)
        except TimeoutError as error:
            self.drop()
            raise Unreachable.at(path, error) from error

    def drop(self) -> None:
        """Close it; a further request opens another."""
        self._links.forget(self)
        if self._link is not None and self._link.is_open:
            self._link.close()

    def close(self) -> None:
        """Close it: the HTTP connection is over."""
        self._is_over = True
        self.drop()
