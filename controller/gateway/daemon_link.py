"""The gateway's one connection to the daemon, shared by all browsers."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from controller.api.async_client import AsyncClient
from controller.api.client_protocol import Notification, Unreachable
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import HelloParams
from controller.api.schema import Message
from controller.api.topics import TOPICS
from drivers.operation.pauses import pauses

_MIN_RETRY_INTERVAL, _MAX_RETRY_INTERVAL = 0.1, 2.0  # s
_RATE = 10.0  # Hz; of amplifiers and latency
_NAME = "gateway"

_logger = logging.getLogger(__name__)


class DaemonLink:
    """Connects to the daemon at a socket and reconnects after a loss; see `run`.

    on_hello: called with the result of `hello` at each connection, and with None at each loss;
    on_event: called with each notification. hello: the current result, None while disconnected.
    """

    def __init__(
        self,
        socket: Path,
        *,
        on_hello: Callable[[Mapping[str, Any] | None], None],
        on_event: Callable[[Notification], None],
    ) -> None:
        self._socket = socket
        self._on_hello = on_hello
        self._on_event = on_event
        self._client: AsyncClient | None = None
        self._failure = ""  # why there is no connection
        self.hello: Mapping[str, Any] | None = None

    async def run(self) -> None:
        """Connect, follow the daemon and reconnect, until cancelled."""
        while True:
            for pause in pauses(first=_MIN_RETRY_INTERVAL, maximum=_MAX_RETRY_INTERVAL):
                try:
                    await self._follow()
                except (RpcError, Unreachable) as error:
                    self._disconnected(str(error))
                else:
                    break
                await asyncio.sleep(pause)
            self._disconnected("connection closed by the daemon")
            await asyncio.sleep(_MIN_RETRY_INTERVAL)

    async def call(self, method: str, params: Message) -> Any:
        """Call a method of the daemon and return its result as parsed JSON; raises RpcError."""
        if self._client is None or self.hello is None:
            raise RpcError(
                ErrorCode.LINK,
                self._failure or "not connected to the daemon yet",
                remedy="the gateway keeps trying to reconnect",
            )
        if method == "hello":  # never passed on: it would rename the gateway in the daemon's log
            return self.hello
        try:
            return await self._client.request(method, params)
        except Unreachable as error:
            raise RpcError(ErrorCode.LINK, str(error)) from error

    async def _follow(self) -> None:
        """Report events until the daemon disconnects; raises RpcError or Unreachable."""
        client = await AsyncClient.connect(self._socket, name=_NAME)
        try:
            self.hello = await client.request("hello", HelloParams(client=_NAME))
            self._on_hello(self.hello)
            await client.subscribe(*TOPICS, rate_hz=_RATE)
            self._client, self._failure = client, ""
            async for event in client.events():
                self._on_event(event)
        except (ValidationError, KeyError) as error:
            raise Unreachable(
                "the daemon sent an event that the gateway does not understand; update the older "
                "of daemon and gateway, then restart both"
            ) from error
        finally:
            if self.hello is not None:
                self._client = self.hello = None
                self._on_hello(None)
            await client.close()

    def _disconnected(self, reason: str) -> None:
        """Log why there is no connection, once per reason."""
        if reason != self._failure:
            self._failure = reason
            _logger.warning("not connected to a daemon: %s", reason)
