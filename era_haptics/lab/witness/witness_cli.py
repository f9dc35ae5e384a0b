"""`era witness`: check the traffic of amplifiers, from a capture or live by a relay in the wire.

A relay forwards bytes before they are checked, to add as little latency as possible.
"""

import asyncio
import contextlib
import json
import logging
import math
import sys
from asyncio import StreamReader, StreamWriter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, TextIO

import typer

from drivers.errors import CommandError, LinkError
from drivers.ports import open_port
from drivers.urls import Endpoint
from drivers.wires.known import address_of
from era_haptics.lab.witness.capture import Direction, WireKind
from era_haptics.lab.witness.witness import Witness
from model.errors import InputError
from model.quantities import counted
from registry import threads
from registry.files import regular_file
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

    def record(self, wire: str, direction: Direction, at: float, data: bytes) -> None:
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


def witness(
    urls: Annotated[list[str], typer.Argument(metavar="URL...", help="URLs of the amplifiers.")],
    replay: Annotated[
        Path | None,
        typer.Option(metavar="CAPTURE", help="Check a capture instead of live wires."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a capture of all traffic.")
    ] = None,
    frequency: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Allowed frequencies [Hz].")
    ] = "10,3276.75",
    level: Annotated[
        float, typer.Option(metavar="LEVEL", help="Highest allowed level, 0..1.")
    ] = 1.0,
    slew: Annotated[
        float | None, typer.Option(metavar="PER_S", help="Highest allowed rise of a level [1/s].")
    ] = None,
    channels: Annotated[
        int, typer.Option(metavar="N", help="Channels of each amplifier.", min=1, max=16)
    ] = 4,
    slack: Annotated[
        float, typer.Option(metavar="MS", help="Tolerance of times on this machine [ms].")
    ] = 20.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check the traffic of amplifiers against the protocol.

    Print a relay URL for each amplifier, to be used in its place, and check until Ctrl-C. Exit
    status 1 on violations.
    """
    from era_haptics.lab.witness.capture import (
        AmplifierConfig,
        ChannelLimits,
        TimeLimits,
        WitnessConfig,
    )
    from era_haptics.lab.witness.witness import Witness

    limits = ChannelLimits(
        _band(frequency),
        _in_range("--level", level, maximum=1.0, unit="of full stroke"),
        math.inf if slew is None else _in_range("--slew", slew, unit="of full stroke a second"),
    )
    slack = _in_range("--slack", slack, unit="ms")
    if replay is not None and record is not None:
        raise InputError("--record and --replay exclude each other: give one of them")
    endpoints = [parse_endpoint(url) for url in urls]
    _check_apart(endpoints)
    locations = dict.fromkeys(each.location for each in endpoints)
    wires = {location: f"wire{number}" for number, location in enumerate(locations, 1)}
    of_all = dict.fromkeys(range(channels), limits)
    config = WitnessConfig(
        {wires[each.location]: each.kind for each in endpoints},
        {
            each.url: AmplifierConfig(wires[each.location], each.address, of_all)
            for each in endpoints
        },
        TimeLimits(slack=slack * 1e-3),
    )
    with _capture(record) as write:
        checker = Witness(config, record=write)
        if replay is not None:
            end = _replay(replay, checker)
        else:
            to = sys.stderr if as_json else sys.stdout
            end = _relay(endpoints, [wires[each.location] for each in endpoints], checker, to=to)
        found = checker.finish(end)
        if as_json:
            listed = {"frames": checker.frames, "violations": [asdict(each) for each in found]}
            print(json.dumps(listed))
        else:
            counts = f"{counted(checker.frames, 'frame')}, {counted(len(found), 'violation')}"
            print(*found, counts, sep="\n")
    if found:
        raise typer.Exit(1)


def _band(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not 0 <= low <= high < math.inf:
        raise InputError(f"--frequency must be LOW,HIGH in Hz, as in 40,500, got {text!r}")
    return low, high


def _in_range(option: str, given: float, *, maximum: float = math.inf, unit: str) -> float:
    if not 0 <= given <= maximum or math.isinf(given):
        to = "or more" if math.isinf(maximum) else f"to {maximum:g}"
        raise InputError(f"{option} must be 0 {to} {unit}, got {given:g}")
    return given


def _check_apart(endpoints: list["WireEndpoint"]) -> None:
    """Refuse two URLs for one amplifier, or for one wire in two ways."""
    for other, endpoint in combinations(endpoints, 2):
        is_same_wire = endpoint.location == other.location
        if is_same_wire and endpoint.kind != other.kind:
            raise InputError(
                f"{other.url} and {endpoint.url}: one wire cannot be {other.kind} and "
                f"{endpoint.kind}; give the URL of its actual protocol"
            )
        if is_same_wire and endpoint.address == other.address:
            raise InputError(
                f"{other.url} and {endpoint.url}: both are amplifier {endpoint.address} of one "
                "wire; give each amplifier once, by its address"
            )


@contextmanager
def _capture(path: Path | None) -> Iterator[Callable[[str], None]]:
    """Yield what appends a line to a capture file, if there is one; its end tells what was lost.

    Relaying goes on where writing fails. Raises InputError where it cannot be opened, or is
    incomplete.
    """
    problems: list[OSError] = []
    try:
        opened = path and open(path, "w", encoding="utf-8", opener=regular_file)  # noqa: SIM115
    except OSError as problem:
        raise InputError(f"--record {path}: cannot be written: {problem.strerror}") from problem

    def write(line: str) -> None:
        if opened and not problems:
            try:
                print(line, file=opened)
            except OSError as problem:
                problems.append(problem)

    try:
        yield write
    finally:
        try:
            if opened:
                opened.close()
        except OSError as problem:
            problems.append(problem)
        if problems:
            raise InputError(
                f"--record {path}: capture incomplete: {problems[0].strerror}; free disk space, or "
                "record elsewhere"
            ) from problems[0]


def _replay(path: Path, checker: "Witness") -> float:
    """Check a capture; returns its end [s]."""
    from era_haptics.lab.witness.capture import read_capture

    end = None
    for end, wire, direction, data in read_capture(path, wires=checker.wires):
        checker.record_bytes(wire, direction, end, data)
    if end is None or not checker.frames:
        raise InputError(
            f"{path}: no frame decoded, nothing was checked; write lines TIME WIRE > HEX, and give "
            "URLs of the captured kind of wire"
        )
    return end


def _relay(
    endpoints: list["WireEndpoint"], names: list[str], checker: "Witness", *, to: TextIO
) -> float:
    """Relay until a signal comes; returns when that was [s]."""
    import asyncio
    import signal
    import time

    async def run() -> None:
        ended = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        async with relays(endpoints, names, checker) as ends:
            for endpoint, end in zip(endpoints, ends, strict=True):
                print(endpoint.url, end, sep="  ", file=to, flush=True)
            print(
                "checking what passes the right URL, to be used in place of the left; a server is "
                "connected to when a host is; Ctrl-C ends",
                file=sys.stderr,
            )
            await ended.wait()

    asyncio.run(run())
    if not checker.frames:
        raise InputError(
            "no frame passed, nothing was checked; use the relay URLs in place of the amplifiers'"
        )
    return time.monotonic()
