"""Assign a wire to each amplifier, and open the far end of each kind of wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. A new kind is a function here and its name in `_OPENERS`.
"""

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    closing,
    contextmanager,
)
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from drivers.errors import CommandError
from drivers.urls import ADDRESS, BAUD, KIND_OF_PORT, RTU_BAUD, Endpoint
from drivers.wires.can_frames import BITRATE
from drivers.wires.wire import address_of
from model.errors import InputError
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_amplifiers import BUS_NAME, BusNodes, CanBus, SlcanAdapter, SocketcandClient
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.faults import Faults
from sim.transport.far_end import HOST, TcpEnd, TerminalEnd
from sim.transport.simulated_line import LINE_NAMES, PROMPT, delays_of

_SERIAL_BITS, _MODBUS_BITS = 10, 11  # of a byte: start, eight data, parity on Modbus, stop

Urls = AsyncIterator[Mapping[str, str]]
Devices = Sequence[AmplifierDevice]


@dataclass(frozen=True)
class SimulatedWire:
    """How simulated amplifiers are reached.

    kind: a key of `_OPENERS`; speed [bit/s]: None for no transmission time, or that of the kind
    where its line is not prompt; port: on the loopback interface, 0 for any; shared: all amplifiers
    on one serial line, at addresses 1, 2, ...; unpluggable: URLs stay valid when the wire is
    unplugged and plugged in again; line: tells apart wires that are otherwise equal; line_kind: one
    of `LINE_KINDS`, None for what is usual where there are several amplifiers, else prompt; seed:
    of its delays; address: unit, node or address there, None for any.
    """

    kind: str
    speed: int | None = None
    port: int = 0
    shared: bool = False
    unpluggable: bool = False
    line: str = ""
    line_kind: str | None = None
    seed: int = 0
    address: int | None = field(default=None, compare=False)

    @property
    def is_one_line(self) -> bool:
        """Whether all amplifiers on it share one line."""
        return self.shared or self.kind != "serial"


@asynccontextmanager
async def open_wire(wire: SimulatedWire, devices: Devices) -> Urls:
    """The far end of a wire with these devices; entering it may raise LinkError.

    Amplifiers that do not share a serial wire have a line each.
    """
    async with AsyncExitStack() as stack:
        urls: dict[str, str] = {}
        for line in [devices] if wire.is_one_line else [[device] for device in devices]:
            urls |= await stack.enter_async_context(_OPENERS[wire.kind](wire, line))
        yield urls


@asynccontextmanager
async def open_wires(wires: Mapping[str, SimulatedWire], devices: Devices) -> Urls:
    """The far ends of devices on several wires, both by name; equal wires are shared.

    Yields the URLs by name, in the order of the devices. Raises LinkError.
    """
    lines: dict[SimulatedWire, list[AmplifierDevice]] = {}
    for device in devices:
        wire = wires[device.name]
        if len(devices) > 1 and wire.line_kind is None:
            port = Path(wire.line).name.rstrip("0123456789")
            wire = replace(wire, line_kind=KIND_OF_PORT.get(port, _LINE_OF_WIRE[wire.kind]))
        lines.setdefault(wire, []).append(device)
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for wire, together in lines.items():
            urls.update(await stack.enter_async_context(open_wire(wire, together)))
        yield {device.name: urls[device.name] for device in devices}


def _numbered(devices: Devices) -> dict[int, AmplifierDevice]:
    return {device.address: device for device in devices}


def _speed(wire: SimulatedWire, default: int) -> int | None:
    """Bits per second of a line: as given, the default where it is not prompt, or None."""
    return wire.speed or (None if wire.line_kind in (None, PROMPT) else default)


@asynccontextmanager
async def _serial(wire: SimulatedWire, devices: Devices) -> Urls:
    numbered = _numbered(devices) if len(devices) > 1 else {ADDRESS: devices[0]}
    speed = _speed(wire, BAUD)
    async with TerminalEnd(
        devices[0],
        partial(SerialAmplifiers, numbered),
        delays=delays_of(wire.line_kind, wire.seed, devices[0].name),
        byte_time=_SERIAL_BITS / speed if speed else 0.0,
        unpluggable=wire.unpluggable,
    ) as end:
        line = f"serial://{end.port}?baud={wire.speed or BAUD}"
        yield {
            device.name: line if address == ADDRESS else f"{line}&address={address}"
            for address, device in numbered.items()
        }


