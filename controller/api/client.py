"""Blocking client of the daemon's API: an `AsyncClient` on a thread of its own.

with Client.connect() as era:
    print(era.status().state)
    with era.armed("my study"):
        era.touch([(0.10, 0.05)])
"""

import asyncio
import threading
import weakref
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from controller.api.async_client import AsyncClient
from controller.api.client_protocol import (
    DEFAULT_LEASE,
    RESPONSE_TIMEOUT,
    Notification,
    Unreachable,
)
from controller.api.jsonrpc import RpcError
from controller.api.methods import (
    ArmResult,
    EffectsResult,
    HelloResult,
    PlayResult,
    RenewResult,
    StatusResult,
    StopResult,
)
from controller.api.schema import Message, Topic

_T = TypeVar("_T")
_ResultT = TypeVar("_ResultT", bound=Message)


class Client:
    """A client of the daemon, made by `connect`, for any thread; see `AsyncClient`."""

    def __init__(self, client: AsyncClient, loop: "_LoopThread") -> None:
        self.path = client.path
        self._client = client
        self._loop = loop

    @classmethod
    def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """Connect to the daemon at a socket (default: the usual one) and introduce this client.

        Raises Unreachable if no daemon answers, one of another major version, or a process that is
        not to be believed.
        """
        loop = _LoopThread()
        try:
            client = loop.run(AsyncClient.connect(path, name=name, timeout=timeout))
        except BaseException:
            loop.close()
            raise
        return cls(client, loop)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the daemon lifts this client's fingers."""
        if self._loop.is_open:
            self._loop.run(self._client.close())
            self._loop.close()

    def hello(self, client: str) -> HelloResult:
        """Introduce this client by another name; return what the daemon drives."""
        return self._run(self._client.hello(client))

    def status(self) -> StatusResult:
        """Return the state of the daemon, the amplifiers and the plate."""
        return self._run(self._client.status())

    def arm(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> ArmResult:
        """Switch high voltage on until the lease expires; `armed` renews it by itself."""
        return self._run(self._client.arm(owner, lease_s=lease_s))

    def renew(self, lease: str) -> RenewResult:
        """Extend the lease by its full length from now."""
        return self._run(self._client.renew(lease))

    def disarm(self) -> None:
        """Ramp to silence and switch high voltage off."""
        self._run(self._client.disarm())

    def stop(self) -> StopResult:
        """Quick stop, latched until `clear`.

        Raises NotSilent unless every amplifier is confirmed silent.
        """
        return self._run(self._client.stop())

    def clear(self) -> None:
        """Acknowledge a stop, or a fault whose cause is gone."""
        self._run(self._client.clear())

    def forget(self) -> None:
        """Discard what was learned of the plate; answers are those of the table as built."""
        self._run(self._client.forget())

    def touch(self, positions: Sequence[tuple[float, float]], *, source: str = "python") -> None:
        """Report all fingers of a source, at x, y [m]; valid for 150 ms, so repeat it."""
        self._run(self._client.touch(positions, source=source))

    def effects(self) -> EffectsResult:
        """List the effects."""
        return self._run(self._client.effects())

    def play(
        self, effect: str, position: tuple[float, float], *, level_db_sl: float | None = None
    ) -> PlayResult:
        """Play an effect at the finger nearest to x, y [m]; say whether it is held back."""
        return self._run(self._client.play(effect, position, level_db_sl=level_db_sl))

    def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Receive notifications of topics; see `events`."""
        self._run(self._client.subscribe(*topics, rate_hz=rate_hz))

    def unsubscribe(self, *topics: Topic) -> None:
        """Receive no more notifications of topics."""
        self._run(self._client.unsubscribe(*topics))

    @contextmanager
    def armed(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> Iterator[ArmResult]:
        """Armed within the block, disarmed after it; the lease is renewed meanwhile.

        Raises LeaseLost at the next call and at the end of the block once the lease is lost.
        """
        lease = self._run(self._client.begin_armed(owner, lease_s=lease_s))
        try:
            yield lease
        except BaseException:
            with suppress(RpcError, Unreachable):
                self._run(self._client.end_armed())
            raise
        self._run(self._client.end_armed())

    def events(self, *, timeout: float | None = None) -> Iterator[Notification]:
        """Yield notifications as they arrive; end when none arrives within a timeout [s]."""
        while (event := self._run(self._client.next_event(timeout=timeout))) is not None:
            yield event

    def call(self, method: str, params: Message, result: type[_ResultT]) -> _ResultT:
        """Call any method and return its result."""
        return self._run(self._client.call(method, params, result))

    def _run(self, work: Coroutine[Any, Any, _T]) -> _T:
        if not self._loop.is_open:
            work.close()
            raise Unreachable(f"this client of the daemon at {self.path} is closed")
        return self._loop.run(work)


class _LoopThread:
    """An event loop in a daemon thread, until `close` or until nothing refers to it."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        finished = asyncio.Event()
        thread = threading.Thread(
            target=_run_until, args=[self._loop, finished], name="API", daemon=True
        )
        thread.start()
        self._end = weakref.finalize(self, _end, self._loop, finished, thread)

    @property
    def is_open(self) -> bool:
        """Whether it still runs."""
        return self._end.alive

    def run(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Run a coroutine; cancel it if waiting is interrupted."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        """End the thread."""
        self._end()


def _run_until(loop: asyncio.AbstractEventLoop, finished: asyncio.Event) -> None:
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(_wait(finished))


async def _wait(finished: asyncio.Event) -> None:
    await finished.wait()


def _end(
    loop: asyncio.AbstractEventLoop, finished: asyncio.Event, thread: threading.Thread
) -> None:
    loop.call_soon_threadsafe(finished.set)
    if thread is not threading.current_thread():
        thread.join()
