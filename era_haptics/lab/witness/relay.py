"""A relay in a real wire, which forwards bytes and passes a copy to a witness."""

import asyncio
import contextlib
import logging
from asyncio import StreamReader, StreamWriter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass

from drivers.errors import CommandError, LinkError
from drivers.ports import open_port
from drivers.urls import Endpoint
from drivers.wires.wire import address_of
from era_haptics.lab.witness.capture import TransferDirection, WireKind
from era_haptics.lab.witness.witness import Witness
from model.errors import InputError
from registry import threads
from sim.transport.far_end import make_terminal

_KINDS: dict[str, WireKind] = {
    **dict.fromkeys(("serial", "serial+tcp"), "serial"),
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+socketcand": "socketcand",
    "can+slcan": "slcan",
}
"""Kinds of wire by scheme."""


@dataclass(frozen=True)
class WireEndpoint:
    """A parsed URL. kind: of wire; place: its device or port of the network; address: on it."""

    url: str
    kind: WireKind
    place: Endpoint
    address: int

    @property
    def location(self) -> str:
        """The device, or HOST:PORT."""
        return self.place.name

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
    if kind is None or not isinstance(place, Endpoint) or place.name not in url:
        known = ", ".join(_KINDS)
        raise InputError(f"{url}: scheme must be one of {known}, with a device or HOST:PORT")
    return WireEndpoint(url, kind, place, address.number)


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
                relay = _serial_relay if endpoint.place.device else _tcp_relay
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
        self._due = threads.now()

    def record(self, wire: str, direction: TransferDirection, at: float, data: bytes) -> None:
        """Pass on bytes that were read or written at a time [s]."""
        self._check()
        self.witness.record_bytes(wire, direction, at, data)

    async def watch(self) -> None:
        """Measure how late this program wakes up, until cancelled."""
        while True:
            self._due = threads.now() + _WAKE_INTERVAL
            await asyncio.sleep(_WAKE_INTERVAL)
            self._check()

    def _check(self) -> None:
        now = threads.now()
        if (late := now - self._due) > _WAKE_INTERVAL:
            self.witness.delayed(now, late)
            self._due = now


@asynccontextmanager
async def _serial_relay(
    endpoint: WireEndpoint, name: str, observer: _Observer
) -> AsyncIterator[str]:
    """Relay a serial port through a pseudo-terminal."""

    def to_amplifier(data: bytes) -> None:
        before = threads.now()  # it arrives afterwards, however long this program is delayed
        with contextlib.suppress(LinkError):
            port.write(data)
        observer.record(name, "amplifier", before, data)

    def to_host(data: bytes) -> None:
        at = threads.now()
        terminal.write(data)
        observer.record(name, "host", at, data)

    def lost(cause: str) -> None:
        observer.witness.closed(name, threads.now())

    terminal = make_terminal(to_amplifier)
    with contextlib.closing(terminal):
        port = await open_port(endpoint.place, to_host, lost)
        try:
            terminal.listen()
            yield terminal.port
        finally:
            port.close()
            await port.wait_closed()


@asynccontextmanager
async def _tcp_relay(endpoint: WireEndpoint, name: str, observer: _Observer) -> AsyncIterator[str]:
    """Relay a server through a port of the loopback interface."""
    running: set[asyncio.Task[None]] = set()

    async def relay(from_host: StreamReader, to_host: StreamWriter) -> None:
        def received(data: bytes) -> None:
            at = threads.now()
            to_host.write(data)
            observer.record(name, "host", at, data)

        with contextlib.closing(to_host):
            try:
                port = await open_port(endpoint.place, received, lambda cause: to_host.close())
            except LinkError as problem:
                _logger.warning("%s; closing the relayed connection", problem)
                return
            with contextlib.closing(port), contextlib.suppress(OSError, LinkError):
                while data := await from_host.read(_READ_MAX):
                    before = threads.now()
                    port.write(data)
                    observer.record(name, "amplifier", before, data)

    def opened(from_host: StreamReader, to_host: StreamWriter) -> None:
        observer.witness.opened(name, threads.now())
        task = asyncio.ensure_future(relay(from_host, to_host))
        running.add(task)
        task.add_done_callback(closed)

    def closed(task: asyncio.Task[None]) -> None:
        running.discard(task)
        if not running:
            observer.witness.closed(name, threads.now())

    server = await asyncio.start_server(opened, "127.0.0.1", 0)
    try:
        yield f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for task in tuple(running):
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await server.wait_closed()
