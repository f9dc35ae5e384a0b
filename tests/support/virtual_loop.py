"""An event loop on a clock that jumps to the next timer, with a TCP network of its own.

Connections of that network are between listeners and clients of the same loop; all else has the
machine's sockets and pipes, and costs no time. Runs without those and with the same random seed are
identical, byte for byte.
"""

import asyncio
import functools
import math
import random
import selectors
import threading
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

START = 1000.0  # s; not zero, which code could take for "never"
_FIRST_PORT = 20_000
_TURNS_MAX = 20_000  # at one moment; more are an endless loop
_REAL_WAIT = 0.001  # s; for a thread that works
_AWAITED = ("reload", "dump", "content")  # names of threads for which time stands still
_LATENCY = (50e-6, 400e-6)  # s; of a loopback connection

Seen = Callable[[str, str, bytes], None]
"""Called with a link, the direction (amplifier or host) and the bytes, as they are sent."""


class Stuck(Exception):
    """Deadlock: no timer and no ready task, or no progress of time."""


class _Selector(selectors.DefaultSelector):
    """Waiting for a timer costs no time, waiting for the machine does: the clock jumps.

    It stands still while a daemon's threads work with files.
    """

    def __init__(self, loop: "VirtualLoop") -> None:
        super().__init__()
        self._loop = loop
        self._turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._turns += 1
        if self._turns > _TURNS_MAX:
            self._turns = 0
            raise Stuck(f"{_TURNS_MAX} turns at one moment: a task reschedules itself endlessly")
        is_alone = (
            len(self.get_map()) == 1 == threading.active_count()
        )  # nothing but the loop's own
        ready = [] if is_alone else super().select(0)
        if ready or timeout == 0:
            return ready
        self._turns = 0
        if timeout is None:
            if is_alone:
                raise Stuck("deadlock: no timer and no ready task")
            return super().select(timeout)
        if not is_alone and any(each.name in _AWAITED for each in threading.enumerate()):
            return super().select(_REAL_WAIT)
        self._loop.now = max(self._loop.now, self._loop._scheduled[0].when())
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """The loop; rng: of the latencies of connections; seen: observer of their bytes.

    latency [s]: shortest and longest of a connection.
    """

    def __init__(self, rng: random.Random | None = None, seen: Seen | None = None) -> None:
        self.now = START
        self.latency = _LATENCY
        super().__init__(_Selector(self))
        self.rng = rng or random.Random(0)
        self.seen: Seen = seen or (lambda link, toward, data: None)
        self._servers: dict[int, _Server] = {}
        self._hosts: list[MemoryTransport] = []

    def time(self) -> float:
        """Virtual seconds."""
        return self.now

    @property
    def _clock_resolution(self) -> float:
        """The smallest step: no timer fires early."""
        return math.ulp(self.now)

    @_clock_resolution.setter
    def _clock_resolution(self, of_the_machine: float) -> None:
        """Ignore the resolution of the machine's clock."""

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Run at once: there are no threads."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    async def create_server(self, factory: Any, host: Any = None, port: Any = 0, **_: Any) -> Any:
        """Listen on a port; OSError where it is taken."""
        number = port or next(n for n in range(_FIRST_PORT, 65_536) if n not in self._servers)
        if number in self._servers:
            raise OSError(98, "Address already in use")
        server = self._servers[number] = _Server(self, number, factory)
        return server

    async def create_connection(
        self, factory: Any, host: Any = None, port: Any = 0, **_: Any
    ) -> Any:
        """Connect to a listener; raises ConnectionRefusedError without one."""
        await asyncio.sleep(self.rng.uniform(*self.latency))
        server = self._servers.get(port)
        if server is None:
            raise ConnectionRefusedError(111, "Connection refused")
        host_side, far_side = factory(), server.factory()
        link = f"{host}:{port}"
        ours = MemoryTransport(self, host_side, link, "amplifier")
        theirs = MemoryTransport(self, far_side, link, "host")
        ours.peer, theirs.peer = theirs, ours
        self._hosts = [known for known in self._hosts if not known.is_closing()] + [ours]
        far_side.connection_made(theirs)
        host_side.connection_made(ours)
        return ours, host_side

    def kill_hosts(self) -> None:
        """Cut all connections without notice, as when a process dies."""
        for transport in self._hosts:
            transport.die()

    def forget_server(self, port: int) -> None:
        """Stop listening."""
        self._servers.pop(port, None)


