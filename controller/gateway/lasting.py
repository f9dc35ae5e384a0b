"""The gateway's own connection to the daemon, for what must not wait for a new one."""

import asyncio
import contextlib
from pathlib import Path
from typing import Any

from controller.api.channel import Channel
from controller.api.client_protocol import RESPONSE_TIMEOUT, Unreachable
from controller.api.jsonrpc import RpcError
from controller.api.schema import Message

_RETRY_INTERVAL = 0.5  # s; of opening it again after a loss
_REPEAT_TIME, _REPEAT_INTERVAL = 0.3, 0.05  # s; of a request that finds it lost


class LastingLink:
    """A connection that is open whenever the daemon is reachable; see `run`.

    However often browsers connect, a request of it needs no new connection, which the daemon may
    refuse; any number may be pending. Requests are repeated, so they are those that may be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._channel: Channel | None = None
        self._opening: asyncio.Task[Channel] | None = None

    async def run(self) -> None:
        """Open it, and again after a loss, until cancelled."""
        while True:
            with contextlib.suppress(Unreachable, RpcError):
                await self._opened()
            await asyncio.sleep(_RETRY_INTERVAL)

    async def request(self, method: str, params: Message) -> Any:
        """Call a method and return its result as parsed JSON; raises RpcError and Unreachable.

        It is repeated for a while if the connection is lost.
        """
        now = asyncio.get_running_loop().time
        repeat_until = now() + _REPEAT_TIME
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                while True:
                    try:
                        channel = await self._opened()
                        return await channel.request(method, params)
                    except Unreachable:
                        if now() >= repeat_until:
                            raise
                    await asyncio.sleep(_REPEAT_INTERVAL)
        except TimeoutError as error:
            if self._channel is not None:  # else what waits in it would grow without bounds
                self._channel.close()
            raise Unreachable.at(self._path, error) from error

    async def _opened(self) -> Channel:
        """The open connection; whoever waits for it shares one attempt."""
        if self._channel is not None and self._channel.lost is None:
            return self._channel
        if self._opening is None or self._opening.done():
            self._opening = asyncio.create_task(self._open())
        return await asyncio.shield(self._opening)

    async def _open(self) -> Channel:
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                self._channel = await Channel.open(
                    self._path, name="gateway", on_event=_ignore, on_lost=lambda: None
                )
        except TimeoutError as error:
            raise Unreachable.at(self._path, error) from error
        return self._channel


def _ignore(_: object) -> None:
    """Events, of which there are none without a subscription."""
