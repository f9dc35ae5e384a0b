"""Wires of simulated amplifiers: a wire for each amplifier, and the far end of each wire.

A far end is an asynchronous context in which devices reply on a real wire; it yields the URL of
each amplifier by name. The module of each far end declares its kinds (`FarEndKind`).
"""

from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import sim.far_ends
from drivers.errors import CommandError
from drivers.urls import ADDRESS, KIND_OF_PORT
from drivers.wires.wire import address_of
from model.errors import InputError
from sim.bench.amplifier_device import AmplifierDevice
from sim.faults import Faults
from sim.transport.serving import FarEndKind, TcpEnd, TerminalEnd
from sim.transport.simulated_line import LINE_NAMES, PROMPT, delays_of

Urls = AsyncIterator[Mapping[str, str]]
Devices = Sequence[AmplifierDevice]


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
    """The far end of a wire with these devices; raises LinkError.

    Amplifiers that do not share a serial wire have a line each.
    """
    lines: list[Devices] = [devices]
    if not wire.is_one_line:
        lines = [[device] for device in devices]
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for line in lines:
            urls.update(await stack.enter_async_context(_open_line(wire, line)))
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
            wire = replace(wire, line_kind=_default_line_kind(wire))
        lines.setdefault(wire, []).append(device)
    urls: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for wire, devices_of_wire in lines.items():
            urls.update(await stack.enter_async_context(open_wire(wire, devices_of_wire)))
        yield {device.name: urls[device.name] for device in devices}


def _default_line_kind(wire: SimulatedWire) -> str:
    """The kind of line of a wire with several amplifiers, from its port or its kind."""
    port = Path(wire.line).name.rstrip("0123456789")
    return KIND_OF_PORT.get(port, FAR_ENDS[wire.kind].line_kind)


_THIS_MODULE = "wire_assignment"


def _far_ends() -> dict[str, FarEndKind]:
    """Collect the kinds of far ends that the modules of this package declare."""
    kinds: dict[str, FarEndKind] = {}
    for name in {module.name for module in iter_modules(sim.far_ends.__path__)} - {_THIS_MODULE}:
        module = import_module(f"sim.far_ends.{name}")
        for value in vars(module).values():
            if isinstance(value, FarEndKind):
                kinds[value.name] = value
    return dict(sorted(kinds.items()))


FAR_ENDS: Mapping[str, FarEndKind] = _far_ends()
"""By the names of `era sim --wire`."""
_KIND_OF_SCHEME = {kind.scheme: name for name, kind in FAR_ENDS.items()}
_EXAMPLE = ", such as --wire main=serial"


@asynccontextmanager
async def _open_line(wire: SimulatedWire, devices: Devices) -> Urls:
    """The far end of one line; yields the URL of each amplifier by name."""
    kind = FAR_ENDS[wire.kind]
    first = devices[0]
    numbered = {device.address: device for device in devices}
    if wire.kind == "serial" and len(devices) == 1:
        numbered = {ADDRESS: first}
    speed = wire.speed
    if speed is None and wire.line_kind not in (None, PROMPT):
        speed = kind.speed
    delays = delays_of(wire.line_kind, wire.seed, first.name)
    faults = None
    if kind.is_can:  # frame faults are injected on the bus
        faults = Faults()
    with kind.serve(speed, numbered) as make_end:
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
            urls = {}
            url_speed = wire.speed or kind.speed
            for address, device in numbered.items():
                urls[device.name] = kind.url_of(port=end.port, speed=url_speed, address=address)
            yield urls


def assign_wires(
    amplifiers: Mapping[str, str],
    *,
    common: SimulatedWire | None,
    options: Sequence[str],
    defaults: SimulatedWire,
) -> dict[str, SimulatedWire]:
    """The wire of each amplifier, by name.

    amplifiers: URLs by name; options: texts like `main=modbus-tcp:5020`; common: wire of the other
    amplifiers, None for the wires that their URLs name; defaults: speed and sharing of these wires.
    Equal wires are shared. Raises InputError.
    """
    assigned: dict[str, SimulatedWire] = {}
    for text in options:
        name, equals, kind = text.partition("=")
        if not equals:
            raise InputError(f"--wire {text}: must be NAME=WIRE{_EXAMPLE}")
        if name not in amplifiers:
            names = ", ".join(amplifiers)
            raise InputError(f"--wire {text}: amplifier must be one of {names}{_EXAMPLE}")
        if name in assigned:
            raise InputError(f"--wire {text}: must be given once per amplifier{_EXAMPLE}")
        assigned[name] = _wire_of_option(kind, text, defaults)
    wires = {}
    for name, url in amplifiers.items():
        wires[name] = assigned.get(name) or common or _wire_of_url(name, url, defaults)
    return wires


