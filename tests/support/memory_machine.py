"""Serial lines, CAN adapters and workers in memory, for virtual time.

Backends and far ends write real bytes, which arrive after random delays, sometimes in two pieces.
Blocking code runs in greenlets instead of threads, whose order would be undefined.
"""

import asyncio
import contextlib
import contextvars
import queue
import random
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, TypeVar, cast

from greenlet import getcurrent, greenlet

from drivers.codec.can_bus.adapter_text import (
    SlcanReader,
    SocketcandReader,
    slcan_line,
    socketcand_element,
)
from drivers.codec.can_bus.canopen import CanFrame
from drivers.errors import LinkError
from drivers.hardware import HARDWARE_PROVIDER, Adapter, HardwareProvider, Worker
from drivers.urls.can_bus import CanBusUrl
from sim.transport.pseudo_terminal import TERMINAL_MAKER, Terminal
from virtual_loop import VirtualLoop

T = TypeVar("T")

_PASSING = (50e-6, 900e-6)  # s; through driver and adapter
_SPLIT = 0.1  # share of pieces that arrive in two
_NOTICED = 0.002  # s; until the host notices a hang-up


class MemoryMachine(HardwareProvider):
    """Ports by name; `make_terminal` is for far ends, the rest for backends."""

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop = loop
        self._terminals: dict[str, MemoryTerminal] = {}
        self._open: dict[str, MemoryPort] = {}

    def make_terminal(
        self, on_data: Callable[[bytes], None], *, unpluggable: bool
    ) -> "MemoryTerminal":
        terminal = MemoryTerminal(self, f"/dev/memory{len(self._terminals)}", on_data)
        self._terminals[terminal.port] = terminal
        return terminal

    async def open_port(
        self, name: str, *, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> "MemoryPort":
        """Open the host's side of a line; LinkError if it is unplugged or open already."""
        await asyncio.sleep(self._loop.rng.uniform(*_PASSING))
        terminal = self._terminals.get(name)
        if terminal is None or not terminal.is_plugged:
            raise LinkError(f"serial port {name} cannot be opened: no such port")
        if name in self._open:
            raise LinkError(f"serial port {name} cannot be opened: in use by another program")
        port = self._open[name] = MemoryPort(self, terminal, on_data, on_loss)
        return port

    async def open_adapter(
        self,
        url: CanBusUrl,
        *,
        on_frame: Callable[[CanFrame], None],
        on_loss: Callable[[str], None],
    ) -> Adapter:
        """Open slcan on a line in memory, or socketcand over the loop's network."""
        if url.interface == "slcan":
            slcan = _Slcan(on_frame)
            slcan.port = await self.open_port(url.channel, on_data=slcan.heard, on_loss=on_loss)
            slcan.port.write(b"C\rS6\rO\r")
            return slcan
        try:
            _, client = await self._loop.create_connection(
                lambda: _Socketcand(url, on_frame, on_loss), url.host, url.port
            )
            async with asyncio.timeout(2.0):
                await client.is_raw.wait()
        except OSError as problem:
            raise LinkError(f"CAN bus {url} cannot be opened: {problem}") from problem
        return cast(Adapter, client)

    def make_worker(self) -> "GreenletWorker":
        return GreenletWorker()

    def below(self, limit: int) -> int:
        return self._loop.rng.randrange(limit)

    def kill_host(self) -> None:
        """Close the host's ports without notice, as when its process dies."""
        for port in tuple(self._open.values()):
            port.close()

    def closed(self, name: str) -> None:
        self._open.pop(name, None)

    def deliver(self, link: str, toward: str, data: bytes, to: "_Direction") -> None:
        """Deliver bytes in order, after a delay, perhaps in two pieces."""
        loop, pieces = self._loop, [data]
        loop.seen(link, toward, data)
        if len(data) > 1 and loop.rng.random() < _SPLIT:
            at = loop.rng.randrange(1, len(data))
            pieces = [data[:at], data[at:]]
        for piece in pieces:
            # Timers of one moment run in any order; bytes of one line must not.
            soonest = to.arrives + 1e-9
            to.arrives = max(soonest, loop.time() + loop.rng.uniform(*_PASSING))
            loop.call_at(to.arrives, to.take, piece)

    def later(self, delay: float, callback: Callable[..., None], *args: Any) -> None:
        self._loop.call_later(delay, callback, *args)

    def opened(self, name: str) -> "MemoryPort | None":
        return self._open.get(name)


def live_in_memory() -> MemoryMachine:
    """Connect backends and far ends of the running virtual loop in memory."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    machine = MemoryMachine(loop)
    random.seed(loop.rng.random())  # of tokens
    HARDWARE_PROVIDER.set(machine)
    TERMINAL_MAKER.set(machine.make_terminal)
    return machine


class _Direction:
    """One direction of a line, until it is unplugged."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self.arrives = 0.0
        self.is_cut = False
        self._take = take

    def take(self, piece: bytes) -> None:
        """Take a piece, unless the line was cut or closed meanwhile."""
        if not self.is_cut:
            self._take(piece)


class MemoryTerminal(Terminal):
    """The far end's side of a line."""

    def __init__(self, machine: MemoryMachine, name: str, on_data: Callable[[bytes], None]) -> None:
        self.dropped = 0
        self.is_plugged = True
        self._machine = machine
        self._name = name
        self._on_data = on_data
        self.inward = _Direction(on_data)

    @property
    def port(self) -> str:
        return self._name

    def plug_in(self) -> None:
        if not self.is_plugged:
            self.is_plugged = True
            self.inward = _Direction(self._on_data)

    def listen(self) -> None:
        """Bytes arrive without it."""

    def unplug(self) -> None:
        if not self.is_plugged:
            return
        self.is_plugged = False
        self.inward.is_cut = True
        port = self._machine.opened(self._name)
        if port is not None:
            port.hang_up()

    def close(self) -> None:
        self.unplug()

    def write(self, data: bytes) -> None:
        """Send to the host; without an open port, bytes are lost."""
        port = self._machine.opened(self._name)
        if self.is_plugged and port is not None:
            self._machine.deliver(self._name, "host", data, port.outward)


class MemoryPort:
    """The host's side of a line."""

    def __init__(
        self,
        machine: MemoryMachine,
        terminal: MemoryTerminal,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._machine = machine
        self._terminal = terminal
        self._on_loss = on_loss
        self._is_closed = self._is_hung_up = False
        self.outward = _Direction(on_data)

    @property
    def is_blocked(self) -> bool:
        return False

    def poll(self) -> None:
        """All that has come was handed over."""

    def write(self, data: bytes) -> None:
        if self._is_closed or self._is_hung_up:
            raise LinkError(f"serial line {self._terminal.port} was lost")
        self._machine.deliver(self._terminal.port, "amplifier", data, self._terminal.inward)

    def hang_up(self) -> None:
        """Cut the line; the host notices a little later."""
        self._is_hung_up = self.outward.is_cut = True
        self._machine.closed(self._terminal.port)
        self._machine.later(_NOTICED, self._notice)

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = self.outward.is_cut = True
            if not self._is_hung_up:
                self._machine.closed(self._terminal.port)

    async def wait_closed(self) -> None:
        """Return at once."""

    def _notice(self) -> None:
        if not self._is_closed:
            self._on_loss(f"serial line {self._terminal.port} was lost (it hung up)")


class _Slcan:
    """A serial adapter for CAN."""

    def __init__(self, on_frame: Callable[[CanFrame], None]) -> None:
        self.port: MemoryPort
        self._on_frame = on_frame
        self._reader = SlcanReader()

    def heard(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            self._on_frame(frame)

    def send(self, frames: Sequence[CanFrame]) -> int:
        self.port.write(b"".join(map(slcan_line, frames)))
        return len(frames)

    def close(self) -> None:
        with contextlib.suppress(LinkError):  # already lost
            self.port.write(b"C\r")
        self.port.close()

    async def wait_closed(self) -> None:
        """Return at once."""


class _Socketcand(asyncio.Protocol):
    """A client of the socketcand daemon."""

    def __init__(
        self,
        url: CanBusUrl,
        on_frame: Callable[[CanFrame], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self.is_raw = asyncio.Event()
        self._url = url
        self._on_frame, self._on_loss = on_frame, on_loss
        self._reader = SocketcandReader()
        self._answers = 0
        self._transport: asyncio.Transport | None = None
        self._is_closed = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        if not self.is_raw.is_set():
            for _ in range(data.count(b"< hi >") + data.count(b"< ok >")):
                self._shake_hands()
        if not self._is_closed:
            for frame in self._reader.feed(data):
                self._on_frame(frame)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if not self._is_closed:
            self._on_loss(f"the CAN bus {self._url} was lost (the socketcand server hung up)")

    def send(self, frames: Sequence[CanFrame]) -> int:
        if self._transport is None:
            raise LinkError(f"the CAN bus {self._url} was lost")
        self._transport.write(b"".join(map(socketcand_element, frames)))
        return len(frames)

    def close(self) -> None:
        self._is_closed = True
        if self._transport is not None:
            self._transport.close()

    async def wait_closed(self) -> None:
        """Return at once."""

    def _shake_hands(self) -> None:
        said = (f"< open {self._url.channel} >", "< rawmode >")
        if self._answers < len(said) and self._transport is not None:
            self._transport.write(said[self._answers].encode())
        else:
            self.is_raw.set()
        self._answers += 1


class GreenletWorker(Worker):
    """Runs blocking jobs in greenlets; the event loop runs while one waits."""

    def __init__(self) -> None:  # without a thread
        self._turn = asyncio.Lock()
        self._tasks: list[asyncio.Task[Any]] = []

    def submit(self, job: Callable[[], T]) -> "asyncio.Future[T]":
        task = asyncio.get_running_loop().create_task(self._run(job))
        self._tasks = [known for known in self._tasks if not known.done()] + [task]
        return task

    async def close(self) -> None:
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def make_queue(self) -> "queue.Queue[bytes]":
        return cast("queue.Queue[bytes]", _GreenletQueue())

    def sleep(self, seconds: float) -> None:
        _wait_for(asyncio.sleep(seconds))

    async def _run(self, job: Callable[[], T]) -> T:
        async with self._turn:
            return await _in_greenlet(job)


class _GreenletQueue:
    """The used part of queue.Queue."""

    def __init__(self) -> None:
        self._items: deque[bytes] = deque()
        self._came = asyncio.Event()

    def put(self, item: bytes) -> None:
        self._items.append(item)
        self._came.set()

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        """Return the next item; queue.Empty after a timeout [s]."""
        if not self._items:
            _wait_for(self._arrival(timeout))
        return self.get_nowait()

    def get_nowait(self) -> bytes:
        if not self._items:
            raise queue.Empty
        return self._items.popleft()

    def qsize(self) -> int:
        return len(self._items)

    def empty(self) -> bool:
        return not self._items

    async def _arrival(self, timeout: float | None) -> None:
        self._came.clear()
        try:
            async with asyncio.timeout(timeout):
                await self._came.wait()
        except TimeoutError:
            pass


async def _in_greenlet(job: Callable[[], T]) -> T:
    """Run blocking code; await what it passes to `_wait_for`."""
    child = greenlet(job)
    child.gr_context = contextvars.copy_context()
    step = child.switch()
    while not child.dead:
        try:
            result = await step
        except BaseException as error:
            step = child.throw(error)
        else:
            step = child.switch(result)
    return cast(T, step)


def _wait_for(awaitable: Awaitable[T]) -> T:
    """Wait within blocking code that runs in a greenlet."""
    parent = getcurrent().parent
    assert parent is not None
    return cast(T, parent.switch(awaitable))
