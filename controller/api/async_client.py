"""asyncio client of the daemon's API; `controller.api.client` is the blocking one.

async with await AsyncClient.connect() as era:
    await era.subscribe("pattern")
    async for event in era.events():
        print(event.data)
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from controller.api.client_protocol import (
    DEFAULT_LEASE,
    MAX_QUEUED_EVENTS,
    READ_SIZE,
    RESPONSE_TIMEOUT,
    ClientProtocol,
    Notification,
    Response,
    Unreachable,
    check_version,
    make_params,
    position,
    read_result,
    touch_params,
)
from controller.api.jsonrpc import RpcError
from controller.api.methods import (
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
    UnsubscribeParams,
)
from controller.api.schema import Empty, Message, Topic
from controller.api.socket_path import find_socket

_ResultT = TypeVar("_ResultT", bound=Message)


class AsyncClient:
    """A connection to a daemon, made by `connect`; any number of calls may be pending.

    Every method raises RpcError for an error of the daemon, and Unreachable, a LinkError, without a
    response.
    """

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
        self._protocol = ClientProtocol()
        self._pending: dict[int, asyncio.Future[Response]] = {}
        self._events: asyncio.Queue[Notification | None] = asyncio.Queue()
        self._lost: Unreachable | None = None
        self._receiving = asyncio.create_task(self._receive(), name="API client")

    @classmethod
    async def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """Connect and introduce this client, like `Client.connect`."""
        params = make_params(HelloParams, client=name)
        socket = find_socket(path)
        try:
            reader, writer = await asyncio.open_unix_connection(str(socket))
        except OSError as error:
            raise Unreachable.at(socket, error) from error
        client = cls(socket, reader, writer, timeout=timeout)
        try:
            check_version(await client.request("hello", params), socket)
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
        """Close the connection; the daemon lifts this client's fingers."""
        self._writer.close()
        self._receiving.cancel()
        await asyncio.gather(self._receiving, return_exceptions=True)
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def hello(self, client: str) -> HelloResult:
        """Introduce this client by another name; return what the daemon drives."""
        return await self.call("hello", make_params(HelloParams, client=client), HelloResult)

    async def status(self) -> StatusResult:
        """Return the state of the daemon, the amplifiers and the plate."""
        return await self.call("status", Empty(), StatusResult)

    async def arm(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> ArmResult:
        """Switch high voltage on until the lease expires; `armed` renews it by itself."""
        params = make_params(ArmParams, owner=owner, lease_s=lease_s)
        return await self.call("arm", params, ArmResult)

    async def renew(self, lease: str) -> RenewResult:
        """Extend the lease by its full length from now."""
        return await self.call("renew", make_params(RenewParams, lease=lease), RenewResult)

    async def disarm(self) -> None:
        """Ramp to silence and switch high voltage off."""
        await self.call("disarm", Empty(), Empty)

    async def stop(self) -> None:
        """Quick stop, latched until `clear`."""
        await self.call("stop", Empty(), Empty)

    async def clear(self) -> None:
        """Acknowledge a stop, or a fault whose cause is gone."""
        await self.call("clear", Empty(), Empty)

    async def touch(self, places: Sequence[tuple[float, float]], *, source: str = "python") -> None:
        """Report all fingers of a source, at x, y [m]; valid for 150 ms, so repeat it."""
        await self.call("touch", touch_params(places, source), Empty)

    async def effects(self) -> EffectsResult:
        """List the effects."""
        return await self.call("effects", Empty(), EffectsResult)

    async def play(
        self, effect: str, place: tuple[float, float], *, level_db_sl: float | None = None
    ) -> None:
        """Play an effect at the finger nearest to x, y [m]."""
        x, y = position(place)
        params = make_params(PlayParams, effect=effect, x_m=x, y_m=y, level_db_sl=level_db_sl)
        await self.call("play", params, Empty)

    async def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Receive notifications of topics; see `events`."""
        params = make_params(SubscribeParams, topics=list(topics), rate_hz=rate_hz)
        await self.call("subscribe", params, Empty)

    async def unsubscribe(self, *topics: Topic) -> None:
        """Receive no more notifications of topics."""
        await self.call("unsubscribe", make_params(UnsubscribeParams, topics=list(topics)), Empty)

    @contextlib.asynccontextmanager
    async def armed(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> AsyncIterator[None]:
        """Armed within the block, disarmed after it; a task renews the lease meanwhile."""
        arming = asyncio.ensure_future(self.arm(owner, lease_s=lease_s))
        try:
            lease = await asyncio.shield(arming)
        except asyncio.CancelledError:
            with contextlib.suppress(RpcError, Unreachable):  # if refused, another client's lease
                await arming
                await self.disarm()
            raise
        renewing = asyncio.create_task(self._keep_renewing(lease))
        try:
            yield
        finally:
            renewing.cancel()
            await asyncio.gather(renewing, return_exceptions=True)
            await self.disarm()

    async def events(self) -> AsyncIterator[Notification]:
        """Yield notifications as they arrive; end with the connection."""
        while (event := await self._events.get()) is not None:
            yield event
        self._events.put_nowait(None)  # for later iterators

    async def call(self, method: str, params: Message, result: type[_ResultT]) -> _ResultT:
        """Call any method and return its result."""
        return read_result(await self.request(method, params), result)

    async def request(self, method: str, params: Message) -> Any:
        """Call any method and return its result as parsed JSON."""
        if self._lost is not None:
            raise self._lost
        id, line = self._protocol.request(method, params)
        response = self._pending[id] = asyncio.get_running_loop().create_future()
        try:
            self._writer.write(line)
            async with asyncio.timeout(self._timeout):
                await self._writer.drain()
                return (await response).result()
        except Unreachable:
            raise
        except OSError as error:
            raise Unreachable.at(self.path, error) from error
        finally:
            del self._pending[id]

    async def _receive(self) -> None:
        """Hand out responses and notifications until the connection ends."""
        lost = Unreachable.at(self.path, ConnectionResetError("closed by the daemon"))
        try:
            while data := await self._reader.read(READ_SIZE):
                for received in self._protocol.receive(data):
                    if isinstance(received, Notification):
                        self._queue(received)
                    else:
                        self._resolve(received)
        except Unreachable as error:
            lost = error
        except OSError as error:
            lost = Unreachable.at(self.path, error)
        finally:
            self._lost = lost
            for pending in self._pending.values():
                if not pending.done():
                    pending.set_exception(lost)
            self._events.put_nowait(None)

    def _queue(self, event: Notification) -> None:
        """Queue a notification for `events`, dropping the oldest of too many."""
        if self._events.qsize() >= MAX_QUEUED_EVENTS:
            self._events.get_nowait()
        self._events.put_nowait(event)

    def _resolve(self, response: Response) -> None:
        """Resolve the call that a response is for; without an id, all of them."""
        for id, pending in self._pending.items():
            if response.id in (id, None) and not pending.done():
                pending.set_result(response)

    async def _keep_renewing(self, lease: ArmResult) -> None:
        with contextlib.suppress(RpcError, Unreachable):
            while True:
                await asyncio.sleep(lease.lease_s / 3)
                await self.renew(lease.lease)
