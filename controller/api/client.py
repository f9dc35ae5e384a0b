"""Blocking client of the daemon's API: an `AsyncClient` on a thread of its own.

with Client.connect() as era:
    print(era.status().state)
    with era.armed("my study"):
        era.touch([(0.10, 0.05)])
"""

import functools
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from controller.api.async_client import AsyncClient
from controller.api.calls import Calls
from controller.api.client_protocol import RESPONSE_TIMEOUT, Notification, Unreachable
from controller.api.jsonrpc import RpcError
from controller.api.methods import DEFAULT_LEASE, ArmResult
from controller.api.registered import METHODS
from registry.threads import LoopThread

_T = TypeVar("_T")
_P = ParamSpec("_P")


def _blocking(
    method: Callable[Concatenate[AsyncClient, _P], Coroutine[Any, Any, _T]],
) -> Callable[Concatenate["Client", _P], _T]:
    """The same method of the blocking client."""

    @functools.wraps(method)
    def call(self: "Client", /, *args: _P.args, **options: _P.kwargs) -> _T:
        return self._run(method(self._client, *args, **options))

    return call


class Client(Calls):
    """A client of the daemon, made by `connect`, for any thread; see `AsyncClient`."""

    def __init__(self, client: AsyncClient, loop: LoopThread) -> None:
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
        loop = LoopThread("API")
        try:
            client = loop.run(AsyncClient.connect(path, name=name, timeout=timeout))
        except BaseException:
            loop.close()
            raise
        return cls(client, loop)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the daemon lifts this client's fingers."""
        if self._loop.is_open:
            self._loop.run(self._client.close())
            self._loop.close()

    touch = _blocking(AsyncClient.touch)
    play = _blocking(AsyncClient.play)
    subscribe = _blocking(AsyncClient.subscribe)
    unsubscribe = _blocking(AsyncClient.unsubscribe)

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

    call = _blocking(AsyncClient.call)

    def _run(self, work: Coroutine[Any, Any, _T]) -> _T:
        if not self._loop.is_open:
            work.close()
            raise Unreachable(f"this client of the daemon at {self.path} is closed")
        return self._loop.run(work)


for _name in METHODS:
    if not hasattr(Client, _name):
        setattr(Client, _name, _blocking(getattr(AsyncClient, _name)))
