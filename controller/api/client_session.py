"""One connection of a Python client to the daemon, with the calls that are pending on it."""

import asyncio
import itertools
from collections.abc import Callable, Mapping
from typing import Any

from controller.api.jsonrpc import request_line
from controller.api.link import DaemonLink, Notification, Unreachable, read_line, result_of
from controller.api.schema import ApiMessage


class ClientSession:
    """A connection with its pending calls, read by a task from its start to its end.

    received: called with each event. lost: called once the connection is lost, after all pending
    calls have failed.
    """

    def __init__(
        self,
        link: DaemonLink,
        *,
        received: Callable[[Notification], None],
        lost: Callable[[], None],
    ) -> None:
        self.is_restored = False
        """Whether it has all subscriptions of its client."""
        self._link = link
        self._received = received
        self._lost = lost
        self._ids = itertools.count(1)
        self._pending: dict[int, asyncio.Future[Any]] = {}  # responses, by the id of the call
        self._reading = asyncio.create_task(self._read(), name="API")

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it."""
        return self._link.is_open

    def abort(self) -> None:
        """Close it immediately; pending calls fail."""
        self._link.abort()

    async def call(self, method: str, params: ApiMessage) -> Any:
        """Send a request and return its result as parsed JSON; raises RpcError and Unreachable.

        If the connection was lost, fails immediately: nothing reads its responses any more.
        """
        if not self.is_open:
            raise self._link.closed_by_daemon()
        id = next(self._ids)
        response = asyncio.get_running_loop().create_future()
        self._pending[id] = response
        try:
            content = params.model_dump_json(exclude_none=True)
            self._link.write(request_line(id, method, content.encode()))
            return result_of(await response)
        finally:
            del self._pending[id]

    async def _read(self) -> None:
        """Dispatch responses and events until the connection is lost; then fail pending calls."""
        try:
            while True:
                message = read_line(await self._link.next_line())
                if isinstance(message, Notification):
                    self._received(message)
                else:
                    self._dispatch(message)
        except Unreachable as error:
            self._link.abort()
            for response in self._pending.values():
                if not response.done():
                    response.set_exception(error)
        self._lost()

    def _dispatch(self, message: Mapping[str, Any]) -> None:
        """Pass a response to its call; a response without an id is for all calls."""
        for id, response in self._pending.items():
            if message["id"] in (id, None) and not response.done():
                response.set_result(message)
