"""One connection of a client to the daemon: requests, their responses, and notifications."""

import asyncio
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self, cast

from controller.api.client_protocol import (
    Notification,
    Unreachable,
    check_version,
    make_params,
    read_line,
    result_of,
)
from controller.api.jsonrpc import request_line
from controller.api.peer import check_peer
from controller.api.schema import Message

_QUEUE_INTERVAL = 0.002  # s


class Channel(asyncio.Protocol):
    """A connection, made by `open`; any number of requests may be pending.

    lost: None while it is open.
    """

    def __init__(
        self,
        path: Path,
        *,
        on_event: Callable[[Notification], None],
        on_lost: Callable[[], object],
    ) -> None:
        self.path = path
        self.lost: Unreachable | None = None
        self._on_event = on_event
        self._on_lost = on_lost
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._last_id = 0
        self._rest = b""
        self._transport: asyncio.Transport | None = None

    @classmethod
    async def open(
        cls,
        path: Path,
        *,
        name: str,
        on_event: Callable[[Notification], None],
        on_lost: Callable[[], object],
    ) -> Self:
        """Connect, check the peer, and introduce this client; raises RpcError and Unreachable."""
        params = make_params("hello", client=name)
        channel = cls(path, on_event=on_event, on_lost=on_lost)
        try:
            await channel._connect()
            check_version(await channel.request("hello", params), path)
        except BaseException:
            channel.close()
            raise
        return channel

    async def _connect(self) -> None:
        connected = await connected_socket(self.path)
        loop = asyncio.get_running_loop()
        await loop.create_unix_connection(lambda: self, sock=connected)

    async def request(self, method: str, params: Message) -> Any:
        """Call a method and return its result as parsed JSON; raises RpcError and Unreachable."""
        assert self._transport is not None  # noqa: S101  `open` connects
        if self.lost is not None:
            raise self.lost.with_traceback(None)
        self._last_id += 1
        id = self._last_id
        response = self._pending[id] = asyncio.get_running_loop().create_future()
        try:
            self._transport.write(request_line(id, method, params))
            return result_of(await response)
        finally:
            del self._pending[id]

    def close(self) -> None:
        """Close at once; the daemon lifts this client's fingers."""
        if self._transport is not None:
            self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport."""
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        """Hand out complete responses and notifications."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            try:
                received = read_line(line)
            except Unreachable as error:
                self._lose(error)
                self.close()
                return
            if isinstance(received, Notification):
                self._on_event(received)
            else:
                self._resolve(received)

    def connection_lost(self, error: Exception | None) -> None:
        """Fail all pending requests."""
        closed = ConnectionResetError("closed by the daemon")
        self._lose(Unreachable.at(self.path, error if isinstance(error, OSError) else closed))

    def _resolve(self, response: Mapping[str, Any]) -> None:
        """Resolve the request that a response is for; without an id, all of them."""
        for id, pending in self._pending.items():
            if response["id"] in (id, None) and not pending.done():
                pending.set_result(response)

    def _lose(self, error: Unreachable) -> None:
        if self.lost is not None:
            return
        self.lost = error
        for pending in self._pending.values():
            if not pending.done():
                pending.set_exception(error)
        self._on_lost()


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
