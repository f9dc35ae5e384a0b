"""The connections to the daemon that HTTP connections keep."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from controller.api.client_protocol import RESPONSE_TIMEOUT, Unreachable
from controller.api.link import DaemonLink

MAX_KEPT = 8  # connections; the daemon has 32


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
