"""Open the far end of each kind of wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. A new kind is a module and a line in `_OPENERS`.
"""

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias

from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.faulted_device import FaultedDevice
from sim.far_ends.amplifier_ends import ModbusLineEnd, ModbusPortEnd, SerialLineEnd
from sim.far_ends.can_bus.ends import slcan, socketcand
from sim.far_ends.modbus.end import ModbusRtuEnd, ModbusTcpEnd
from sim.far_ends.serial_end import SerialEnd


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


def open_wire(wire: Wire, devices: Sequence[FaultedDevice]) -> FarEnd:
    """The far end of a wire with these devices; entering it may raise LinkError."""
    return _OPENERS[wire.kind](wire, devices)


@asynccontextmanager
async def open_wires(
    wires: Mapping[str, Wire], devices: Sequence[FaultedDevice]
) -> AsyncIterator[Mapping[str, str]]:
    """The far ends of devices on several wires, both by name; equal wires are shared.

    Yields the URLs by name, in the order of the devices. Raises LinkError.
    """
    lines: dict[Wire, list[FaultedDevice]] = {}
    for device in devices:
        lines.setdefault(wires[device.name], []).append(device)
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for wire, together in lines.items():
            urls.update(await stack.enter_async_context(open_wire(wire, together)))
        yield {device.name: urls[device.name] for device in devices}


@asynccontextmanager
async def _serial(wire: Wire, devices: Sequence[FaultedDevice]) -> AsyncIterator[Mapping[str, str]]:
    lines = [list(devices)] if wire.shared else [[device] for device in devices]
    urls = {}
    async with AsyncExitStack() as stack:
        for line in lines:
            end = _of_version(line, SerialLineEnd, SerialEnd)(
                line, baud=wire.speed, unpluggable=wire.unpluggable
            )
            stack.callback(end.close)
            end.start()
            urls.update(end.urls)
        yield urls


@asynccontextmanager
async def _modbus_tcp(
    wire: Wire, devices: Sequence[FaultedDevice]
) -> AsyncIterator[Mapping[str, str]]:
    end = _of_version(devices, ModbusPortEnd, ModbusTcpEnd)(devices, port=wire.port)
    try:
        await end.start()
        yield end.urls
    finally:
        await end.close()


@asynccontextmanager
async def _modbus_rtu(
    wire: Wire, devices: Sequence[FaultedDevice]
) -> AsyncIterator[Mapping[str, str]]:
    end = _of_version(devices, ModbusLineEnd, ModbusRtuEnd)(
        devices, speed=wire.speed, unpluggable=wire.unpluggable
    )
    try:
        end.start()
        yield end.urls
    finally:
        end.close()


def _socketcand(wire: Wire, devices: Sequence[FaultedDevice]) -> FarEnd:
    return socketcand(devices, port=wire.port, bitrate=wire.speed)


def _slcan(wire: Wire, devices: Sequence[FaultedDevice]) -> FarEnd:
    return slcan(devices, bitrate=wire.speed, unpluggable=wire.unpluggable)


def _of_version(devices: Sequence[FaultedDevice], third: Any, second: Any) -> Any:
    """What is for the version of the protocol of these devices: 3 or 2."""
    return third if isinstance(devices[0], AmplifierDevice) else second


_OPENERS: Mapping[str, Callable[[Wire, Sequence[FaultedDevice]], FarEnd]] = {
    "serial": _serial,
    "modbus-tcp": _modbus_tcp,
    "modbus-rtu": _modbus_rtu,
    "socketcand": _socketcand,
    "slcan": _slcan,
}
