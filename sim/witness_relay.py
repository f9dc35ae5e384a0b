"""A relay in a real wire, which forwards bytes and passes a copy to a witness.

Bytes are forwarded before they are checked, to add as little latency as possible.
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
from sim.witness.capture import Direction
from sim.witness.endpoint import WireEndpoint
from sim.witness.witness import Witness

_READ_MAX = 4096
_WAKE_INTERVAL = 0.005  # s; a longer delay of this program is told to the witness

_logger = logging.getLogger(__name__)


@asynccontextmanager
async def relays(
    endpoints: Sequence[WireEndpoint],
    names: Sequence[str],
    witness: Witness,
) -> AsyncIterator[list[str]]:
    """Relay these endpoints, each under the witness's name of its wire; yields the URLs to use.

    Endpoints of one wire share a relay. Raises LinkError where a wire cannot be opened.
    """
    relayed: dict[str, str] = {}
    observer = _Observer(witness)
    async with contextlib.AsyncExitStack() as stack:
        for endpoint, name in zip(endpoints, names, strict=True):
            if endpoint.location not in relayed:
                relay = _serial_relay if endpoint.is_device else _tcp_relay
                relayed[endpoint.location] = await stack.enter_async_context(
                    relay(endpoint, name, observer)
                )
        watching = asyncio.create_task(observer.watch())
        try:
            yield [endpoint.url_via(relayed[endpoint.location]) for endpoint in endpoints]
        finally:
            watching.cancel()


class _Observer:
    """Passes what is on the wires to a witness, and the delays of this program before it."""

    def __init__(self, witness: Witness) -> None:
        self.witness = witness
        self._due = time.monotonic()

    def record(self, wire: str, direction: Direction, at: float, data: bytes) -> None:
        """Pass on bytes that were read or written at a time [s]."""
        self._check()
        self.witness.record_bytes(wire, direction, at, data)

    async def watch(self) -> None:
        """Measure how late this program wakes up, until cancelled."""
        while True:
            self._due = time.monotonic() + _WAKE_INTERVAL
            await asyncio.sleep(_WAKE_INTERVAL)
            self._check()

    def _check(self) -> None:
        now = time.monotonic()
        if (late := now - self._due) > _WAKE_INTERVAL:
            self.witness.delayed(now, late)
            self._due = now


@asynccontextmanager
async def _serial_relay(
    endpoint: WireEndpoint, name: str, observer: _Observer
) -> AsyncIterator[str]:
    """Relay a serial port through a pseudo-terminal."""
    try:
        port = serial.Serial(endpoint.location, baudrate=endpoint.baud, timeout=0, exclusive=True)
    except (OSError, ValueError) as problem:
        number = getattr(problem, "errno", None)
        reason = os.strerror(number) if number else problem
        raise LinkError(
            f"serial port {endpoint.location}: cannot be opened: {reason}; check its name, and "
            "close other programs that use it"
        ) from problem
    loop = asyncio.get_running_loop()

    def to_amplifier(data: bytes) -> None:
        before = time.monotonic()  # it arrives afterwards, however long this program is delayed
        with contextlib.suppress(OSError):
            port.write(data)
        observer.record(name, "amplifier", before, data)

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
            observer.witness.closed(name, time.monotonic())
            return
        at = time.monotonic()
        terminal.write(data)
        observer.record(name, "host", at, data)

    with contextlib.closing(port), contextlib.closing(terminal):
        loop.add_reader(port.fileno(), to_host)
        terminal.listen()
        try:
            yield terminal.port
        finally:
            loop.remove_reader(port.fileno())


@asynccontextmanager
async def _tcp_relay(endpoint: WireEndpoint, name: str, observer: _Observer) -> AsyncIterator[str]:
    """Relay a server through a port of the loopback interface."""
    loop = asyncio.get_running_loop()
    host, _, number = endpoint.location.rpartition(":")
    open_now: set[_RelayedConnection] = set()
    opening: set[asyncio.Task[None]] = set()

    def opened(connection: "_RelayedConnection") -> None:
        open_now.add(connection)
        observer.witness.opened(name, time.monotonic())

    def closed(connection: "_RelayedConnection") -> None:
        open_now.discard(connection)
        if not open_now:
            observer.witness.closed(name, time.monotonic())

    def on_data(direction: Direction, at: float, data: bytes) -> None:
        observer.record(name, direction, at, data)

    async def open_back(front: "_RelayedConnection") -> None:
        try:
            _, back = await loop.create_connection(
                lambda: _RelayedConnection("host", on_data, lambda _: None, lambda _: None),
                host,
                int(number),
            )
        except OSError as problem:
            _logger.warning(
                "%s: connection refused (%s), closing the relayed one; check power and URL",
                endpoint.location,
                problem.strerror or problem,
            )
            front.close()
            return
        back.connect(front)
        front.connect(back)

    def make() -> "_RelayedConnection":
        connection = _RelayedConnection("amplifier", on_data, opened, closed)
        task = loop.create_task(open_back(connection))
        opening.add(task)
        task.add_done_callback(opening.discard)
        return connection

    server = await loop.create_server(make, "127.0.0.1", 0)
    try:
        yield f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for connection in tuple(open_now):
            connection.close()
        await asyncio.gather(*opening, return_exceptions=True)
        await server.wait_closed()


class _RelayedConnection(asyncio.Protocol):
    """One of the two connections of a relay, which forwards to the other."""

    def __init__(
        self,
        direction: Direction,
        on_data: Callable[[Direction, float, bytes], None],
        opened: Callable[["_RelayedConnection"], None],
        closed: Callable[["_RelayedConnection"], None],
    ) -> None:
        self._direction: Direction = direction
        self._on_data = on_data
        self._opened = opened
        self._closed = closed
        self._other: _RelayedConnection | None = None
        self._early = b""
        self._transport: asyncio.Transport | None = None
        self._is_closed = False

    def connect(self, other: "_RelayedConnection") -> None:
        """Connect the other one, and forward the bytes received meanwhile."""
        self._other = other
        early, self._early = self._early, b""
        if early:
            self.data_received(early)
        if self._is_closed:
            other.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Note the transport."""
        self._transport = cast(asyncio.Transport, transport)
        self._opened(self)

    def data_received(self, data: bytes) -> None:
        """Forward, then pass to the witness."""
        if self._other is None or self._other._transport is None:
            self._early += data
            return
        before = time.monotonic()
        self._other._transport.write(data)
        self._on_data(self._direction, before, data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Close the other one, too."""
        self._is_closed = True
        self._closed(self)
        if self._other is not None:
            self._other.close()

    def close(self) -> None:
        """Close the connection."""
        if self._transport is not None:
            self._transport.close()
