"""A relay in a real wire, which forwards bytes and passes a copy to a witness.

Bytes are forwarded before they are checked, to add as little latency as possible.
"""

import asyncio
import contextlib
import logging
import os
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass

import serial

from drivers.errors import CommandError, LinkError
from drivers.urls import Place
from drivers.wires.known import address_of
from model.errors import InputError
from sim.transport.pseudo_terminal import PseudoTerminal
from sim.witness.capture import Direction
from sim.witness.witness import Witness

_KINDS = {
    **dict.fromkeys(("serial", "serial+tcp"), "serial"),
    **{"modbus+tcp": "modbus-tcp", "modbus+rtu": "modbus-rtu"},
    **{"can+socketcand": "socketcand", "can+slcan": "slcan"},
}
"""Kinds of wire by scheme."""


@dataclass(frozen=True)
class WireEndpoint:
    """A parsed URL. kind: of wire; location: device or HOST:PORT; address: on the wire.

    baud: of a serial device, 0 for a port of the network.
    """

    url: str
    kind: str
    location: str
    address: int
    baud: int

    def url_via(self, other: str) -> str:
        """The URL with another location."""
        return self.url.replace(self.location, other, 1)


def parse_endpoint(url: str) -> WireEndpoint:
    """Parse a URL; raises InputError where no relay is possible."""
    try:
        address = address_of(url)
    except CommandError as problem:
        raise InputError(str(problem)) from problem
    kind = _KINDS.get(url.partition("://")[0].lower())
    place = getattr(address, "place", None)
    if kind is None or not isinstance(place, Place) or place.name not in url:
        known = ", ".join(_KINDS)
        raise InputError(f"{url}: scheme must be one of {known}, with a device or HOST:PORT")
    return WireEndpoint(url, kind, place.name, address.number, place.baud if place.device else 0)


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
                relay = _serial_relay if endpoint.baud else _tcp_relay
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
        at = time.monotonic()
        if data:
            terminal.write(data)
            observer.record(name, "host", at, data)
        else:
            loop.remove_reader(port.fileno())
            observer.witness.closed(name, at)

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
    host, _, port = endpoint.location.rpartition(":")
    running: set[asyncio.Task[None]] = set()

    async def forward(source: StreamReader, sink: StreamWriter, direction: Direction) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(_READ_MAX):
                before = time.monotonic()
                sink.write(data)
                observer.record(name, direction, before, data)

    async def relay(from_host: StreamReader, to_host: StreamWriter) -> None:
        with contextlib.closing(to_host):
            try:
                from_amplifier, to_amplifier = await asyncio.open_connection(host, int(port))
            except OSError as problem:
                _logger.warning(
                    "%s: connection refused (%s), closing the relayed one; check power and URL",
                    endpoint.location,
                    problem.strerror or problem,
                )
                return
            with contextlib.closing(to_amplifier):
                ways = [
                    asyncio.ensure_future(forward(from_host, to_amplifier, "amplifier")),
                    asyncio.ensure_future(forward(from_amplifier, to_host, "host")),
                ]
                try:
                    await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for way in ways:
                        way.cancel()

    def opened(from_host: StreamReader, to_host: StreamWriter) -> None:
        observer.witness.opened(name, time.monotonic())
        task = asyncio.ensure_future(relay(from_host, to_host))
        running.add(task)
        task.add_done_callback(closed)

    def closed(task: asyncio.Task[None]) -> None:
        running.discard(task)
        if not running:
            observer.witness.closed(name, time.monotonic())

    server = await asyncio.start_server(opened, "127.0.0.1", 0)
    try:
        yield f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for task in tuple(running):
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await server.wait_closed()
