"""The daemon's API for Python programs, for those that wait; `AsyncClient` is its asyncio twin.

with Client.connect() as era:
    print(era.status().state)
    with era.armed("my study"):
        era.touch([(0.10, 0.05)])
"""

import json
import socket
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from controller.api.jsonrpc import LONGEST_LINE, request_line
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

ANSWER_TIMEOUT = 5.0  # s; arming takes the longest, some tenths of a second
MOST_EVENTS = 1000  # that wait to be looked at; older ones are dropped
USUAL_LEASE = 10.0  # s

_ResultT = TypeVar("_ResultT", bound=Message)


class Client:
    """A connection to a daemon; one thread at a time. Errors of the daemon raise RpcError."""

    def __init__(self, path: Path, *, timeout: float = ANSWER_TIMEOUT) -> None:
        self.path = path
        self._timeout = timeout
        self._number = 0
        self._events: deque[Notification] = deque(maxlen=MOST_EVENTS)
        self._rest = b""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise Unreachable.at(path, error) from error

    @classmethod
    def connect(
        cls, path: Path | None = None, *, name: str = "python", timeout: float = ANSWER_TIMEOUT
    ) -> Self:
        """A connection that has said hello; path: of the socket, the usual one if None.

        Raises Unreachable (a LinkError) where nobody answers, or somebody of another major version.
        """
        client = cls(find_socket(path), timeout=timeout)
        try:
            said = client.hello(name)
            if said.api_version.partition(".")[0] != API_VERSION.partition(".")[0]:
                raise Unreachable(
                    f"the daemon at {client.path} speaks version {said.api_version} of the API, "
                    f"this program {API_VERSION}; update the older of the two"
                )
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
        """Hang up: fingers that were put down are lifted."""
        self._socket.close()

    def hello(self, client: str) -> HelloResult:
        """Say who one is; what the daemon drives."""
        return self.call("hello", HelloParams(client=client), HelloResult)

    def status(self) -> StatusResult:
        """How everything is."""
        return self.call("status", Nothing(), StatusResult)

    def arm(self, owner: str, *, lease_s: float = USUAL_LEASE) -> ArmResult:
        """High voltage on until the lease is over; `armed` renews it by itself."""
        return self.call("arm", ArmParams(owner=owner, lease_s=lease_s), ArmResult)

    def renew(self, lease: str) -> RenewResult:
        """Keep the lease for as long again."""
        return self.call("renew", RenewParams(lease=lease), RenewResult)

    @contextmanager
    def armed(self, owner: str, *, lease_s: float = USUAL_LEASE) -> Iterator[None]:
        """Armed within the block, disarmed after it; a thread renews the lease meanwhile."""
        lease = self.arm(owner, lease_s=lease_s)
        over = threading.Event()
        thread = threading.Thread(
            target=_keep_renewing, args=(self.path, lease, over), name="lease", daemon=True
        )
        thread.start()
        try:
            yield
        finally:
            over.set()
            self.disarm()
            thread.join()

    def disarm(self) -> None:
        """Silent along a short ramp, high voltage off."""
        self.call("disarm", Nothing(), Nothing)

    def stop(self) -> None:
        """Quick stop, latched until `clear`."""
        self.call("stop", Nothing(), Nothing)

    def clear(self) -> None:
        """Acknowledge a stop, or a fault whose cause is gone."""
        self.call("clear", Nothing(), Nothing)

    def touch(self, places: Sequence[tuple[float, float]], *, source: str = "python") -> None:
        """All fingers of a source, at x, y [m]: for 150 ms, so repeat it while they are down."""
        params = TouchParams(source=source, touches=touch_points(places))
        self.call("touch", params, Nothing)

    def effects(self) -> EffectsResult:
        """The effects that can be played."""
        return self.call("effects", Nothing(), EffectsResult)

    def play(
        self, effect: str, place: tuple[float, float], *, level_db_sl: float | None = None
    ) -> None:
        """Play an effect at x, y [m]."""
        params = PlayParams(effect=effect, x_m=place[0], y_m=place[1], level_db_sl=level_db_sl)
        self.call("play", params, Nothing)

    def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Be told of topics; see `events`."""
        self.call("subscribe", SubscribeParams(topics=list(topics), rate_hz=rate_hz), Nothing)

    def unsubscribe(self, *topics: Topic) -> None:
        """Be told of them no more."""
        self.call("unsubscribe", UnsubscribeParams(topics=list(topics)), Nothing)

    def events(self, *, timeout: float | None = None) -> Iterator[Notification]:
        """What the daemon tells, as it comes; ends when nothing came for a timeout [s]."""
        self._socket.settimeout(timeout)
        try:
            while True:
                while self._events:
                    yield self._events.popleft()
                try:
                    said = self._read()
                except TimeoutError:
                    return
                except OSError as error:
                    raise Unreachable.at(self.path, error) from error
                if (told := notification_of(said)) is not None:
                    self._events.append(told)
        finally:
            with suppress(OSError):
                self._socket.settimeout(self._timeout)

    def call(self, method: str, params: Message, result: type[_ResultT]) -> _ResultT:
        """Ask and wait for the answer; raises RpcError, or Unreachable where none comes."""
        self._number += 1
        try:
            self._socket.sendall(request_line(self._number, method, params))
            while True:
                said = self._read()
                if (told := notification_of(said)) is not None:
                    self._events.append(told)
                elif said.get("id") == self._number:
                    break
                elif said.get("id") is None and "error" in said:
                    raise error_of(said)
        except OSError as error:
            raise Unreachable.at(self.path, error) from error
        if "error" in said:
            raise error_of(said)
        return result_of(said, result)

    def _read(self) -> dict[str, Any]:
        """The next line; raises OSError."""
        while b"\n" not in self._rest:
            data = self._socket.recv(LONGEST_LINE)
            if not data:
                raise ConnectionResetError("the daemon has hung up")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        said: dict[str, Any] = json.loads(line)
        return said


def _keep_renewing(path: Path, lease: ArmResult, over: threading.Event) -> None:
    """Renew a lease on a connection of its own, until it is over or cannot be renewed."""
    with suppress(Exception), Client.connect(path, name="lease") as client:
        while not over.wait(lease.lease_s / 3):
            client.renew(lease.lease)
