"""A client's connection to the daemon: lines, passed on as they are, or calls over them."""

import asyncio
import itertools
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from controller.api.client_protocol import (
    RESPONSE_TIMEOUT,
    Notification,
    Unreachable,
    check_version,
    make_params,
    read_line,
    result_of,
)
from controller.api.jsonrpc import request_line
from controller.api.place import check_peer
from controller.api.schema import Message

_QUEUE_INTERVAL = 0.002  # s
_READ = 1 << 16  # bytes; read ahead, and the rest of a line that is incomplete


class DaemonLink:
    """A connection to the daemon in the name of a client, made by `open`.

    Its lines are for who awaits `next_line`, or for any number of calls and events once it is
    followed. hello: the daemon's reply to the hello of that name, whose id it is; without its line
    feed.
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
        self._lost: Unreachable | None = None
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._ids = itertools.count(1)

    @classmethod
    async def open(cls, path: Path, name: str) -> Self:
        """Connect, check the peer, and introduce a client by its name in the daemon's log.

        Raises InputError for the name, RpcError and Unreachable.
        """
        params = make_params("hello", client=name).model_dump_json()
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):  # the daemon's queue may be full
                connected = await connected_socket(path)
        except TimeoutError as error:
            raise Unreachable.at(path, error) from error
        link = cls(path, *await asyncio.open_unix_connection(sock=connected))
        try:
            link.hello = await link.request("hello", params.encode(), id=name)
            check_version(result_of(read_line(link.hello)), path)
        except BaseException:
            link.abort()
            raise
        return link

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it."""
        is_lost = self._reader.at_eof() or self._reader.exception() or self._lost
        return not (self._is_closed or is_lost)

    async def request(self, method: str, params: bytes, *, id: str) -> bytes:
        """Send a request and wait for the next line, its response; raises Unreachable."""
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                await self.send(request_line(id, method, params))
                return await self.next_line()
        except TimeoutError as error:
            self.close()
            raise Unreachable.at(self._path, error) from error

    async def send(self, line: bytes) -> None:
        """Send a line with its line feed, as soon as the daemon reads; raises Unreachable."""
        self.write(line)
        try:
            await self._writer.drain()
        except OSError as error:
            raise Unreachable.at(self._path, error) from error

    def write(self, line: bytes) -> None:
        """Send a line with its line feed without waiting, even the last one before `close`."""
        self._writer.write(line)

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

    async def call(self, method: str, params: Message) -> Any:
        """Call a method and return its result as parsed JSON, while it is followed.

        Raises RpcError and Unreachable.
        """
        if self._lost is not None:
            raise self._lost.with_traceback(None)
        id = next(self._ids)
        response = self._pending[id] = asyncio.get_running_loop().create_future()
        try:
            content = params.model_dump_json(exclude_none=True)
            self.write(request_line(id, method, content.encode()))
            return result_of(await response)
        finally:
            del self._pending[id]

    async def follow(self, on_event: Callable[[Notification], None]) -> None:
        """Hand out responses and notifications until it is lost; then fail all pending calls."""
        try:
            while True:
                received = read_line(await self.next_line())
                if isinstance(received, Notification):
                    on_event(received)
                    continue
                for id, pending in self._pending.items():  # without an id, of all of them
                    if received["id"] in (id, None) and not pending.done():
                        pending.set_result(received)
        except Unreachable as error:
            self._lost = error
            self.abort()
            for pending in self._pending.values():
                if not pending.done():
                    pending.set_exception(error)

    def close(self) -> None:
        """Close once the daemon has carried out what it was sent, at the latest after a while.

        For the daemon its client has left: its fingers are lifted, and it is not armed for.
        """
        self._is_closed = True
        self._writer.write_eof()
        asyncio.get_running_loop().call_later(RESPONSE_TIMEOUT, self.abort)

    def abort(self) -> None:
        """Close at once; the daemon lifts this client's fingers."""
        self._is_closed = True
        self._writer.transport.abort()


async def connected_socket(path: Path) -> socket.socket:
    """Connect to a daemon that is to be believed, however full its queue; raises Unreachable.

    asyncio would take a full queue for a connection in progress.
    """
    connecting = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connecting.setblocking(False)
    try:
        while True:
            try:
                connecting.connect(str(path))
            except BlockingIOError:
                await asyncio.sleep(_QUEUE_INTERVAL)
            else:
                check_peer(path, connecting)
                return connecting
    except BaseException as error:
        connecting.close()
        if isinstance(error, OSError) and not isinstance(error, Unreachable):
            raise Unreachable.at(path, error) from error
        raise
