"""A client's connection to the daemon: lines of the API, passed on as they are."""

import asyncio
import socket
from pathlib import Path
from typing import Self

from controller.api.client_protocol import (
    RESPONSE_TIMEOUT,
    Unreachable,
    check_version,
    make_params,
    read_line,
    result_of,
)
from controller.api.jsonrpc import request_line
from controller.api.place import check_peer

_QUEUE_INTERVAL = 0.002  # s
_READ = 1 << 16  # bytes; read ahead, and the rest of a line that is incomplete


class DaemonLink:
    """A connection to the daemon in the name of a client, made by `open`.

    hello: the daemon's reply to the hello of that name, whose id it is; without its line feed.
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
        is_lost = self._reader.at_eof() or self._reader.exception() is not None
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
