"""The connections to the daemon that HTTP connections keep."""

import asyncio
from pathlib import Path

from controller.api.client_protocol import RESPONSE_TIMEOUT, Unreachable
from controller.api.link import DaemonLink

MAX_KEPT = 8  # connections; the daemon has 32


class HttpLinks:
    """Bounds the connections to the daemon of all HTTP connections, which has some for others."""

    def __init__(self) -> None:
        self.places = asyncio.Semaphore(MAX_KEPT)
        self.busy = 0
        self.idle: dict[KeptLink, None] = {}  # longest idle first


class KeptLink:
    """The connection to the daemon that an HTTP connection keeps, from its first request on.

    Unless another one needs its place: who is idle longest loses its own.
    """

    def __init__(self, links: HttpLinks) -> None:
        self._links = links
        self._link: DaemonLink | None = None
        self._is_over = False

    @property
    def is_open(self) -> bool:
        """Whether there is one now."""
        return self._link is not None and self._link.is_open

    async def request(self, path: Path, name: str, method: str, params: bytes) -> bytes:
        """Send a request of a client by its name, and return the response.

        Raises RpcError and Unreachable.
        """
        links = self._links
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT), links.places:
                links.idle.pop(self, None)
                links.busy += 1
                try:
                    if links.busy + len(links.idle) > MAX_KEPT:
                        next(iter(links.idle)).drop()
                    if self._link is None or not self._link.is_open:
                        self._link = await DaemonLink.open(path, name)
                    if self._is_over:  # sent all the same
                        asyncio.get_running_loop().call_soon(self.drop)
                    return await self._link.request(method, params, id=name)
                finally:
                    links.busy -= 1
                    if self.is_open:
                        links.idle[self] = None
        except TimeoutError as error:
            self.drop()
            raise Unreachable.at(path, error) from error

    def drop(self) -> None:
        """Close it; a further request opens another."""
        self._links.idle.pop(self, None)
        if self._link is not None and self._link.is_open:
            self._link.close()

    def close(self) -> None:
        """Close it: the HTTP connection is over."""
        self._is_over = True
        self.drop()
