"""Assign a wire to each amplifier, and open the far end of each kind of wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. A new kind is a row of `FAR_ENDS`.
"""

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    AsyncExitStack,
    asynccontextmanager,
    closing,
    contextmanager,
    nullcontext,
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
from sim.transport.far_end import HOST, FarEnd, MakeEnd, SendBytes, TcpEnd, TerminalEnd
from sim.transport.simulated_line import LINE_NAMES, PROMPT, delays_of

Urls = AsyncIterator[Mapping[str, str]]
Devices = Sequence[AmplifierDevice]
Numbered = Mapping[int, AmplifierDevice]


@dataclass(frozen=True)
class SimulatedWire:
    """Connection to simulated amplifiers.

    kind: a key of `FAR_ENDS`.
    speed: [bit/s]; None for no transmission time, or the kind's default if its line has delays.
    port: on the loopback interface, 0 for any.
    shared: all amplifiers on one serial line, at addresses 1, 2, ...
    unpluggable: URLs stay valid when the wire is unplugged and plugged in again.
    line: distinguishes otherwise equal wires.
    line_kind: one of `LINE_KINDS`; None for the usual one with several amplifiers, else prompt.
    seed: of its delays.
    address: unit, node or address there, None for any.
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
            urls |= await stack.enter_async_context(_open_line(wire, line))
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
            wire = replace(wire, line_kind=KIND_OF_PORT.get(port, FAR_ENDS[wire.kind].line_kind))
        lines.setdefault(wire, []).append(device)
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for wire, together in lines.items():
            urls.update(await stack.enter_async_context(open_wire(wire, together)))
        yield {device.name: urls[device.name] for device in devices}


@contextmanager
def _on_bus(
    make_adapter: Callable[[CanBus, SendBytes], FarEnd], speed: int | None, numbered: Numbered
) -> Iterator[MakeEnd]:
    with (
        closing(CanBus(speed)) as bus,
        closing(BusNodes(bus, [*numbered.values()])),
    ):
        yield partial(make_adapter, bus)


@dataclass(frozen=True)
class FarEndKind:
    """Opens the far end of a kind of wire; also the form of its URLs.

    url: with {host} for a TCP port; speed: usual speed [bit/s]; line_kind: of its line with several
    amplifiers; open_end: makes the far end of amplifiers by address, at a speed; bits: of a byte on
    the line, with start, parity and stop, 0 if bytes take no time.
    """

    url: str
    speed: int
    line_kind: str
    open_end: Callable[[int | None, Numbered], AbstractContextManager[MakeEnd]]
    bits: int = 0

    @property
    def scheme(self) -> str:
        """The scheme of its URLs."""
        return self.url.partition("://")[0]

    @property
    def is_ported(self) -> bool:
        """Whether it is a TCP port."""
        return "{host}" in self.url


FAR_ENDS: Mapping[str, FarEndKind] = {
    "serial": FarEndKind(
        "serial://{port}?baud={speed}&address={address}",
        BAUD,
        "usb-high-speed",
        lambda speed, numbered: nullcontext(partial(SerialAmplifiers, numbered)),
        bits=10,
    ),
    "modbus-tcp": FarEndKind(
        "modbus+tcp://{host}:{port}/{address}",
        RTU_BAUD,
        "ethernet",
        lambda speed, numbered: nullcontext(
            ModbusAmplifiers(numbered, lambda data: None, is_rtu=False).of_connection
        ),
    ),
    "modbus-rtu": FarEndKind(
        "modbus+rtu://{port}?baud={speed}#{address}",
        RTU_BAUD,
        "usb-high-speed",
        lambda speed, numbered: nullcontext(partial(ModbusAmplifiers, numbered, is_rtu=True)),
        bits=11,
    ),
    "socketcand": FarEndKind(
        f"can+socketcand://{{host}}:{{port}}/{BUS_NAME}?bitrate={{speed}}#{{address}}",
        BITRATE,
        "can",
        partial(_on_bus, SocketcandClient),
    ),
    "slcan": FarEndKind(
        "can+slcan://{port}?bitrate={speed}#{address}",
        BITRATE,
        "can-usb",
        partial(_on_bus, SlcanAdapter),
    ),
}
"""By the names of `era sim --wire`."""
_KIND_OF_SCHEME = {kind.scheme: name for name, kind in FAR_ENDS.items()}
_EXAMPLE = ", such as --wire main=serial"


@asynccontextmanager
async def _open_line(wire: SimulatedWire, devices: Devices) -> Urls:
    kind, first = FAR_ENDS[wire.kind], devices[0]
    numbered = {device.address: device for device in devices}
    if wire.kind == "serial" and len(devices) == 1:
        numbered = {ADDRESS: first}
    # The speed of the kind if its line has delays, else none.
    speed = wire.speed or (None if wire.line_kind in (None, PROMPT) else kind.speed)
    delays = delays_of(wire.line_kind, wire.seed, first.name)
    faults = (
        Faults() if kind.url.startswith("can") else None
    )  # frame faults are injected on the bus
    with kind.open_end(speed, numbered) as make_end:
        end: TcpEnd | TerminalEnd
        if kind.is_ported:
            end = TcpEnd(first, make_end, faults=faults, delays=delays, port=wire.port)
        else:
            end = TerminalEnd(
                first,
                make_end,
                faults=faults,
                delays=delays,
                byte_time=kind.bits / speed if speed else 0.0,
                unpluggable=wire.unpluggable,
            )
        async with end:
            url = partial(kind.url.format, host=HOST, port=end.port, speed=wire.speed or kind.speed)
            yield {
                device.name: url(address=address)
                .removesuffix(f"&address={ADDRESS}")
                .replace(f"{BUS_NAME}?bitrate={BITRATE}#", f"{BUS_NAME}#")
                for address, device in numbered.items()
            }


def assign_wires(
    amplifiers: Mapping[str, str],
    *,
    common: SimulatedWire | None,
    options: Sequence[str],
    defaults: SimulatedWire,
) -> dict[str, SimulatedWire]:
    """The wire of each amplifier, by name.

    amplifiers: URLs by name; options: texts like `main=modbus-tcp:5020`; common: wire of all other
    amplifiers, None to follow their URLs; defaults: speed and sharing of these wires. Equal wires
    are shared. Raises InputError.
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

    A name means all amplifiers of its line, and overrides the option for all lines. Raises
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
    if kind in FAR_ENDS and bool(colon) <= FAR_ENDS[kind].is_ported:
        if not colon:
            return replace(defaults, kind=kind)
        if port.isascii() and port.isdigit() and int(port) <= 65535:
            return replace(defaults, kind=kind, port=int(port))
    known = ", ".join(f"{name}:PORT" if kind.is_ported else name for name, kind in FAR_ENDS.items())
    raise InputError(f"--wire {option}: wire must be one of {known}, got {text!r}")


def _wire_of_url(name: str, url: str, defaults: SimulatedWire) -> SimulatedWire:
    """The wire that a URL names; amplifiers whose URLs name one line share it."""
    kind, place = _KIND_OF_SCHEME.get(url.partition("://")[0].lower()), Endpoint()
    if kind is not None:
        try:
            address = address_of(url)
        except CommandError as problem:
            raise InputError(f"amplifier {name}: {problem}") from problem
        place = getattr(address, "place", place)
    is_ported = kind is not None and FAR_ENDS[kind].is_ported
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
