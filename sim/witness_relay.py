"""A relay in a real wire: it passes bytes on and shows them to a witness.

A host uses the relay's end instead of the wire's; what it sends goes to the amplifier as it comes,
and back. Bytes are passed on first and looked at then, so a relay adds what the system needs to
hand them over twice.
"""

import asyncio
import contextlib
import logging
import os
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import cast

import serial

from drivers.errors import LinkError
from sim.transport.pseudo_terminal import PseudoTerminal
from sim.witness.decoded import Direction
from sim.witness.endpoint import WireEndpoint
from sim.witness.witness import Witness

_READ_MAX = 4096

_logger = logging.getLogger(__name__)


@asynccontextmanager
async def relays(
    places: Sequence[WireEndpoint],
    names: Sequence[str],
    witness: Witness,
) -> AsyncIterator[list[str]]:
    """Stand in these wires, each the witness's wire of its name; the URLs to use instead.

    Places that are one wire share a relay. Raises LinkError where a wire cannot be opened.
    """
    ends: dict[str, str] = {}
    async with contextlib.AsyncExitStack() as stack:
        for place, name in zip(places, names, strict=True):
            if place.place in ends:
                continue
            make = _line if place.is_device else _network
            ends[place.place] = await stack.enter_async_context(make(place, name, witness))
        yield [place.through(ends[place.place]) for place in places]


@asynccontextmanager
async def _line(place: WireEndpoint, name: str, witness: Witness) -> AsyncIterator[str]:
    """A pseudo-terminal in front of a serial port."""
    try:
        port = serial.Serial(place.place, baudrate=place.baud, timeout=0, exclusive=True)
    except (OSError, ValueError) as problem:
        number = getattr(problem, "errno", None)
        said = os.strerror(number) if number else problem
        raise LinkError(
            f"serial port {place.place} cannot be opened: check its name, and that nobody else has "
            f"it open (the system says: {said})"
        ) from problem
    loop = asyncio.get_running_loop()

    def to_amplifier(data: bytes) -> None:
        with contextlib.suppress(OSError):
            port.write(data)
        witness.bytes(name, "amplifier", time.monotonic(), data)

    terminal = PseudoTerminal(to_amplifier)

    def to_host() -> None:
        try:
            data = os.read(port.fileno(), _READ_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            loop.remove_reader(port.fileno())
            witness.closed(name, time.monotonic())
            return
        terminal.write(data)
        witness.bytes(name, "host", time.monotonic(), data)

    with contextlib.closing(port), contextlib.closing(terminal):
        loop.add_reader(port.fileno(), to_host)
        terminal.listen()
        try:
            yield terminal.port
        finally:
            loop.remove_reader(port.fileno())


@asynccontextmanager
async def _network(place: WireEndpoint, name: str, witness: Witness) -> AsyncIterator[str]:
    """A port of the loopback interface in front of a server."""
    loop = asyncio.get_running_loop()
    host, _, number = place.place.rpartition(":")
    open_now: set[_Half] = set()
    opening: set[asyncio.Task[None]] = set()

    def opened(half: "_Half") -> None:
        open_now.add(half)
        witness.opened(name, time.monotonic())

    def closed(half: "_Half") -> None:
        open_now.discard(half)
        if not open_now:
            witness.closed(name, time.monotonic())

    def shown(toward: Direction, data: bytes) -> None:
        witness.bytes(name, toward, time.monotonic(), data)

    async def connect(front: "_Half") -> None:
        try:
            _, back = await loop.create_connection(
                lambda: _Half("host", shown, lambda _: None, lambda _: None), host, int(number)
            )
        except OSError as problem:
            _logger.warning(
                "%s takes no connection (%s), so whoever comes to the relay is hung up on: is the "
                "amplifier switched on, and its URL right?",
                place.place,
                problem.strerror or problem,
            )
            front.hang_up()
            return
        back.meet(front)
        front.meet(back)

    def make() -> "_Half":
        half = _Half("amplifier", shown, opened, closed)
        task = loop.create_task(connect(half))
        opening.add(task)
        task.add_done_callback(opening.discard)
        return half

    server = await loop.create_server(make, "127.0.0.1", 0)
    try:
        yield f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for half in tuple(open_now):
            half.hang_up()
        await asyncio.gather(*opening, return_exceptions=True)
        await server.wait_closed()


class _Half(asyncio.Protocol):
    """One of the two connections of a relay; what it hears goes out at the other."""

    def __init__(
        self,
        toward: Direction,
        shown: Callable[[Direction, bytes], None],
        opened: Callable[["_Half"], None],
        closed: Callable[["_Half"], None],
    ) -> None:
        self._toward: Direction = toward
        self._shown = shown
        self._opened = opened
        self._closed = closed
        self._other: _Half | None = None
        self._early = b""
        self._transport: asyncio.Transport | None = None
        self._is_over = False

    def meet(self, other: "_Half") -> None:
        """This is the other one, and what has come meanwhile is for it."""
        self._other = other
        early, self._early = self._early, b""
        if early:
            self.data_received(early)
        if self._is_over:
            other.hang_up()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """It is there."""
        self._transport = cast(asyncio.Transport, transport)
        self._opened(self)

    def data_received(self, data: bytes) -> None:
        """Pass it on, then show it."""
        if self._other is None or self._other._transport is None:
            self._early += data
            return
        self._other._transport.write(data)
        self._shown(self._toward, data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Where one ends, the other does."""
        self._is_over = True
        self._closed(self)
        if self._other is not None:
            self._other.hang_up()

    def hang_up(self) -> None:
        """End it."""
        if self._transport is not None:
            self._transport.close()
