"""The amplifiers' side of Modbus: a TCP port on the loopback interface, or a pseudo-terminal.

All amplifiers share one port or line, each at the unit of its number; unit 0 is broadcast. Over TCP
unit 255 addresses a single amplifier.

Not modelled: parity, collisions. An unplugged TCP port closes its connections, unlike a
cable.
"""

import asyncio
import socket
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

from drivers import clock
from drivers.protocol.definition import PROTOCOL
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.modbus.frames import (
    Reader,
    RequestAdu,
    RtuReader,
    TcpReader,
    rtu_frame,
    tcp_frame,
)
from sim.far_ends.modbus.unit import ModbusUnit
from sim.transport.frame_time import FrameTime
from sim.transport.line import TwoWayLine
from sim.transport.loopback import HOST, listen, port_of
from sim.transport.pseudo_terminal import make_terminal

_MAP = PROTOCOL.modbus
_ANY_UNIT = 255
_MAX_CONNECTIONS = 16
_MAX_UNSENT = 16384  # bytes; then a client that does not read is disconnected
_BITS_PER_BYTE = 11  # start, eight data, parity, stop


class _Units:
    """The units behind one port or line."""

    def __init__(self, devices: Sequence[SimulatedDevice]) -> None:
        self.devices = devices
        self._time = FrameTime()
        for device in devices:
            device.time = self._time.now
        self.units = {device.address: ModbusUnit(device) for device in devices}

    def reply(self, request: RequestAdu, *, over_tcp: bool) -> bytes | None:
        """The reply PDU to a request, or None."""
        if request.unit == _MAP["broadcast"]:
            with self._time.in_one_frame():
                self._broadcast(request.pdu)
            return None
        number = request.unit
        if over_tcp and number == _ANY_UNIT and len(self.units) == 1:
            number = next(iter(self.units))
        addressed = self.units.get(number)
        return None if addressed is None else addressed.reply(request.pdu)

    def _broadcast(self, pdu: bytes) -> None:
        for number, unit in list(self.units.items()):
            taken = unit.handle_broadcast(pdu)
            if taken is not None:
                del self.units[number]
                self.units[taken] = unit


class _Wire(ABC):
    """One stream of requests, with transmission time and faults."""

    def __init__(self, units: _Units, reader: Reader, *, speed: int | None) -> None:
        self.units = units
        self.reader = reader
        self._timer: asyncio.TimerHandle | None = None
        self.line = TwoWayLine(
            to_amplifier=self._arrived,
            to_host=self.send,
            faults=units.devices[0].faults,
            bits_per_second=speed,
            bits_per_byte=_BITS_PER_BYTE,
            finds_damage=isinstance(reader, TcpReader),
        )

    def abandon(self) -> None:
        """Discard what is in flight."""
        self.line.close()
        if self._timer is not None:
            self._timer.cancel()

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send bytes that have arrived at the host's side."""

    def _arrived(self, data: bytes) -> None:
        self._take(self.reader.feed(data, clock.now()))

    def _frame_timeout(self) -> None:
        self._timer = None
        self._take(self.reader.pause(clock.now()))

    def _take(self, requests: Sequence[RequestAdu]) -> None:
        for request in requests:
            over_tcp = isinstance(self.reader, TcpReader)
            pdu = self.units.reply(request, over_tcp=over_tcp)
            if pdu is not None:
                frame = tcp_frame(request, pdu) if over_tcp else rtu_frame(request.unit, pdu)
                self.line.outward.send(frame)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self.reader.has_partial_frame:
            # Timers may be early by the clock's resolution.
            self._timer = asyncio.get_running_loop().call_later(
                self.reader.timeout + 0.002, self._frame_timeout
            )


class ModbusRtuEnd(_Wire):
    """A pseudo-terminal with devices at the units of their numbers.

    speed [bit/s]: None for no transmission time; unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        devices: Sequence[SimulatedDevice],
        *,
        speed: int | None = None,
        unpluggable: bool = False,
    ) -> None:
        super().__init__(_Units(devices), RtuReader(), speed=speed)
        self._baud = speed or _MAP["baud"]
        self._is_unpluggable = unpluggable
        self._terminal = make_terminal(self.line.inward.send, unpluggable=unpluggable)

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name."""
        line = f"modbus+rtu://{self._terminal.port}?baud={self._baud}"
        return {device.name: f"{line}#{device.address}" for device in self.units.devices}

    def start(self) -> None:
        """Serve in the running event loop."""
        self._terminal.listen()
        if self._is_unpluggable:
            self.units.devices[0].on_plug(self._plug)

    def close(self) -> None:
        """Close, in the event loop of `start`."""
        self.abandon()
        self._terminal.close()

    def send(self, data: bytes) -> None:
        """Send bytes that have arrived at the host's side."""
        self._terminal.write(data)

    def _plug(self, is_plugged: bool) -> None:
        self.abandon()
        self._terminal.plug(is_plugged)


class _Connection(_Wire, asyncio.Protocol):
    """One client over TCP."""

    def __init__(self, end: "ModbusTcpEnd", units: _Units) -> None:
        super().__init__(units, TcpReader(), speed=None)
        self._end = end
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        open_socket: socket.socket = transport.get_extra_info("socket")
        open_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MAX_UNSENT)
        self._end.connected(self)

    def data_received(self, data: bytes) -> None:
        self.line.inward.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._end.connections.discard(self)
        self.abandon()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    def send(self, data: bytes) -> None:
        """Send bytes that have arrived at the host's side."""
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(data)
        if self._transport.get_write_buffer_size() > _MAX_UNSENT:
            self._transport.abort()


class ModbusTcpEnd:
    """A TCP port on the loopback interface; 0 for any."""

    def __init__(self, devices: Sequence[SimulatedDevice], *, port: int = 0) -> None:
        self._units = _Units(devices)
        self._is_plugged = True
        self.connections: set[_Connection] = set()
        self._server: asyncio.Server | None = None
        self._port = port

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier by name, after `start`."""
        return {
            device.name: f"modbus+tcp://{HOST}:{self._port}/{device.address}"
            for device in self._units.devices
        }

    async def start(self) -> None:
        """Listen; raises LinkError where the port is in use."""
        self._server = await listen(lambda: _Connection(self, self._units), self._port)
        self._port = port_of(self._server)
        self._units.devices[0].on_plug(self._plug)

    async def close(self) -> None:
        """Stop listening and close the connections."""
        self._drop_all()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def connected(self, connection: _Connection) -> None:
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