def choose_lines(
    wires: Mapping[str, SimulatedWire], options: Sequence[str]
) -> dict[str, SimulatedWire]:
    """Wires by amplifier with the kinds of line that options name: `KIND` or `NAME=KIND`.

    A name stands for all amplifiers of its line, and overrides the option for all lines. Raises
    InputError.
    """
    chosen = dict(wires)
    for text in sorted(options, key=lambda text: "=" in text):
        name, equals, kind = text.rpartition("=")
        if equals and name not in wires:
            raise InputError(f"--line {text}: amplifier must be one of {', '.join(wires)}")
        if kind not in LINE_NAMES:
            kinds = ", ".join(LINE_NAMES)
            raise InputError(f"--line {text}: must be KIND or NAME=KIND, KIND one of {kinds}")
        for amplifier in _on_line_of(name, wires) if equals else wires:
            chosen[amplifier] = replace(wires[amplifier], line_kind=kind)
    return chosen


def _on_line_of(name: str, wires: Mapping[str, SimulatedWire]) -> list[str]:
    """The amplifiers on the line of an amplifier, including itself."""
    line = wires[name]
    if not line.is_one_line:
        return [name]
    return [amplifier for amplifier, wire in wires.items() if wire == line]


def links_of(wires: Mapping[str, SimulatedWire]) -> dict[str, Path]:
    """Paths at which the rig's URLs expect terminals, by the last amplifier on each.

    Paths in /dev belong to real ports.
    """
    amplifiers_by_path: dict[str, str] = {}
    for name, wire in wires.items():
        if wire.line.startswith("/") and not wire.line.startswith("/dev/"):
            amplifiers_by_path[wire.line] = name
    return {name: Path(path) for path, name in amplifiers_by_path.items()}


def _wire_of_option(text: str, option: str, defaults: SimulatedWire) -> SimulatedWire:
    """The wire in an option: `KIND` or, over TCP, `KIND:PORT`; raises InputError."""
    kind, colon, port = text.partition(":")
    if kind in FAR_ENDS and not colon:
        return replace(defaults, kind=kind)
    if kind in FAR_ENDS and FAR_ENDS[kind].is_ported and _is_tcp_port(port):
        return replace(defaults, kind=kind, port=int(port))
    forms = []
    for name, far_end in FAR_ENDS.items():
        forms.append(f"{name}:PORT" if far_end.is_ported else name)
    raise InputError(f"--wire {option}: wire must be one of {', '.join(forms)}, got {text!r}")


def _is_tcp_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and int(text) <= 65535


def _wire_of_url(name: str, url: str, defaults: SimulatedWire) -> SimulatedWire:
    """The wire that a URL names, shared by all URLs of the same line; raises InputError."""
    scheme = url.partition("://")[0].lower()
    if scheme not in _KIND_OF_SCHEME:
        raise _bad_url(name, url)
    kind = _KIND_OF_SCHEME[scheme]
    try:
        address = address_of(url)
    except CommandError as problem:
        raise InputError(f"amplifier {name}: {problem}") from problem
    endpoint = address.place
    number = address.number
    if not FAR_ENDS[kind].is_ported:
        return replace(defaults, kind=kind, address=number, line=endpoint.name, shared=True)
    if endpoint.name not in url:
        raise _bad_url(name, url)
    return replace(defaults, kind=kind, port=endpoint.port, address=number)


def _bad_url(name: str, url: str) -> InputError:
    """The error for a URL that names no wire of a simulation."""
    schemes = ", ".join(_KIND_OF_SCHEME)
    return InputError(
        f"amplifier {name}: scheme must be one of {schemes}, with a port over TCP, got {url}; "
        "add --serial (a pseudo-terminal each), --modbus-tcp PORT, --modbus-rtu, --socketcand "
        f"PORT or --slcan for all, or --wire {name}=serial"
    )
