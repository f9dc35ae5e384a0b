"""An event loop without threads, files and sockets, on a clock that jumps to the next timer.

It has its own network: TCP connections between listeners and clients of the same loop. Runs with
the same random seed are identical, byte for byte.
"""

import asyncio
import functools
import math
import random
from asyncio.base_events import BaseEventLoop
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

START = 1000.0  # s; not zero, which code could take for "never"
_FIRST_PORT = 20_000
_TURNS_MAX = 20_000  # at one moment; more are an endless loop
_LATENCY = (50e-6, 400e-6)  # s; of a loopback connection

Seen = Callable[[str, str, bytes], None]
"""Called with a link, the direction (amplifier or host) and the bytes, as they are sent."""


class Stuck(Exception):
    """Deadlock: no timer and no ready task, or no progress of time."""


class VirtualLoop(BaseEventLoop):
    """The loop; rng: of the latencies of connections; seen: observer of their bytes."""

    def __init__(self, rng: random.Random | None = None, seen: Seen | None = None) -> None:
        self.now = START
        self.ends = math.inf  # s; afterwards it is stuck
        super().__init__()
        self._turns = 0
        self.rng = rng or random.Random(0)
        self.seen: Seen = seen or (lambda link, toward, data: None)
        self._selector = self
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

    def select(self, timeout: float | None) -> list[Any]:
        """There is no external input: advance to the next timer."""
        self._turns += 1
        if self._turns > _TURNS_MAX:
            self._turns = 0
            raise Stuck(f"{_TURNS_MAX} turns at one moment: a task reschedules itself endlessly")
        if timeout is None:
            raise Stuck("deadlock: no timer and no ready task")
        if self.now > self.ends:
            self.ends = math.inf
            raise Stuck("tasks that do not end although they were cancelled")
        if timeout > 0:
            self._turns = 0
            self.now = max(self.now, self._scheduled[0].when())
        return []

    def _process_events(self, event_list: list[Any]) -> None:
        """No I/O events."""

    def _write_to_self(self) -> None:
        """Do nothing: there are no other threads."""

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> Any:
        """Run at once: there are no threads."""
        future = self.create_future()
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
        await asyncio.sleep(self.rng.uniform(*_LATENCY))
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
            self._protocol.data_received(data)

    def _disconnect(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._loop.call_soon(self._protocol.connection_lost, None)

    def _later(self, callback: Callable[..., None], *args: Any) -> None:
        loop = self._loop
        # Timers of one moment fire in any order; bytes of one connection stay in order.
        soonest = self._arrives + 1e-9
        self._arrives = max(soonest, loop.time() + loop.rng.uniform(*_LATENCY))
        loop.call_at(self._arrives, callback, *args)


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