@asynccontextmanager
async def _modbus_rtu(wire: SimulatedWire, devices: Devices) -> Urls:
    speed = _speed(wire, RTU_BAUD)
    async with TerminalEnd(
        devices[0],
        partial(ModbusAmplifiers, _numbered(devices), is_rtu=True),
        delays=delays_of(wire.line_kind, wire.seed, devices[0].name),
        byte_time=_MODBUS_BITS / speed if speed else 0.0,
        unpluggable=wire.unpluggable,
    ) as end:
        line = f"modbus+rtu://{end.port}?baud={wire.speed or RTU_BAUD}"
        yield {device.name: f"{line}#{device.address}" for device in devices}


@asynccontextmanager
async def _modbus_tcp(wire: SimulatedWire, devices: Devices) -> Urls:
    registers = ModbusAmplifiers(_numbered(devices), lambda data: None, is_rtu=False)
    delays = delays_of(wire.line_kind, wire.seed, devices[0].name)
    async with TcpEnd(devices[0], registers.of_connection, delays=delays, port=wire.port) as end:
        line = f"modbus+tcp://{HOST}:{end.port}"
        yield {device.name: f"{line}/{device.address}" for device in devices}


@contextmanager
def _bus_with(wire: SimulatedWire, devices: Devices) -> Iterator[CanBus]:
    with closing(CanBus(_speed(wire, BITRATE))) as bus, closing(BusNodes(bus, devices)):
        yield bus


@asynccontextmanager
async def _slcan(wire: SimulatedWire, devices: Devices) -> Urls:
    with _bus_with(wire, devices) as bus:
        async with TerminalEnd(
            devices[0],
            partial(SlcanAdapter, bus),
            faults=Faults(),
            delays=delays_of(wire.line_kind, wire.seed, devices[0].name),
            unpluggable=wire.unpluggable,
        ) as end:
            line = f"can+slcan://{end.port}?bitrate={wire.speed or BITRATE}"
            yield {device.name: f"{line}#{device.address}" for device in devices}


@asynccontextmanager
async def _socketcand(wire: SimulatedWire, devices: Devices) -> Urls:
    with _bus_with(wire, devices) as bus:
        async with TcpEnd(
            devices[0],
            partial(SocketcandClient, bus),
            faults=Faults(),
            delays=delays_of(wire.line_kind, wire.seed, devices[0].name),
            port=wire.port,
        ) as end:
            line = f"can+socketcand://{HOST}:{end.port}/{BUS_NAME}"
            speed = f"?bitrate={wire.speed}" if wire.speed not in (None, BITRATE) else ""
            yield {device.name: f"{line}{speed}#{device.address}" for device in devices}


_OPENERS: Mapping[
    str, Callable[[SimulatedWire, Devices], AbstractAsyncContextManager[Mapping[str, str]]]
] = {
    "serial": _serial,
    "modbus-tcp": _modbus_tcp,
    "modbus-rtu": _modbus_rtu,
    "socketcand": _socketcand,
    "slcan": _slcan,
}


_PORTED = ("modbus-tcp", "socketcand")
_KINDS = ("serial", "modbus-tcp:PORT", "modbus-rtu", "socketcand:PORT", "slcan")
_KIND_OF_SCHEME = {
    "serial": "serial",
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+socketcand": "socketcand",
    "can+slcan": "slcan",
}
_EXAMPLE = "; as in --wire main=serial"
_LINE_OF_WIRE = {
    "serial": "usb-high-speed",
    "modbus-tcp": "ethernet",
    "modbus-rtu": "usb-high-speed",
    "socketcand": "can",
    "slcan": "can-usb",
}


