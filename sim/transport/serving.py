"""Far ends in the running event loop, each behind a pseudo-terminal or a TCP port.

The module of each far end declares its kinds of wire (`FarEndKind`).
"""

import asyncio
import math
import socket
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Self, TypeAlias, cast

from drivers.errors import LinkError
from drivers.urls import ADDRESS
from registry import threads
from sim.bench.amplifier_device import AmplifierDevice
from sim.faults import Faults
from sim.transport.far_end import FarEnd, SendBytes
from sim.transport.pseudo_terminal import make_terminal
from sim.transport.simulated_line import LineDelays, TwoWayLine

HOST = "127.0.0.1"
_MAX_CONNECTIONS = 16
_MAX_UNSENT = 16384  # bytes; then a client that does not read is disconnected

Numbered: TypeAlias = Mapping[int, AmplifierDevice]
"""Amplifiers by address."""
MakeEnd: TypeAlias = Callable[[SendBytes], FarEnd]
"""Makes a far end from its function to send bytes."""


class TimedFarEnd:
    """A far end with its timer."""

    def __init__(self, end: FarEnd) -> None:
        self._end = end
        self._timer: asyncio.TimerHandle | None = None

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self._end.receive(data, now)
        self.schedule()

    def schedule(self) -> None:
        """Have it ticked when its next event is due."""
        self._cancel()
        due = self._end.next_event
        if due < math.inf:
            self._timer = asyncio.get_running_loop().call_at(due, self._tick)

    def close(self) -> None:
        """Close it and stop its timer."""
        self._end.close()
        self._cancel()

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _tick(self) -> None:
        self._end.tick(threads.now())
        self.schedule()


class TerminalEnd:
    """A pseudo-terminal in front of a far end, as an asynchronous context.

    Host -> terminal -> line inward -> far end -> line outward -> terminal -> host.

    device: injects the faults of the wire (by default, of frames); delays: see `TwoWayLine`;
    unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        device: AmplifierDevice,
        make_end: MakeEnd,
        *,
        faults: Faults | None = None,
        delays: LineDelays | None = None,
        byte_time: float = 0.0,
        unpluggable: bool = False,
    ) -> None:
        self._terminal = make_terminal(self._take, unpluggable=unpluggable)
        self._line = TwoWayLine(
            self._terminal.write,
            faults=device.faults if faults is None else faults,
            delays=delays,
            byte_time=byte_time,
        )
        self._served = TimedFarEnd(make_end(self._line.outward.send))
        self._line.to_amplifier = self._served.receive
        self.port = self._terminal.port
        """The path of the host's side."""
        self._plug_listeners = device.plug_listeners if unpluggable else []

    async def __aenter__(self) -> Self:
        """Serve in the running event loop."""
        self._terminal.listen()
        self._plug_listeners.append(self._plug)
        return self

    async def __aexit__(self, *error: object) -> None:
        """Close."""
        self._plug_listeners.remove(self._plug)
        self._line.close()
        self._served.close()
        self._terminal.close()

    def _take(self, data: bytes) -> None:
        """Put bytes that the terminal has read on the line."""
        self._line.inward.send(data)

    def _plug(self, is_plugged: bool) -> None:
        """Unplug the terminal, which loses the bytes on the line, or plug it in again."""
        self._line.close()
        self._terminal.plug(is_plugged)


