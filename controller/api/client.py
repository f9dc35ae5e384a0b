"""Blocking client of the daemon's API; `AsyncClient` is its asyncio twin.

with Client.connect() as era:
    print(era.status().state)
    with era.armed("my study"):
        era.touch([(0.10, 0.05)])
"""

import socket
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
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
from model.arguments import expect_path

_ResultT = TypeVar("_ResultT", bound=Message)


class Client:
    """A connection to a daemon, for one thread at a time.

    Every method raises RpcError for an error of the daemon, and Unreachable, a LinkError, without a
    response.
    """

    def __init__(self, path: Path | str, *, timeout: float = RESPONSE_TIMEOUT) -> None:
        self.path = expect_path(path, what="path")
        self._timeout = timeout
        self._protocol = ClientProtocol()
        self._events: deque[Notification] = deque(maxlen=MAX_QUEUED_EVENTS)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise Unreachable.at(self.path, error) from error

    @classmethod
    def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """Connect to the daemon at a socket (default: the usual one) and introduce this client.

        Raises Unreachable if no daemon answers, or one of another major version.
        """
        params = make_params(HelloParams, client=name)
        client = cls(find_socket(path), timeout=timeout)
        try:
            check_version(client.request("hello", params), client.path)
        except BaseException:
            client.close()
            raise
        return client

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
        self._socket.close()

    def hello(self, client: str) -> HelloResult:
        """Introduce this client by another name; return what the daemon drives."""
        return self.call("hello", make_params(HelloParams, client=client), HelloResult)

    def status(self) -> StatusResult:
        """Return the state of the daemon, the amplifiers and the plate."""
        return self.call("status", Empty(), StatusResult)

    def arm(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> ArmResult:
        """Switch high voltage on until the lease expires; `armed` renews it by itself."""
        params = make_params(ArmParams, owner=owner, lease_s=lease_s)
        return self.call("arm", params, ArmResult)

    def renew(self, lease: str) -> RenewResult:
        """Extend the lease by its full length from now."""
        return self.call("renew", make_params(RenewParams, lease=lease), RenewResult)

    def disarm(self) -> None:
        """Ramp to silence and switch high voltage off."""
        self.call("disarm", Empty(), Empty)

    def stop(self) -> None:
        """Quick stop, latched until `clear`."""
        self.call("stop", Empty(), Empty)

    def clear(self) -> None:
        """Acknowledge a stop, or a fault whose cause is gone."""
        self.call("clear", Empty(), Empty)

    def touch(self, places: Sequence[tuple[float, float]], *, source: str = "python") -> None:
        """Report all fingers of a source, at x, y [m]; valid for 150 ms, so repeat it."""
        self.call("touch", touch_params(places, source), Empty)

    def effects(self) -> EffectsResult:
        """List the effects."""
        return self.call("effects", Empty(), EffectsResult)

    def play(
        self, effect: str, place: tuple[float, float], *, level_db_sl: float | None = None
    ) -> None:
        """Play an effect at the finger nearest to x, y [m]."""
        x, y = position(place)
        params = make_params(PlayParams, effect=effect, x_m=x, y_m=y, level_db_sl=level_db_sl)
        self.call("play", params, Empty)

    def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Receive notifications of topics; see `events`."""
        params = make_params(SubscribeParams, topics=list(topics), rate_hz=rate_hz)
        self.call("subscribe", params, Empty)

    def unsubscribe(self, *topics: Topic) -> None:
        """Receive no more notifications of topics."""
        self.call("unsubscribe", make_params(UnsubscribeParams, topics=list(topics)), Empty)

    @contextmanager
    def armed(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> Iterator[None]:
        """Armed within the block, disarmed after it; a thread renews the lease meanwhile."""
        lease = self.arm(owner, lease_s=lease_s)
        finished = threading.Event()
        thread = threading.Thread(
            target=_keep_renewing, args=(self.path, lease, finished), name="lease", daemon=True
        )
        thread.start()
        try:
            yield
        finally:
            finished.set()
            self.disarm()
            thread.join()

    def events(self, *, timeout: float | None = None) -> Iterator[Notification]:
        """Yield notifications as they arrive; end when none arrives within a timeout [s]."""
        self._socket.settimeout(timeout)
        try:
            while True:
                while self._events:
                    yield self._events.popleft()
                try:
                    self._receive()
                except TimeoutError:
                    return
                except OSError as error:
                    raise Unreachable.at(self.path, error) from error
        finally:
            with suppress(OSError):
                self._socket.settimeout(self._timeout)

    def call(self, method: str, params: Message, result: type[_ResultT]) -> _ResultT:
        """Call any method and return its result."""
        return read_result(self.request(method, params), result)

    def request(self, method: str, params: Message) -> Any:
        """Call any method and return its result as parsed JSON."""
        id, line = self._protocol.request(method, params)
        try:
            self._send(line)
            while True:
                for response in self._receive():
                    if response.id in (id, None):
                        return response.result()
        except Unreachable:
            raise
        except OSError as error:
            raise Unreachable.at(self.path, error) from error

    def _send(self, line: bytes) -> None:
        """Send a whole line or close: after part of a line the next one would be misread."""
        try:
            self._socket.sendall(line)
        except OSError:
            self.close()
            raise

    def _receive(self) -> list[Response]:
        """The next responses; notifications are queued for `events`. Raises OSError."""
        data = self._socket.recv(READ_SIZE)
        if not data:
            raise ConnectionResetError("closed by the daemon")
        received = self._protocol.receive(data)
        self._events.extend(each for each in received if isinstance(each, Notification))
        return [each for each in received if isinstance(each, Response)]


def _keep_renewing(path: Path, lease: ArmResult, finished: threading.Event) -> None:
    """Renew a lease over a connection of its own, until finished or refused."""
    with suppress(Exception), Client.connect(path, name="lease") as client:
        while not finished.wait(lease.lease_s / 3):
            client.renew(lease.lease)
