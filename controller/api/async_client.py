"""The daemon's API for asyncio programs; `controller.api.client` is the same for others.

async with await AsyncClient.connect() as era:
    await era.subscribe("pattern")
    async for told in era.events():
        print(told.data)
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from controller.api import calls
from controller.api.calls import Call, as_message
from controller.api.client_protocol import (
    Greeting,
    Notification,
    Response,
    Unreachable,
    check_version,
)
from controller.api.conversation import CHUNK, MAX_QUEUED_EVENTS, RESPONSE_TIMEOUT, Conversation
from controller.api.jsonrpc import RpcError
from controller.api.methods import ArmResult
from controller.api.schema import Message
from controller.api.socket_path import find_socket

_P = ParamSpec("_P")
_ResultT = TypeVar("_ResultT")
_MessageT = TypeVar("_MessageT", bound=Message)


def _method(
    make: Callable[_P, Call[_ResultT]],
) -> Callable[Concatenate["AsyncClient", _P], Coroutine[Any, Any, _ResultT]]:
    """The method that makes a call and gives its answer."""

    checked = calls.in_words(make)

    async def ask(client: "AsyncClient", /, *args: _P.args, **kwargs: _P.kwargs) -> _ResultT:
        return await client._ask(checked(*args, **kwargs))

    calls.name_after(make, ask)
    return ask


class AsyncClient:
    """A connection to a daemon, made by `connect`; any number of calls may be under way.

    Errors of the daemon raise RpcError, and Unreachable, a LinkError, where no answer comes.
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
        self._conversation = Conversation()
        self._waiting: dict[int, asyncio.Future[Response]] = {}
        self._events: asyncio.Queue[Notification | None] = asyncio.Queue()
        self._gone: Unreachable | None = None
        self._reading = asyncio.create_task(self._read_all(), name="daemon's answers")

    @classmethod
    async def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """A connection that has said hello; as `Client.connect`."""
        greeting = calls.greeting(name)
        at = find_socket(path)
        try:
            reader, writer = await asyncio.open_unix_connection(str(at))
        except OSError as error:
            raise Unreachable.at(at, error) from error
        client = cls(at, reader, writer, timeout=timeout)
        try:
            said = await client.call("hello", greeting, Greeting)
            check_version(said, at)
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
        self._writer.close()
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    hello = _method(calls.hello)
    status = _method(calls.status)
    arm = _method(calls.arm)
    renew = _method(calls.renew)
    disarm = _method(calls.disarm)
    stop = _method(calls.stop)
    clear = _method(calls.clear)
    touch = _method(calls.touch)
    effects = _method(calls.effects)
    play = _method(calls.play)
    subscribe = _method(calls.subscribe)
    unsubscribe = _method(calls.unsubscribe)

    @contextlib.asynccontextmanager
    async def armed(
        self, owner: str, *, lease_s: float = calls.DEFAULT_LEASE
    ) -> AsyncIterator[None]:
        """Armed within the block, disarmed after it; a task renews the lease meanwhile."""
        arming = asyncio.ensure_future(self.arm(owner, lease_s=lease_s))
        try:
            lease = await asyncio.shield(arming)
        except asyncio.CancelledError:
            with contextlib.suppress(RpcError, Unreachable):  # refused, it is somebody else's
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
        """What the daemon tells, as it comes; ends with the connection."""
        while (told := await self._events.get()) is not None:
            yield told
        self._events.put_nowait(None)  # it has ended for whoever listens next, too

    async def call(self, method: str, params: Message, result: type[_MessageT]) -> _MessageT:
        """Ask by any method of the API, and wait for the answer."""
        return await self._ask(Call(method, params, as_message(result)))

    async def _ask(self, call: Call[_ResultT]) -> _ResultT:
        if self._gone is not None:
            raise self._gone
        number, line = self._conversation.ask(call)
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            self._writer.write(line)
            async with asyncio.timeout(self._timeout):
                await self._writer.drain()
                said = (await answer).said
        except Unreachable:
            raise
        except OSError as error:
            raise Unreachable.at(self.path, error) from error
        finally:
            del self._waiting[number]
        return call.read(said)

    async def _read_all(self) -> None:
        """Give every reply to whoever waits for it, until the connection ends."""
        gone = Unreachable.at(self.path, ConnectionResetError("the daemon has hung up"))
        try:
            while data := await self._reader.read(CHUNK):
                for reply in self._conversation.hear(data):
                    if isinstance(reply, Notification):
                        self._keep(reply)
                    else:
                        self._settle(reply)
        except Unreachable as error:
            gone = error
        except OSError as error:
            gone = Unreachable.at(self.path, error)
        finally:
            self._gone = gone
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(gone)
            self._events.put_nowait(None)

    def _keep(self, told: Notification) -> None:
        """Keep a notification for `events`; the oldest gives way."""
        if self._events.qsize() >= MAX_QUEUED_EVENTS:
            self._events.get_nowait()
        self._events.put_nowait(told)

    def _settle(self, answer: Response) -> None:
        """Hand an answer to whoever waits for it; one to no request in particular to everybody."""
        for number, waiting in self._waiting.items():
            if answer.number in (number, None) and not waiting.done():
                waiting.set_result(answer)

    async def _keep_renewing(self, lease: ArmResult) -> None:
        with contextlib.suppress(RpcError, Unreachable):
            while True:
                await asyncio.sleep(lease.lease_s / 3)
                await self.renew(lease.lease)