class TcpEnd:
    """A TCP port on the loopback interface, 0 for any, as an asynchronous context.

    make_end: of each connection; device, faults and delays: see `TerminalEnd`. An unplugged port
    closes its connections, unlike a cable. Entering it raises LinkError if the port is in use.
    """

    def __init__(
        self,
        device: AmplifierDevice,
        make_end: MakeEnd,
        *,
        faults: Faults | None = None,
        delays: LineDelays | None = None,
        port: int = 0,
    ) -> None:
        self.port = port
        self.delays = delays
        self.faults = device.faults if faults is None else faults
        self.make_end = make_end
        self.connections: set[_TcpClient] = set()
        self._device = device
        self._server: asyncio.Server | None = None

    @property
    def is_open(self) -> bool:
        """Whether it takes one more connection."""
        return self._device.is_plugged and len(self.connections) < _MAX_CONNECTIONS

    async def __aenter__(self) -> Self:
        """Listen."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(partial(_TcpClient, self), HOST, self.port)
        except OSError as error:
            raise LinkError(
                f"port {self.port}: cannot listen: {error.strerror or error}; choose another, or "
                "0 for any"
            ) from error
        self.port = int(self._server.sockets[0].getsockname()[1])
        self._device.plug_listeners.append(self._plug)
        return self

    async def __aexit__(self, *error: object) -> None:
        """Stop listening and close the connections."""
        self._device.plug_listeners.remove(self._plug)
        self._plug(False)
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def _plug(self, is_plugged: bool) -> None:
        if not is_plugged:
            for connection in tuple(self.connections):
                connection.transport.abort()


class _TcpClient(asyncio.Protocol):
    """One connection of a host, from `connection_made` on with a line and a far end.

    Damaged data are lost, because TCP detects them.
    """

    transport: asyncio.Transport
    _line: TwoWayLine
    _served: TimedFarEnd

    def __init__(self, port: TcpEnd) -> None:
        self._port = port

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve the host, or close the connection if the port takes no more."""
        self.transport = cast(asyncio.Transport, transport)
        if not self._port.is_open:
            self.transport.abort()
            return
        self._port.connections.add(self)
        open_socket: socket.socket = transport.get_extra_info("socket")
        open_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MAX_UNSENT)
        self._line = TwoWayLine(
            self._send, faults=self._port.faults, delays=self._port.delays, finds_damage=True
        )
        self._served = TimedFarEnd(self._port.make_end(self._line.outward.send))
        self._line.to_amplifier = self._served.receive

    def data_received(self, data: bytes) -> None:
        """Put received bytes on the line."""
        self._line.inward.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Close the line and the far end."""
        if self in self._port.connections:
            self._port.connections.remove(self)
            self._line.close()
            self._served.close()

    def _send(self, data: bytes) -> None:
        """Send bytes to the host; no bytes end the connection."""
        if self.transport.is_closing():
            return
        self.transport.write(data)
        if not data:
            self.transport.close()
        elif self.transport.get_write_buffer_size() > _MAX_UNSENT:
            self.transport.abort()


@dataclass(frozen=True)
class FarEndKind:
    """A kind of wire to simulated amplifiers; also the form of its URLs.

    name: of `era sim --wire`; url: with {host} for a TCP port; opens: what the host opens, as a
    page has it; speed: usual speed [bit/s]; line_kind: of its line with several amplifiers; end:
    class of its far end, made of the amplifiers by address and the function to send bytes; bits: of
    a byte on the line, with start, parity and stop, 0 if bytes take no time.
    """

    name: str
    url: str
    opens: str
    speed: int
    line_kind: str
    end: Callable[..., FarEnd]
    bits: int = 0

    @property
    def scheme(self) -> str:
        """The scheme of its URLs."""
        return self.url.partition("://")[0]

    @property
    def is_ported(self) -> bool:
        """Whether it is a TCP port."""
        return "{host}" in self.url

    @property
    def is_can(self) -> bool:
        """Whether it is a CAN bus."""
        return self.url.startswith("can")

    def url_of(self, *, port: int | str, speed: int, address: int) -> str:
        """The URL of an amplifier, without options that have their default values."""
        url = self.url.format(host=HOST, port=port, speed=speed, address=address)
        return url.removesuffix(f"&address={ADDRESS}")

    def serve(self, speed: int | None, numbered: Numbered) -> AbstractContextManager[MakeEnd]:
        """Serve amplifiers by address in a context, at a speed; yields how to make far ends."""
        return nullcontext(partial(self.end, numbered))