def assign_wires(
    amplifiers: Mapping[str, str],
    *,
    common: SimulatedWire | None,
    options: Sequence[str],
    defaults: SimulatedWire,
) -> dict[str, SimulatedWire]:
    """The wire of each amplifier, by name.

    amplifiers: URLs by name; options: texts like `main=modbus-tcp:5020`; common: the wire of all
    others, None to follow their URLs; defaults: speed and sharing of those wires. Equal wires are
    shared. Raises InputError.
    """
    assigned: dict[str, SimulatedWire] = {}
    for text in options:
        name, equals, kind = text.partition("=")
        if not equals:
            raise InputError(f"--wire {text}: must be NAME=WIRE{_EXAMPLE}")
        if name not in amplifiers:
            known = ", ".join(amplifiers)
            raise InputError(f"--wire {text}: amplifier must be one of {known}{_EXAMPLE}")
        if name in assigned:
            raise InputError(f"--wire {text}: must be given once per amplifier{_EXAMPLE}")
        assigned[name] = _wire_of_option(kind, text, defaults)
    return {
        name: assigned.get(name) or common or _wire_of_url(name, url, defaults)
        for name, url in amplifiers.items()
    }


def choose_lines(
    wires: Mapping[str, SimulatedWire], options: Sequence[str]
) -> dict[str, SimulatedWire]:
    """Wires by amplifier with the kinds of line that options name: `KIND` or `NAME=KIND`.

    A name stands for all amplifiers of its line, and counts more than what is for all. Raises
    InputError.
    """
    kinds: dict[str, str] = {}
    for text in sorted(options, key=lambda text: "=" in text):
        name, equals, kind = text.rpartition("=")
        if equals and name not in wires:
            raise InputError(f"--line {text}: amplifier must be one of {', '.join(wires)}")
        if kind not in LINE_NAMES:
            known = ", ".join(LINE_NAMES)
            raise InputError(f"--line {text}: must be KIND or NAME=KIND, KIND one of {known}")
        for each, wire in wires.items():
            if not equals or each == name or (wire.is_one_line and wire == wires[name]):
                kinds[each] = kind
    return {
        name: replace(wire, line_kind=kinds.get(name, wire.line_kind))
        for name, wire in wires.items()
    }


def links_of(wires: Mapping[str, SimulatedWire]) -> dict[str, Path]:
    """Paths of the rig's URLs at which terminals are placed, by one of the amplifiers on each.

    Those in /dev are of real ports.
    """
    names = {
        wire.line: name
        for name, wire in wires.items()
        if wire.line.startswith("/") and not wire.line.startswith("/dev/")
    }
    return {name: Path(path) for path, name in names.items()}


def _wire_of_option(text: str, option: str, defaults: SimulatedWire) -> SimulatedWire:
    kind, colon, port = text.partition(":")
    if kind in _KIND_OF_SCHEME.values() and bool(colon) <= (kind in _PORTED):
        if not colon:
            return replace(defaults, kind=kind)
        if port.isascii() and port.isdigit() and int(port) <= 65535:
            return replace(defaults, kind=kind, port=int(port))
    raise InputError(f"--wire {option}: wire must be one of {', '.join(_KINDS)}, got {text!r}")


def _wire_of_url(name: str, url: str, defaults: SimulatedWire) -> SimulatedWire:
    """The wire that a URL names; amplifiers whose URLs name one line share it."""
    kind, place = _KIND_OF_SCHEME.get(url.partition("://")[0].lower()), Endpoint()
    if kind is not None:
        try:
            address = address_of(url)
        except CommandError as problem:
            raise InputError(f"amplifier {name}: {problem}") from problem
        place = getattr(address, "place", place)
    is_ported = kind in _PORTED
    if kind is None or (is_ported and place.name not in url):
        schemes = ", ".join(_KIND_OF_SCHEME)
        raise InputError(
            f"amplifier {name}: scheme must be one of {schemes}, with a port over TCP, got {url}; "
            "add --serial (a pseudo-terminal each), --modbus-tcp PORT, --modbus-rtu, --socketcand "
            f"PORT or --slcan for all, or --wire {name}=serial"
        )
    if is_ported:
        return replace(defaults, kind=kind, port=place.port, address=address.number)
    return replace(defaults, kind=kind, address=address.number, line=place.name, shared=True)
