"""Turns of requests and frames, one in each iteration of the event loop.

Left to itself, aiohttp answers one request of every connection in each iteration of the event loop.
With a hundred busy clients an iteration is long, and a stop waits until it ends. `Turns` admits one
request of all clients in each iteration. Requests that silence take no turn.
"""

import asyncio
from collections import deque


class Turns:
    """Admits requests and frames in their order, one in each iteration of the event loop."""

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()

    def take(self) -> "asyncio.Future[None]":
        """Return a turn, a future that is done when the turn comes; cancel it to give it up."""
        loop = asyncio.get_running_loop()
        permit = loop.create_future()
        self._waiting.append(permit)
        if len(self._waiting) == 1:
            loop.call_soon(self._admit_next)
        return permit

    def _admit_next(self) -> None:
        while self._waiting:
            permit = self._waiting.popleft()
            if not permit.done():
                permit.set_result(None)
                break
        if self._waiting:
            asyncio.get_running_loop().call_soon(self._admit_next)
