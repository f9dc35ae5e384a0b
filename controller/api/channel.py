"""Requests of a client over one connection to the daemon, their responses, and notifications."""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

from controller.api.client_protocol import Notification, Unreachable, read_line, result_of
from controller.api.jsonrpc import request_line
from controller.api.link import DaemonLink
from controller.api.schema import Message


class Channel:
    """Any number of requests over a link, each with an id of its own.

    on_event: called with each notification; on_lost: called once, when the link is lost or closed.
    """

    def __init__(
        self,
        link: DaemonLink,
        *,
        on_event: Callable[[Notification], None],
        on_lost: Callable[[], object],
    ) -> None:
        self._link = link
        self._on_event = on_event
        self._on_lost = on_lost
        self._lost: Unreachable | None = None
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._ids = itertools.count(1)
        self._reading = asyncio.create_task(self._read(), name="API")

    @property
    def is_open(self) -> bool:
        """Whether neither side has closed it."""
        return self._link.is_open and self._lost is None

    async def request(self, method: str, params: Message) -> Any:
        """Call a method and return its result as parsed JSON; raises RpcError and Unreachable."""
        if self._lost is not None:
            raise self._lost.with_traceback(None)
        id = next(self._ids)
        response = self._pending[id] = asyncio.get_running_loop().create_future()
        try:
            content = params.model_dump_json(exclude_none=True)
            self._link.write(request_line(id, method, content.encode()))
            return result_of(await response)
        finally:
            del self._pending[id]

    def close(self) -> None:
        """Close at once; the daemon lifts this client's fingers."""
        self._link.abort()

    async def _read(self) -> None:
        """Hand out responses and notifications; at the end fail all pending requests."""
        try:
            while True:
                received = read_line(await self._link.next_line())
                if isinstance(received, Notification):
                    self._on_event(received)
                    continue
                for id, pending in self._pending.items():  # without an id, of all of them
                    if received["id"] in (id, None) and not pending.done():
                        pending.set_result(received)
        except Unreachable as error:
            self._lost = error
            self._link.abort()
            for pending in self._pending.values():
                if not pending.done():
                    pending.set_exception(error)
            self._on_lost()
