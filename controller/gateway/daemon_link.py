"""The gateway's one connection to the daemon, shared by all browsers."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from controller.api.channel import Channel
from controller.api.client_protocol import RESPONSE_TIMEOUT, Notification, Unreachable
from controller.api.coalesced_calls import CoalescedCalls
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import SubscribeParams
from controller.api.schema import Message
from controller.api.topics import TOPICS
from drivers.pauses import pauses

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
        self._channel: Channel | None = None
        self._stops: CoalescedCalls[Any] = CoalescedCalls()  # of all browsers together
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
        if method == "hello" and self.hello is not None:
            return self.hello  # not passed on: it would rename the gateway in the daemon's log
        if method == "stop":
            stop = self._stops.request(lambda: self._request(method, params))
            return await asyncio.shield(stop)
        return await self._request(method, params)

    async def _request(self, method: str, params: Message) -> Any:
        if self._channel is None:
            raise RpcError(
                ErrorCode.LINK,
                self._failure or "not connected to the daemon yet",
                remedy="the gateway keeps trying to reconnect",
            )
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT):
                return await self._channel.request(method, params)
        except TimeoutError as error:
            raise RpcError(ErrorCode.LINK, str(Unreachable.at(self._socket, error))) from error
        except Unreachable as error:
            raise RpcError(ErrorCode.LINK, str(error)) from error

    async def _follow(self) -> None:
        """Report events until the daemon disconnects; raises RpcError or Unreachable."""
        lost = asyncio.Event()
        failures: list[Exception] = []

        def received(event: Notification) -> None:
            try:
                self._on_event(event)
            except (ValidationError, KeyError) as error:
                failures.append(error)
                channel.close()

        channel = await _open(self._socket, on_event=received, on_lost=lost.set)
        try:
            self.hello = channel.hello
            self._on_hello(self.hello)
            self._channel, self._failure = channel, ""
            await self._request("subscribe", SubscribeParams(topics=list(TOPICS), rate_hz=_RATE))
            await lost.wait()
        finally:
            self._channel = self.hello = None
            self._on_hello(None)
            channel.close()
        if failures:
            raise Unreachable(
                "the daemon sent an event that the gateway does not understand; update the older "
                "of daemon and gateway, then restart both"
            ) from failures[0]

    def _disconnected(self, reason: str) -> None:
        """Log why there is no connection, once per reason."""
        if reason != self._failure:
            self._failure = reason
            _logger.warning("not connected to a daemon: %s", reason)


async def _open(
    socket: Path, *, on_event: Callable[[Notification], None], on_lost: Callable[[], object]
) -> Channel:
    """Connect; raises RpcError and Unreachable."""
    try:
        async with asyncio.timeout(RESPONSE_TIMEOUT):
            return await Channel.open(socket, name=_NAME, on_event=on_event, on_lost=on_lost)
    except TimeoutError as error:
        raise Unreachable.at(socket, error) from error
