"""The daemon's API for asyncio programs; `controller.api.client` is the same for others.

async with await AsyncClient.connect() as era:
    await era.subscribe("pattern")
    async for told in era.events():
        print(told.data)
"""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from controller.api.client import ANSWER_TIMEOUT, MOST_EVENTS, USUAL_LEASE
from controller.api.jsonrpc import LONGEST_LINE, RpcError, request_line
from controller.api.messages import (
    ArmParams,
    ArmResult,
    EffectsResult,
    HelloParams,
    HelloResult,
    PlayParams,
    RenewParams,
    RenewResult,
    StatusResult,
    SubscribeParams,
    TouchParams,
    UnsubscribeParams,
)
from controller.api.parts import API_VERSION, Message, Nothing, Topic
from controller.api.replies import (
    Notification,
    Unreachable,
    error_of,
    notification_of,
    result_of,
    touch_points,
)
from controller.api.socket_path import find_socket

_ResultT = TypeVar("_ResultT", bound=Message)


class AsyncClient:
    """A connection to a daemon, made by `connect`; any number of calls may be under way."""

    def __init__(
        self,
        path: Path,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        *,
        timeout: float,
    ) -> None:
        self.path = path
        self._reader = reader
        self._writer = writer
        self._timeout = timeout
        self._number = 0
        self._calls: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._events: asyncio.Queue[Notification | None] = asyncio.Queue()
        self._reading = asyncio.create_task(self._read_all(), name="daemon's answers")
        self._is_closed = False

    @classmethod
    async def connect(
        cls, path: Path | None = None, *, name: str = "python", timeout: float = ANSWER_TIMEOUT
    ) -> Self:
        """A connection that has said hello; as `Client.connect`."""
        at = find_socket(path)
        try:
            reader, writer = await asyncio.open_unix_connection(str(at), limit=16 * LONGEST_LINE)
        except OSError as error:
            raise Unreachable.at(at, error) from error
        client = cls(at, reader, writer, timeout=timeout)
        try:
            said = await client.hello(name)
            if said.api_version.partition(".")[0] != API_VERSION.partition(".")[0]:
                raise Unreachable(
                    f"the daemon at {at} speaks version {said.api_version} of the API, this "
                    f"program {API_VERSION}; update the older of the two"
                )
        except BaseException:
            await client.close()
            raise
        return client

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Hang up: fingers that were put down are lifted."""
        self._is_closed = True
        self._writer.close()
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def hello(self, client: str) -> HelloResult:
        """Say who one is; what the daemon drives."""
        return await self.call("hello", HelloParams(client=client), HelloResult)

    async def status(self) -> StatusResult:
        """How everything is."""
        return await self.call("status", Nothing(), StatusResult)

    async def arm(self, owner: str, *, lease_s: float = USUAL_LEASE) -> ArmResult:
        """High voltage on until the lease is over; `armed` renews it by itself."""
        return await self.call("arm", ArmParams(owner=owner, lease_s=lease_s), ArmResult)

    async def renew(self, lease: str) -> RenewResult:
        """Keep the lease for as long again."""
        return await self.call("renew", RenewParams(lease=lease), RenewResult)

    @contextlib.asynccontextmanager
    async def armed(self, owner: str, *, lease_s: float = USUAL_LEASE) -> AsyncIterator[None]:
        """Armed within the block, disarmed after it; a task renews the lease meanwhile."""
        lease = await self.arm(owner, lease_s=lease_s)
        renewing = asyncio.create_task(self._keep_renewing(lease))
        try:
            yield
        finally:
            renewing.cancel()
            await asyncio.gather(renewing, return_exceptions=True)
            await self.disarm()

    async def disarm(self) -> None:
        """Silent along a short ramp, high voltage off."""
        await self.call("disarm", Nothing(), Nothing)

    async def stop(self) -> None:
        """Quick stop, latched until `clear`."""
        await self.call("stop", Nothing(), Nothing)

    async def clear(self) -> None:
        """Acknowledge a stop, or a fault whose cause is gone."""
        await self.call("clear", Nothing(), Nothing)

    async def touch(self, places: Sequence[tuple[float, float]], *, source: str = "python") -> None:
        """All fingers of a source, at x, y [m]: for 150 ms, so repeat it while they are down."""
        params = TouchParams(source=source, touches=touch_points(places))
        await self.call("touch", params, Nothing)

    async def effects(self) -> EffectsResult:
        """The effects that can be played."""
        return await self.call("effects", Nothing(), EffectsResult)

    async def play(
        self, effect: str, place: tuple[float, float], *, level_db_sl: float | None = None
    ) -> None:
        """Play an effect at x, y [m]."""
        params = PlayParams(effect=effect, x_m=place[0], y_m=place[1], level_db_sl=level_db_sl)
        await self.call("play", params, Nothing)

    async def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Be told of topics; see `events`."""
        params = SubscribeParams(topics=list(topics), rate_hz=rate_hz)
        await self.call("subscribe", params, Nothing)

    async def unsubscribe(self, *topics: Topic) -> None:
        """Be told of them no more."""
        await self.call("unsubscribe", UnsubscribeParams(topics=list(topics)), Nothing)

    async def events(self) -> AsyncIterator[Notification]:
        """What the daemon tells, as it comes; ends with the connection."""
        while (told := await self._events.get()) is not None:
            yield told

    async def call(self, method: str, params: Message, result: type[_ResultT]) -> _ResultT:
        """Ask and wait for the answer; raises RpcError, or Unreachable where none comes."""
        if self._reading.done():
            raise Unreachable.at(self.path, ConnectionResetError("the daemon has hung up"))
        self._number += 1
        number, answer = self._number, asyncio.get_running_loop().create_future()
        self._calls[number] = answer
        try:
            self._writer.write(request_line(number, method, params))
            async with asyncio.timeout(self._timeout):
                await self._writer.drain()
                said = await answer
        except OSError as error:
            raise Unreachable.at(self.path, error) from error
        finally:
            self._calls.pop(number, None)
        if "error" in said:
            raise error_of(said)
        return result_of(said, result)

    async def _read_all(self) -> None:
        """Give every line to whoever waits for it, until the connection ends."""
        reason: OSError = ConnectionResetError("the daemon has hung up")
        try:
            while line := await self._reader.readline():
                said = json.loads(line)
                told = notification_of(said)
                if told is not None:
                    if self._events.qsize() >= MOST_EVENTS:
                        self._events.get_nowait()
                    self._events.put_nowait(told)
                elif (answer := self._calls.get(said.get("id"))) and not answer.done():
                    answer.set_result(said)
        except OSError as error:
            reason = error
        finally:
            for answer in self._calls.values():
                if not answer.done():
                    answer.set_exception(reason)
            self._events.put_nowait(None)

    async def _keep_renewing(self, lease: ArmResult) -> None:
        with contextlib.suppress(RpcError, Unreachable):
            while True:
                await asyncio.sleep(lease.lease_s / 3)
                await self.renew(lease.lease)
