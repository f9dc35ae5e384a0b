"""Open the far end of each kind of wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. A new kind is a module and a line in `_OPENERS`.
"""

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TypeAlias

from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.amplifier_ends import ModbusLineEnd, ModbusPortEnd, SerialLineEnd
from sim.far_ends.can_bus.ends import slcan, socketcand


@dataclass(frozen=True)
class Wire:
    """How simulated amplifiers are reached.

    kind: a key of `_OPENERS`; speed [bit/s]: None for no transmission time; port: on the loopback
    interface, 0 for any; shared: all amplifiers on one serial line, at addresses 1, 2, ...;
    unpluggable: URLs stay valid when the wire is unplugged and plugged in again; line: tells apart
    wires that are otherwise equal.
    """

    kind: str
    speed: int | None = None
    port: int = 0
    shared: bool = False
    unpluggable: bool = False
    line: str = ""


FarEnd: TypeAlias = AbstractAsyncContextManager[Mapping[str, str]]


def open_wire(wire: Wire, devices: Sequence[AmplifierDevice]) -> FarEnd:
    """The far end of a wire with these devices; entering it may raise LinkError."""
    return _OPENERS[wire.kind](wire, devices)


@asynccontextmanager
async def open_wires(
    wires: Mapping[str, Wire], devices: Sequence[AmplifierDevice]
) -> AsyncIterator[Mapping[str, str]]:
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


@asynccontextmanager
async def _serial(
    wire: Wire, devices: Sequence[AmplifierDevice]
) -> AsyncIterator[Mapping[str, str]]:
    lines = [list(devices)] if wire.shared else [[device] for device in devices]
    urls = {}
    async with AsyncExitStack() as stack:
        for line in lines:
            end = SerialLineEnd(line, baud=wire.speed, unpluggable=wire.unpluggable)
            stack.callback(end.close)
            end.start()
            urls.update(end.urls)
        yield urls


@asynccontextmanager
async def _modbus_tcp(
    wire: Wire, devices: Sequence[AmplifierDevice]
) -> AsyncIterator[Mapping[str, str]]:
    end = ModbusPortEnd(devices, port=wire.port)
    try:
        await end.start()
        yield end.urls
    finally:
        await end.close()


@asynccontextmanager
async def _modbus_rtu(
    wire: Wire, devices: Sequence[AmplifierDevice]
) -> AsyncIterator[Mapping[str, str]]:
    end = ModbusLineEnd(devices, speed=wire.speed, unpluggable=wire.unpluggable)
    try:
        end.start()
        yield end.urls
    finally:
        end.close()


def _socketcand(wire: Wire, devices: Sequence[AmplifierDevice]) -> FarEnd:
    return socketcand(devices, port=wire.port, bitrate=wire.speed)


def _slcan(wire: Wire, devices: Sequence[AmplifierDevice]) -> FarEnd:
    return slcan(devices, bitrate=wire.speed, unpluggable=wire.unpluggable)


_OPENERS: Mapping[str, Callable[[Wire, Sequence[AmplifierDevice]], FarEnd]] = {
    "serial": _serial,
    "modbus-tcp": _modbus_tcp,
    "modbus-rtu": _modbus_rtu,
    "socketcand": _socketcand,
    "slcan": _slcan,
}
