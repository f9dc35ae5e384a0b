"""Simulated amplifiers of protocol 3 on real wires: terminals, TCP, CAN servers and adapters."""

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import can

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from sim.amplifier.contract import Amplifier
from sim.far_ends.can_bus.adapters import SlcanAdapter, SocketcandClient
from sim.far_ends.can_bus.amplifiers import CanAmplifiers
from sim.far_ends.can_bus.bus import CanBus
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.far_end import FarEnd
from sim.transport.pseudo_terminal import make_terminal

_READ_TIMEOUT = 0.02  # s; after which the thread of a bus notices its end


@dataclass
class FarSide:
    """Amplifiers by number on a wire; url: of one of them; unplug: cut the wire."""

    amplifiers: Mapping[int, Amplifier]
    url: Callable[[int], str]
    unplug: Callable[[], None] = lambda: None

    def level(self, number: int) -> float:
        """What channel 0 of an amplifier plays now."""
        now = asyncio.get_running_loop().time()
        self.amplifiers[number].tick(now)
        return self.amplifiers[number].playback.level(0, now)


def _amplifiers(count: int) -> dict[int, Amplifier]:
    return {number: Amplifier(str(number), channels=1) for number in range(1, count + 1)}


@asynccontextmanager
async def _terminal(
    count: int, make_end: Callable[..., Any], url: Callable[[str, int], str]
) -> AsyncIterator[FarSide]:
    """Serve amplifiers on a pseudo-terminal."""
    loop = asyncio.get_running_loop()
    terminal = make_terminal(lambda data: end.receive(data, loop.time()))
    far = FarSide(_amplifiers(count), partial(url, terminal.port), terminal.unplug)
    end = make_end(far.amplifiers, terminal.write)
    terminal.listen()
    try:
        yield far
    finally:
        terminal.close()


@asynccontextmanager
async def _server(
    count: int, make_end: Callable[..., Any], url: Callable[[int, int], str]
) -> AsyncIterator[FarSide]:
    """Serve amplifiers on a TCP port, to one host after another."""
    loop = asyncio.get_running_loop()
    amplifiers = _amplifiers(count)
    open_now: set[asyncio.StreamWriter] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        open_now.add(writer)
        end = make_end(amplifiers, writer.write)
        try:
            while data := await reader.read(4096):
                end.receive(data, loop.time())
        except ConnectionError:
            pass
        finally:
            open_now.discard(writer)
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]

    def unplug() -> None:
        for writer in open_now:
            writer.transport.abort()

    try:
        yield FarSide(amplifiers, partial(url, port), unplug)
    finally:
        server.close()
        unplug()
        await asyncio.sleep(0)  # the connections end


class _Nodes:
    """Amplifiers on a simulated bus, booted."""

    def __init__(self, bus: CanBus, amplifiers: Mapping[int, Amplifier]) -> None:
        self._bus, self._loop = bus, asyncio.get_running_loop()
        self._listener = self._hear
        self._end = CanAmplifiers(amplifiers, self._send)
        bus.join(self._listener)
        self._end.start(self._loop.time())

    def _hear(self, frame: CanFrame) -> None:
        self._end.receive(pack_frames([frame]), self._loop.time())

    def _send(self, data: bytes) -> None:
        for frame in unpack_frames(data):
            self._bus.send(frame, sender=self._listener)


class _BusServer:
    """Amplifiers on a bus of a connection, behind its adapter, as a far end of bytes."""

    def __init__(
        self,
        make_adapter: Callable[..., FarEnd],
        amplifiers: Mapping[int, Amplifier],
        send: Callable[[bytes], None],
    ) -> None:
        bus = CanBus()
        _Nodes(bus, amplifiers)
        self.receive = make_adapter(bus, send).receive


@asynccontextmanager
async def _python_can(
    count: int, interface: str, channel: str, **options: int
) -> AsyncIterator[FarSide]:
    """Serve amplifiers on a bus of python-can, which a thread reads."""
    loop, amplifiers = asyncio.get_running_loop(), _amplifiers(count)
    adapter = can.Bus(interface=interface, channel=channel, **options)
    query = "".join(f"?{name}={value}" for name, value in options.items())
    ending = threading.Event()
    sent: set[tuple[int, bytes]] = set()  # some interfaces return what was sent

    def received(message: can.Message) -> None:
        key = message.arbitration_id, bytes(message.data)
        if key not in sent:
            end.receive(pack_frames([CanFrame(*key)]), loop.time())

    def send(data: bytes) -> None:
        for frame in unpack_frames(data):
            sent.add((frame.id, frame.data))
            adapter.send(
                can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
            )

    def read() -> None:
        while not ending.is_set():
            if (message := adapter.recv(timeout=_READ_TIMEOUT)) is not None:
                loop.call_soon_threadsafe(received, message)

    end = CanAmplifiers(amplifiers, send)
    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield FarSide(
            amplifiers, lambda node: f"can+python-can://{interface}/{channel}{query}#{node}"
        )
    finally:
        ending.set()
        thread.join()
        adapter.shutdown()


def _free_port() -> int:
    """Return a UDP port that nobody has, so that tests of other processes are not on the bus."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


WORD_WIRES: Mapping[str, Callable[[int], Any]] = {
    "serial": lambda count: _terminal(
        count, SerialAmplifiers, lambda port, number: f"serial://{port}?address={number}"
    ),
    "serial+tcp": lambda count: _server(
        count,
        SerialAmplifiers,
        lambda port, number: f"serial+tcp://127.0.0.1:{port}?address={number}",
    ),
    "modbus+rtu": lambda count: _terminal(
        count,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://{port}?baud=19200#{number}",
    ),
    "modbus+tcp": lambda count: _server(
        count,
        partial(ModbusAmplifiers, is_rtu=False),
        lambda port, number: f"modbus+tcp://127.0.0.1:{port}/{number}",
    ),
    "modbus+rtu server": lambda count: _server(
        count,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://127.0.0.1:{port}#{number}",
    ),
    "can+slcan": lambda count: _terminal(
        count,
        partial(_BusServer, SlcanAdapter),
        lambda port, node: f"can+slcan://{port}?bitrate=500000#{node}",
    ),
    "can+slcan server": lambda count: _server(
        count,
        partial(_BusServer, SlcanAdapter),
        lambda port, node: f"can+slcan://127.0.0.1:{port}#{node}",
    ),
    "can+socketcand": lambda count: _server(
        count,
        partial(_BusServer, SocketcandClient),
        lambda port, node: f"can+socketcand://127.0.0.1:{port}/can0#{node}",
    ),
    "can+python-can virtual": lambda count: _python_can(count, "virtual", "plate"),
    "can+python-can udp_multicast": lambda count: _python_can(
        count, "udp_multicast", "239.74.163.2", port=_free_port()
    ),
}
"""Wires by their names: called with the number of amplifiers, at numbers from 1 on."""
