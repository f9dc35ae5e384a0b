"""Far ends without I/O, served in the running event loop: on pseudo-terminals and TCP ports."""

import asyncio
import math
import socket
from collections.abc import Callable, Sequence
from typing import Protocol, cast

from drivers import clock
from sim.bench.faulted_device import FaultedDevice
from sim.transport.line import TwoWayLine
from sim.transport.loopback import listen, port_of
from sim.transport.pseudo_terminal import make_terminal

_MAX_CONNECTIONS = 16
_MAX_UNSENT = 16384  # bytes; then a client that does not read is disconnected


class FarEnd(Protocol):
    """The amplifiers' side of a wire, without I/O."""

    @property
    def next_event(self) -> float:
        """Time [s] at which it is to be ticked; infinite: never."""

    def tick(self, now: float) -> None:
        """Process what is due by a time [s]."""

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""


MakeEnd = Callable[[Callable[[bytes], None]], FarEnd]
"""Makes a far end, of the function that it sends by."""


class Served:
    """A far end with its timer; now: the time [s] of what it receives."""

    def __init__(self, end: FarEnd, now: Callable[[], float] = clock.now) -> None:
        self._end = end
        self._now = now
        self._timer: asyncio.TimerHandle | None = None

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        self._end.receive(data, self._now())
        self.schedule()

    def schedule(self) -> None:
        """Have it ticked when its next event is due."""
        self.close()
        due = self._end.next_event
        if due < math.inf:
            self._timer = asyncio.get_running_loop().call_at(due, self._tick)

    def close(self) -> None:
        """Stop its timer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self._timer = None
        self._end.tick(clock.now())
        self.schedule()


class TerminalEnd:
    """A pseudo-terminal in front of devices; faults of frames are those of the first.

    bits_per_second: None for no transmission time; unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        devices: Sequence[FaultedDevice],
        make_end: MakeEnd,
        *,
        bits_per_second: int | None,
        bits_per_byte: float,
        unpluggable: bool,
    ) -> None:
        self._first = devices[0]
        self._line = TwoWayLine(
            to_amplifier=lambda data: self._served.receive(data),
            to_host=lambda data: self._terminal.write(data),
            faults=self._first.faults,
            bits_per_second=bits_per_second,
            bits_per_byte=bits_per_byte,
        )
        self._served = Served(make_end(self._line.outward.send))
        self._terminal = make_terminal(self._line.inward.send, unpluggable=unpluggable)
        self._is_unpluggable = unpluggable

    @property
    def port(self) -> str:
        """The path of the host's side."""
        return self._terminal.port

    @property
    def dropped_replies(self) -> int:
        """Replies lost because the host did not read."""
        return self._terminal.dropped

    def start(self) -> None:
        """Serve in the running event loop."""
        self._terminal.listen()
        if self._is_unpluggable:
            self._first.on_plug(self._plug)

    def close(self) -> None:
        """Close, in the event loop of `start`."""
        self._line.close()
        self._served.close()
        self._terminal.close()

    def _plug(self, is_plugged: bool) -> None:
        """Unplug the line, or plug it in again."""
        self._line.close()
        self._terminal.plug(is_plugged)


class TcpEnd:
    """A TCP port on the loopback interface in front of devices; 0 for any.

    make_end: of each connection. An unplugged port closes its connections, unlike a cable.
    """

    def __init__(
        self, devices: Sequence[FaultedDevice], make_end: MakeEnd, *, port: int = 0
    ) -> None:
        self.port = port
        self.first = devices[0]
        self.make_end = make_end
        self.connections: set[_Connection] = set()
        self._is_plugged = True
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        """Listen; raises LinkError where the port is in use."""
        self._server = await listen(lambda: _Connection(self), self.port)
        self.port = port_of(self._server)
        self.first.on_plug(self._plug)

    async def close(self) -> None:
        """Stop listening and close the connections."""
        self._drop_all()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def connected(self, connection: "_Connection") -> None:
        """Note a new client."""
        if not self._is_plugged or len(self.connections) >= _MAX_CONNECTIONS:
            connection.abort()
        else:
            self.connections.add(connection)

    def _drop_all(self) -> None:
        for connection in tuple(self.connections):
            connection.abort()

    def _plug(self, is_plugged: bool) -> None:
        self._is_plugged = is_plugged
        if not is_plugged:
            self._drop_all()


class _Connection(asyncio.Protocol):
    """One client; what is damaged on its way is lost, as TCP finds it."""

    def __init__(self, port: TcpEnd) -> None:
        self._port = port
        self._transport: asyncio.Transport | None = None
        self._line = TwoWayLine(
            to_amplifier=lambda data: self._served.receive(data),
            to_host=self._send,
            faults=port.first.faults,
            finds_damage=True,
        )
        self._served = Served(port.make_end(self._line.outward.send))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        open_socket: socket.socket = transport.get_extra_info("socket")
        open_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MAX_UNSENT)
        self._port.connected(self)

    def data_received(self, data: bytes) -> None:
        self._line.inward.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._port.connections.discard(self)
        self._line.close()
        self._served.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    def _send(self, data: bytes) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(data)
        if self._transport.get_write_buffer_size() > _MAX_UNSENT:
            self._transport.abort()