class _Socket:
    """The socket methods used here."""

    def __init__(self, port: int) -> None:
        self._port = port

    def getsockname(self) -> tuple[str, int]:
        """Its address."""
        return "127.0.0.1", self._port

    def setsockopt(self, *_: Any) -> None:
        """Ignore options."""


class _Server:
    """A listener."""

    def __init__(self, loop: VirtualLoop, port: int, factory: Callable[[], Any]) -> None:
        self.factory = factory
        self.sockets = [_Socket(port)]
        self._loop = loop
        self._port = port

    def close(self) -> None:
        """Stop listening."""
        self._loop.forget_server(self._port)

    async def wait_closed(self) -> None:
        """Already closed."""


class MemoryTransport(asyncio.Transport):
    """One side of a connection; toward: receiver of its bytes."""

    def __init__(self, loop: VirtualLoop, protocol: Any, link: str, toward: str) -> None:
        super().__init__()
        self.peer: MemoryTransport
        self._loop = loop
        self._protocol = protocol
        self._link = link
        self._toward = toward
        self._arrives = 0.0  # time of the last bytes sent
        self._is_closed = False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """The socket; the default for all else."""
        return _Socket(0) if name == "socket" else default

    def get_write_buffer_size(self) -> int:
        """Always empty."""
        return 0

    def is_closing(self) -> bool:
        """Whether it is closed."""
        return self._is_closed

    def write(self, data: Any) -> None:
        """Send; it arrives in order, a little later."""
        if self._is_closed:
            return
        self._loop.seen(self._link, self._toward, bytes(data))
        self._later(self.peer._received, bytes(data))

    def close(self) -> None:
        """Close both sides."""
        if not self._is_closed:
            self._disconnect()
            self._later(self.peer._disconnect)

    def abort(self) -> None:
        """Close; the write buffer is always empty."""
        self.close()

    def die(self) -> None:
        """Close the other side without notice to this one."""
        if not self._is_closed:
            self._is_closed = True
            self._later(self.peer._disconnect)

    def _received(self, data: bytes) -> None:
        if not self._is_closed:
            feed(self._protocol, data)

    def _disconnect(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._loop.call_soon(self._protocol.connection_lost, None)

    def _later(self, callback: Callable[..., None], *args: Any) -> None:
        loop = self._loop
        # Timers of one moment fire in any order; bytes of one connection stay in order.
        soonest = self._arrives + 1e-9
        self._arrives = max(soonest, loop.time() + loop.rng.uniform(*loop.latency))
        loop.call_at(self._arrives, callback, *args)


def feed(protocol: Any, data: bytes) -> None:
    """Let a protocol receive bytes, as an event loop does."""
    if not isinstance(protocol, asyncio.BufferedProtocol):
        protocol.data_received(data)
        return
    while data:
        buffer = protocol.get_buffer(-1)
        part = data[: len(buffer)]
        buffer[: len(part)] = part
        protocol.buffer_updated(len(part))
        data = data[len(part) :]


def run_virtual(
    main: Coroutine[Any, Any, T], *, rng: random.Random | None = None, seen: Seen | None = None
) -> T:
    """Run a coroutine to its end in virtual time; raises Stuck for a deadlock."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(rng, seen)) as runner:
        return runner.run(main)


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Run a test in virtual time."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        return run_virtual(test(*args, **kwargs))

    return run
