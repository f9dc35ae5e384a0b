"""An event loop without threads, files and sockets, on a clock that jumps to whatever comes next.

It has a network of its own: TCP connections between those who listen and connect in it. What runs
twice in it with the same chance runs twice the same, byte for byte.
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

START = 1000.0  # s; a clock that begins at zero hides who takes zero for "never"
_FIRST_PORT = 20_000
_TURNS_MAX = 20_000  # at one moment; nothing needs as many
_LATENCY = (50e-6, 400e-6)  # s; of a loopback connection with something else to do

Seen = Callable[[str, str, bytes], None]
"""Called with a link, the direction (amplifier or host) and the bytes, when they go out."""


class Stuck(Exception):
    """Everybody waits for something that will never come."""


class VirtualLoop(BaseEventLoop):
    """The loop; dice: by which connections take their time, seen: who watches their bytes."""

    def __init__(self, dice: random.Random | None = None, seen: Seen | None = None) -> None:
        self.now = START
        super().__init__()
        self._turns = 0
        self.dice = dice or random.Random(0)
        self.seen: Seen = seen or (lambda link, toward, data: None)
        self._selector = self
        self._servers: dict[int, _Server] = {}
        self._hosts: list[MemoryTransport] = []

    def time(self) -> float:
        """Virtual seconds."""
        return self.now

    @property
    def _clock_resolution(self) -> float:
        """The least that it can go on: no timer comes early."""
        return math.ulp(self.now)

    @_clock_resolution.setter
    def _clock_resolution(self, of_the_machine: float) -> None:
        """What the machine's clock has does not matter."""

    def select(self, timeout: float | None) -> list[Any]:
        """There is no external input: advance to the next timer."""
        self._turns += 1
        if self._turns > _TURNS_MAX:
            self._turns = 0
            raise Stuck(f"{_TURNS_MAX} turns at one moment: something asks itself again for ever")
        if timeout is None:
            raise Stuck("nothing is ready and nothing will ever be: a task waits for ever")
        if timeout > 0:
            self._turns = 0
            self.now = max(self.now, self._scheduled[0].when())
        return []

    def _process_events(self, event_list: list[Any]) -> None:
        """There are none."""

    def _write_to_self(self) -> None:
        """No thread has to be woken."""

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> Any:
        """At once: there are no threads."""
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
        await asyncio.sleep(self.dice.uniform(*_LATENCY))
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
        """Cut all connections off without notice, as when a process dies."""
        for transport in self._hosts:
            transport.die()

    def forget_server(self, port: int) -> None:
        """Stop listening."""
        self._servers.pop(port, None)


class _Socket:
    """What is asked of a socket here."""

    def __init__(self, port: int) -> None:
        self._port = port

    def getsockname(self) -> tuple[str, int]:
        """Where it is."""
        return "127.0.0.1", self._port

    def setsockopt(self, *_: Any) -> None:
        """Nothing is too large for memory."""


class _Server:
    """A listener."""

    def __init__(self, loop: VirtualLoop, port: int, factory: Callable[[], Any]) -> None:
        self.factory = factory
        self.sockets = [_Socket(port)]
        self._loop = loop
        self._port = port

    def close(self) -> None:
        """Listen no more."""
        self._loop.forget_server(self._port)

    async def wait_closed(self) -> None:
        """It is."""


class MemoryTransport(asyncio.Transport):
    """One side of a connection; toward: whom its bytes go to."""

    def __init__(self, loop: VirtualLoop, protocol: Any, link: str, toward: str) -> None:
        super().__init__()
        self.peer: MemoryTransport
        self._loop = loop
        self._protocol = protocol
        self._link = link
        self._toward = toward
        self._arrives = 0.0  # of what was sent last
        self._is_closed = False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """A socket, which is all that is ever asked for."""
        return _Socket(0) if name == "socket" else default

    def get_write_buffer_size(self) -> int:
        """Nothing waits."""
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
        """Hang up, here and there."""
        if not self._is_closed:
            self._hang_up()
            self._later(self.peer._hang_up)

    def abort(self) -> None:
        """As close: nothing waits to be sent."""
        self.close()

    def die(self) -> None:
        """Hang up on the other side without notice to this one."""
        if not self._is_closed:
            self._is_closed = True
            self._later(self.peer._hang_up)

    def _received(self, data: bytes) -> None:
        if not self._is_closed:
            self._protocol.data_received(data)

    def _hang_up(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._loop.call_soon(self._protocol.connection_lost, None)

    def _later(self, callback: Callable[..., None], *args: Any) -> None:
        loop = self._loop
        # Timers of one moment come in any order, bytes of one connection do not.
        soonest = self._arrives + 1e-9
        self._arrives = max(soonest, loop.time() + loop.dice.uniform(*_LATENCY))
        loop.call_at(self._arrives, callback, *args)


def run_virtual(
    main: Coroutine[Any, Any, T], *, dice: random.Random | None = None, seen: Seen | None = None
) -> T:
    """Run a coroutine to its end in virtual time; raises Stuck where it never ends."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(dice, seen)) as runner:
        return runner.run(main)


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Let a test run to its end in virtual time."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        return run_virtual(test(*args, **kwargs))

    return run
