"""The amplifiers' side of Modbus: a TCP port on the loopback interface, or a pseudo-terminal.

All amplifiers are behind one port or on one line, each the unit of its number; unit 0 is all of
them. Over TCP unit 255 is the only one too, as gateways and masters without units have it.

Not modelled: parity, two that speak at once. A TCP port that is unplugged hangs up on everybody;
a real cable says nothing.
"""

import asyncio
import socket
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

from drivers import clock
from drivers.errors import LinkError
from drivers.protocol.definition import PROTOCOL
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.modbus.frames import (
    PAUSE,
    Reader,
    Request,
    RtuReader,
    TcpReader,
    rtu_frame,
    tcp_frame,
)
from sim.far_ends.modbus.unit import ModbusUnit
from sim.transport.line import TwoWayLine
from sim.transport.pseudo_terminal import make_terminal

_MAP = PROTOCOL.modbus
_HOST = "127.0.0.1"
_ALONE = 255
_CONNECTIONS_MAX = 16
_UNSENT_MAX = 16384  # bytes; a master that does not read is hung up on
_BITS_PER_BYTE = 11  # start, eight data, parity, stop


class _Units:
    """The units behind one port or line."""

    def __init__(self, devices: Sequence[SimulatedDevice]) -> None:
        self.devices = devices
        self.units = {device.number: ModbusUnit(device) for device in devices}

    def answer(self, request: Request, *, over_tcp: bool) -> bytes | None:
        """The PDU that answers a request, if one does."""
        if request.unit == _MAP["broadcast"]:
            for unit in self.units.values():
                unit.hear(request.pdu)
            return None
        number = request.unit
        if over_tcp and number == _ALONE and len(self.units) == 1:
            number = next(iter(self.units))
        addressed = self.units.get(number)
        return None if addressed is None else addressed.answer(request.pdu)


class _Wire(ABC):
    """One stream of requests, with what befalls it on the way; `send` takes the answers."""

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
        )

    def hang_up(self) -> None:
        """What is on the way is lost."""
        self.line.close()
        if self._timer is not None:
            self._timer.cancel()

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Bytes for the host have arrived there."""

    @abstractmethod
    def reply_to(self, request: Request) -> bytes | None:
        """The frame that answers a request."""

    def _arrived(self, data: bytes) -> None:
        self._take(self.reader.feed(data, clock.now()))

    def _paused(self) -> None:
        self._timer = None
        self._take(self.reader.pause(clock.now()))

    def _take(self, requests: Sequence[Request]) -> None:
        for request in requests:
            frame = self.reply_to(request)
            if frame is not None:
                self.line.outward.send(frame)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self.reader.is_amid:
            # A little more, for a timer may be early by the clock's resolution.
            self._timer = asyncio.get_running_loop().call_later(PAUSE + 0.002, self._paused)


class ModbusRtuEnd(_Wire):
    """A pseudo-terminal on which devices answer, each as the unit of its number.

    speed [bit/s]: bytes take as long as at this speed; None for no time at all. unpluggable: the
    port is named by a link that outlives the pseudo-terminal.
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
        return {device.name: f"{line}#{device.number}" for device in self.units.devices}

    def start(self) -> None:
        """Answer from now on, in the running event loop."""
        self._terminal.listen()
        if self._is_unpluggable:
            self.units.devices[0].on_plug(self._plug)

    def close(self) -> None:
        """Hang up; to be called in the event loop that it was started in."""
        self.hang_up()
        self._terminal.close()

    def send(self, data: bytes) -> None:
        """Bytes for the host have arrived there."""
        self._terminal.write(data)

    def reply_to(self, request: Request) -> bytes | None:
        """The frame that answers a request."""
        pdu = self.units.answer(request, over_tcp=False)
        return None if pdu is None else rtu_frame(request.unit, pdu)

    def _plug(self, is_plugged: bool) -> None:
        self.hang_up()
        self._terminal.plug(is_plugged)


class _Connection(_Wire, asyncio.Protocol):
    """One master over TCP."""

    def __init__(self, end: "ModbusTcpEnd", units: _Units) -> None:
        super().__init__(units, TcpReader(), speed=None)
        self._end = end
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        open_socket: socket.socket = transport.get_extra_info("socket")
        open_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNSENT_MAX)
        self._end.connected(self)

    def data_received(self, data: bytes) -> None:
        self.line.inward.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._end.connections.discard(self)
        self.hang_up()

    def abort(self) -> None:
        """Hang up at once."""
        if self._transport is not None:
            self._transport.abort()

    def send(self, data: bytes) -> None:
        """Bytes for the host have arrived there."""
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(data)
        if self._transport.get_write_buffer_size() > _UNSENT_MAX:
            self._transport.abort()

    def reply_to(self, request: Request) -> bytes | None:
        """The frame that answers a request."""
        pdu = self.units.answer(request, over_tcp=True)
        return None if pdu is None else tcp_frame(request, pdu)


class ModbusTcpEnd:
    """A TCP port on the loopback interface; port 0 is any that is free."""

    def __init__(self, devices: Sequence[SimulatedDevice], *, port: int = 0) -> None:
        self._units = _Units(devices)
        self._is_plugged = True
        self.connections: set[_Connection] = set()
        self._server: asyncio.Server | None = None
        self._port = port

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name; once it has started."""
        return {
            device.name: f"modbus+tcp://{_HOST}:{self._port}/{device.number}"
            for device in self._units.devices
        }

    async def start(self) -> None:
        """Answer from now on; raises LinkError where the port is taken."""
        try:
            self._server = await asyncio.get_running_loop().create_server(
                lambda: _Connection(self, self._units), _HOST, self._port
            )
        except OSError as error:
            raise LinkError(
                f"port {self._port} cannot be listened on ({error.strerror or error}); take "
                "another, or 0 for any"
            ) from error
        self._port = self._server.sockets[0].getsockname()[1]
        self._units.devices[0].on_plug(self._plug)

    async def close(self) -> None:
        """Hang up and listen no more."""
        self._drop_all()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def connected(self, connection: _Connection) -> None:
        """A master has come."""
        if not self._is_plugged or len(self.connections) >= _CONNECTIONS_MAX:
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
