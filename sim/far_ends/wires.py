"""Open the far end of each kind of wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. A new kind is a function here and its name in `_OPENERS`.
"""

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    contextmanager,
)
from dataclasses import dataclass, field
from functools import partial

from drivers.codec.can_bus.canopen import BITRATE
from drivers.urls import ADDRESS, BAUD, RTU_BAUD
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_bus.bus import BusNodes, CanBus
from sim.far_ends.can_bus.slcan_adapter import SlcanAdapter
from sim.far_ends.can_bus.socketcand import BUS_NAME, SocketcandClient
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.faults.fault_window import Faults
from sim.transport.far_end import HOST, TcpEnd, TerminalEnd

_SERIAL_BITS, _MODBUS_BITS = 10, 11  # of a byte: start, eight data, parity on Modbus, stop

Urls = AsyncIterator[Mapping[str, str]]
Devices = Sequence[AmplifierDevice]


@dataclass(frozen=True)
class Wire:
    """How simulated amplifiers are reached.

    kind: a key of `_OPENERS`; speed [bit/s]: None for no transmission time; port: on the loopback
    interface, 0 for any; shared: all amplifiers on one serial line, at addresses 1, 2, ...;
    unpluggable: URLs stay valid when the wire is unplugged and plugged in again; line: tells apart
    wires that are otherwise equal; address: unit, node or address there, None for any.
    """

    kind: str
    speed: int | None = None
    port: int = 0
    shared: bool = False
    unpluggable: bool = False
    line: str = ""
    address: int | None = field(default=None, compare=False)


@asynccontextmanager
async def open_wire(wire: Wire, devices: Devices) -> Urls:
    """The far end of a wire with these devices; entering it may raise LinkError.

    Amplifiers that do not share a serial wire have a line each.
    """
    is_apart = wire.kind == "serial" and not wire.shared
    async with AsyncExitStack() as stack:
        urls: dict[str, str] = {}
        for line in [[device] for device in devices] if is_apart else [devices]:
            urls |= await stack.enter_async_context(_OPENERS[wire.kind](wire, line))
        yield urls


@asynccontextmanager
async def open_wires(wires: Mapping[str, Wire], devices: Devices) -> Urls:
    """The far ends of devices on several wires, both by name; equal wires are shared.

    Yields the URLs by name, in the order of the devices. Raises LinkError.
    """
    lines: dict[Wire, list[AmplifierDevice]] = {}
    for device in devices:
        lines.setdefault(wires[device.name], []).append(device)
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for wire, together in lines.items():
            urls.update(await stack.enter_async_context(open_wire(wire, together)))
        yield {device.name: urls[device.name] for device in devices}


def _numbered(devices: Devices) -> dict[int, AmplifierDevice]:
    return {device.address: device for device in devices}


def _byte_time(wire: Wire, bits: int) -> float:
    """Transmission time of a byte of so many bits [s]."""
    return bits / wire.speed if wire.speed else 0.0


@asynccontextmanager
async def _serial(wire: Wire, devices: Devices) -> Urls:
    numbered = _numbered(devices) if len(devices) > 1 else {ADDRESS: devices[0]}
    async with TerminalEnd(
        devices[0],
        partial(SerialAmplifiers, numbered),
        byte_time=_byte_time(wire, _SERIAL_BITS),
        unpluggable=wire.unpluggable,
    ) as end:
        line = f"serial://{end.port}?baud={wire.speed or BAUD}"
        yield {
            device.name: line if address == ADDRESS else f"{line}&address={address}"
            for address, device in numbered.items()
        }


@asynccontextmanager
async def _modbus_rtu(wire: Wire, devices: Devices) -> Urls:
    async with TerminalEnd(
        devices[0],
        partial(ModbusAmplifiers, _numbered(devices), is_rtu=True),
        byte_time=_byte_time(wire, _MODBUS_BITS),
        unpluggable=wire.unpluggable,
    ) as end:
        line = f"modbus+rtu://{end.port}?baud={wire.speed or RTU_BAUD}"
        yield {device.name: f"{line}#{device.address}" for device in devices}


@asynccontextmanager
async def _modbus_tcp(wire: Wire, devices: Devices) -> Urls:
    registers = ModbusAmplifiers(_numbered(devices), lambda data: None, is_rtu=False)
    async with TcpEnd(devices[0], registers.of_connection, port=wire.port) as end:
        line = f"modbus+tcp://{HOST}:{end.port}"
        yield {device.name: f"{line}/{device.address}" for device in devices}


@contextmanager
def _bus_with(devices: Devices, bitrate: int | None) -> Iterator[CanBus]:
    bus = CanBus(bitrate)
    nodes = BusNodes(bus, devices)
    try:
        yield bus
    finally:
        nodes.close()
        bus.close()


@asynccontextmanager
async def _slcan(wire: Wire, devices: Devices) -> Urls:
    with _bus_with(devices, wire.speed) as bus:
        make, is_kept = partial(SlcanAdapter, bus), wire.unpluggable
        async with TerminalEnd(devices[0], make, faults=Faults(), unpluggable=is_kept) as end:
            line = f"can+slcan://{end.port}?bitrate={wire.speed or BITRATE}"
            yield {device.name: f"{line}#{device.address}" for device in devices}


@asynccontextmanager
async def _socketcand(wire: Wire, devices: Devices) -> Urls:
    with _bus_with(devices, wire.speed) as bus:
        make = partial(SocketcandClient, bus)
        async with TcpEnd(devices[0], make, faults=Faults(), port=wire.port) as end:
            line = f"can+socketcand://{HOST}:{end.port}/{BUS_NAME}"
            speed = f"?bitrate={wire.speed}" if wire.speed not in (None, BITRATE) else ""
            yield {device.name: f"{line}{speed}#{device.address}" for device in devices}


_OPENERS: Mapping[
    str, Callable[[Wire, Devices], AbstractAsyncContextManager[Mapping[str, str]]]
] = {
    "serial": _serial,
    "modbus-tcp": _modbus_tcp,
    "modbus-rtu": _modbus_rtu,
    "socketcand": _socketcand,
    "slcan": _slcan,
}
