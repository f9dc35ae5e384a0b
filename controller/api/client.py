"""The daemon's API for Python programs, for those that wait; `AsyncClient` is its asyncio twin.

with Client.connect() as era:
    print(era.status().state)
    with era.armed("my study"):
        era.touch([(0.10, 0.05)])
"""

import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Concatenate, ParamSpec, Self, TypeVar

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
from controller.api.methods import ArmResult
from controller.api.schema import Message
from controller.api.socket_path import find_socket
from model.arguments import expect_path

_P = ParamSpec("_P")
_ResultT = TypeVar("_ResultT")
_MessageT = TypeVar("_MessageT", bound=Message)


def _method(make: Callable[_P, Call[_ResultT]]) -> Callable[Concatenate["Client", _P], _ResultT]:
    """The method that makes a call and waits for its answer."""

    checked = calls.in_words(make)

    def ask(client: "Client", /, *args: _P.args, **kwargs: _P.kwargs) -> _ResultT:
        return client._ask(checked(*args, **kwargs))

    calls.name_after(make, ask)
    return ask


class Client:
    """A connection to a daemon; one thread at a time. Errors of the daemon raise RpcError.

    Every method raises Unreachable, a LinkError, where no answer comes.
    """

    def __init__(self, path: Path | str, *, timeout: float = RESPONSE_TIMEOUT) -> None:
        self.path = expect_path(path, what="path")
        self._timeout = timeout
        self._conversation = Conversation()
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
        """A connection that has said hello; path: of the socket, the usual one if None.

        Raises Unreachable where nobody answers, or somebody of another major version.
        """
        greeting = calls.greeting(name)
        client = cls(find_socket(path), timeout=timeout)
        try:
            said = client.call("hello", greeting, Greeting)
            check_version(said, client.path)
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

    @contextmanager
    def armed(self, owner: str, *, lease_s: float = calls.DEFAULT_LEASE) -> Iterator[None]:
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

    def events(self, *, timeout: float | None = None) -> Iterator[Notification]:
        """What the daemon tells, as it comes; ends when nothing came for a timeout [s]."""
        self._socket.settimeout(timeout)
        try:
            while True:
                while self._events:
                    yield self._events.popleft()
                try:
                    self._read()
                except TimeoutError:
                    return
                except OSError as error:
                    raise Unreachable.at(self.path, error) from error
        finally:
            with suppress(OSError):
                self._socket.settimeout(self._timeout)

    def call(self, method: str, params: Message, result: type[_MessageT]) -> _MessageT:
        """Ask by any method of the API, and wait for the answer."""
        return self._ask(Call(method, params, as_message(result)))

    def _ask(self, call: Call[_ResultT]) -> _ResultT:
        number, line = self._conversation.ask(call)
        try:
            self._send(line)
            while True:
                for answer in self._read():
                    if answer.number in (number, None):
                        return call.read(answer.said)
        except Unreachable:
            raise
        except OSError as error:
            raise Unreachable.at(self.path, error) from error

    def _send(self, line: bytes) -> None:
        """Send a line whole, or hang up: the next one would be taken for the rest of this."""
        try:
            self._socket.sendall(line)
        except OSError:
            self.close()
            raise

    def _read(self) -> list[Response]:
        """The answers that came next; notifications are kept for `events`. Raises OSError."""
        data = self._socket.recv(CHUNK)
        if not data:
            raise ConnectionResetError("the daemon has hung up")
        answers = []
        for reply in self._conversation.hear(data):
            if isinstance(reply, Notification):
                self._events.append(reply)
            else:
                answers.append(reply)
        return answers


def _keep_renewing(path: Path, lease: ArmResult, over: threading.Event) -> None:
    """Renew a lease on a connection of its own, until it is over or cannot be renewed."""
    with suppress(Exception), Client.connect(path, name="lease") as client:
        while not over.wait(lease.lease_s / 3):
            client.renew(lease.lease)
