"""Amplifiers by number on every kind of wire, served in the test's event loop."""

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import can

from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from kit.set_table import make_rig
from kit.wires import make_bench
from model.rig.rig import Channel
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.far_ends.simulated_bus import BusNodes, CanBus, SlcanAdapter, SocketcandClient
from sim.transport.serving import TcpEnd, TerminalEnd

_READ_TIMEOUT = 0.02  # s; after which the thread of a bus notices its end
Numbered = Mapping[int, AmplifierDevice]


@dataclass
class WordFarSide:
    """Amplifiers by number on a wire; url: of one of them."""

    amplifiers: Mapping[int, SimulatedAmplifier]
    devices: Numbered
    url: Callable[[int], str]

    def unplug(self) -> None:
        """Cut the wire."""
        for plug in self.devices[1].plug_listeners:
            plug(False)

    def level(self, number: int) -> float:
        """What channel 0 of an amplifier plays now."""
        now = asyncio.get_running_loop().time()
        self.devices[number].tick(now)
        return self.amplifiers[number].playback.level(0, now)


def _far_side(count: int, url: Callable[[int], str]) -> WordFarSide:
    """So many of three amplifiers, with one channel each."""
    rig = make_rig("123", GuardLimits(20.0, 1000.0, 1.0))
    wiring = {era: Channel(name, 0) for era, name in zip(rig.wiring, "123", strict=True)}
    bench, devices = make_bench(replace(rig, wiring=wiring))
    shown = {int(name): name for name in "123"[:count]}
    return WordFarSide(
        {number: bench.amplifiers[name] for number, name in shown.items()},
        {number: devices[name] for number, name in shown.items()},
        url,
    )


def _on_bus(
    make_adapter: Callable[..., Any], devices: Numbered, send: Callable[[bytes], None]
) -> Any:
    """The adapter of a bus of its own, with these amplifiers on it."""
    bus = CanBus()
    BusNodes(bus, [*devices.values()])
    return make_adapter(bus, send)


@asynccontextmanager
async def _served(
    end: Callable[..., Any],
    make_end: Callable[..., Any],
    url: Callable[[Any, int], str],
    count: int,
) -> AsyncIterator[WordFarSide]:
    """Serve amplifiers on a pseudo-terminal or a TCP port, to one host after another."""
    far = _far_side(count, lambda number: url(served.port, number))
    async with end(far.devices[1], partial(make_end, far.devices)) as served:
        yield far


_terminal = partial(_served, partial(TerminalEnd, unpluggable=True))
_server = partial(_served, TcpEnd)


@asynccontextmanager
async def _python_can(
    count: int, interface: str, channel: str, **options: int
) -> AsyncIterator[WordFarSide]:
    """Serve amplifiers on a bus of python-can, which a thread reads."""
    loop = asyncio.get_running_loop()
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

    url = f"can+python-can://{interface}/{channel}{query}#"
    far = _far_side(count, lambda node: f"{url}{node}")
    end = CanAmplifiers(far.devices, send)
    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield far
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
    "serial": partial(
        _terminal, SerialAmplifiers, lambda port, number: f"serial://{port}?address={number}"
    ),
    "serial+tcp": partial(
        _server,
        SerialAmplifiers,
        lambda port, number: f"serial+tcp://127.0.0.1:{port}?address={number}",
    ),
    "modbus+rtu": partial(
        _terminal,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://{port}?baud=19200#{number}",
    ),
    "modbus+tcp": partial(
        _server,
        partial(ModbusAmplifiers, is_rtu=False),
        lambda port, number: f"modbus+tcp://127.0.0.1:{port}/{number}",
    ),
    "modbus+rtu server": partial(
        _server,
        partial(ModbusAmplifiers, is_rtu=True),
        lambda port, number: f"modbus+rtu://127.0.0.1:{port}#{number}",
    ),
    "can+slcan": partial(
        _terminal,
        partial(_on_bus, SlcanAdapter),
        lambda port, node: f"can+slcan://{port}?bitrate=500000#{node}",
    ),
    "can+slcan server": partial(
        _server,
        partial(_on_bus, SlcanAdapter),
        lambda port, node: f"can+slcan://127.0.0.1:{port}#{node}",
    ),
    "can+socketcand": partial(
        _server,
        partial(_on_bus, SocketcandClient),
        lambda port, node: f"can+socketcand://127.0.0.1:{port}/can0#{node}",
    ),
    "can+python-can virtual": lambda count: _python_can(count, "virtual", "plate"),
    "can+python-can udp_multicast": lambda count: _python_can(
        count, "udp_multicast", "239.74.163.2", port=_free_port()
    ),
}
"""Wires by their names: called with the number of amplifiers, at numbers from 1 on."""
