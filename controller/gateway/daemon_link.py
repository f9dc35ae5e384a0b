"""The gateway's one connection to the daemon, for the requests of everybody."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from controller.api.async_client import AsyncClient
from controller.api.client_protocol import Notification, Unreachable
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import METHODS, HelloResult
from controller.api.schema import Message
from controller.api.topics import TOPICS
from drivers.operation.pauses import pauses

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 2.0  # s; between attempts to reach the daemon
_RATE = 10.0  # Hz; of amplifiers and latency
_NAME = "gateway"
_UPDATE = "update the older of daemon and gateway, then start both anew"

_logger = logging.getLogger(__name__)


class DaemonLink:
    """Reaches the daemon at a socket, again and again; see `run`.

    on_hello: told of the daemon at each new connection, and None when it is lost; on_event: told of
    each notification. hello: how the daemon has introduced itself, None while it is away.
    """

    def __init__(
        self,
        socket: Path,
        *,
        on_hello: Callable[[HelloResult | None], None],
        on_event: Callable[[Notification], None],
    ) -> None:
        self._socket = socket
        self._on_hello = on_hello
        self._on_event = on_event
        self._client: AsyncClient | None = None
        self._away = ""  # why there is no daemon
        self.hello: HelloResult | None = None

    async def run(self) -> None:
        """Connect, listen, and connect again after a loss, until cancelled."""
        while True:
            for pause in pauses(first=_FIRST_PAUSE, longest=_LONGEST_PAUSE):
                try:
                    await self._follow()
                except (RpcError, Unreachable) as error:
                    self._is_away_because(str(error))
                else:
                    break
                await asyncio.sleep(pause)
            self._is_away_because("the daemon has hung up")
            await asyncio.sleep(_FIRST_PAUSE)

    async def call(self, method: str, params: Message) -> dict[str, Any]:
        """Ask the daemon; its result as JSON. Raises RpcError, its own or that it is not there."""
        if self._client is None or self.hello is None:
            raise RpcError(
                ErrorCode.LINK,
                self._away or "not connected to the daemon yet",
                remedy="the gateway tries again by itself",
            )
        if method == "hello":  # or anybody could give the gateway another name in the daemon's log
            return self.hello.model_dump(mode="json")
        try:
            result = await self._client.call(method, params, METHODS[method].result)
        except Unreachable as error:
            raise RpcError(ErrorCode.LINK, str(error)) from error
        return result.model_dump(mode="json")

    async def _follow(self) -> None:
        """Tell what a daemon tells until it hangs up; raises RpcError, or Unreachable for none."""
        client = await AsyncClient.connect(self._socket, name=_NAME)
        try:
            self.hello = await client.hello(_NAME)
            self._on_hello(self.hello)
            await client.subscribe(*TOPICS, rate_hz=_RATE)
            self._client, self._away = client, ""
            async for told in client.events():
                self._on_event(told)
        except (ValidationError, KeyError) as error:
            raise Unreachable(f"what the daemon tells cannot be understood; {_UPDATE}") from error
        finally:
            if self.hello is not None:
                self._client = self.hello = None
                self._on_hello(None)
            await client.close()

    def _is_away_because(self, reason: str) -> None:
        """Log why there is no daemon, once, and tell whoever asks for it."""
        if reason != self._away:
            self._away = reason
            _logger.warning("not connected to a daemon: %s", reason)
