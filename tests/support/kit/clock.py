"""Virtual time: an event loop on a clock that jumps, and lines of every kind of wire in memory.

The loop jumps to its next timer and has a TCP network of its own, between listeners and clients of
the same loop; all else has the machine's sockets and pipes, and costs no time. Runs without those
and with the same random seed are identical, byte for byte. Hosts and far ends write real bytes to
the lines, which arrive after random delays, sometimes in two pieces.
"""

import asyncio
import functools
import random
import threading
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, Protocol, TypeVar

from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.ports import NETWORK_DELAY, PORT_OPENER
from drivers.protocol.definition import BY_NUMBER, HELLO
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CANOPEN, REQUEST, CanFrame, cob_id, pack_frames, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_frames import FrameReader
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from registry import threads
from registry.limits import GuardLimits
from registry.virtual_time import VirtualTimeLoop
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import TERMINAL_MAKER, PseudoTerminal

P = ParamSpec("P")
T = TypeVar("T")

_FIRST_PORT = 20_000
_AWAITED = ("reload", "content")  # names of threads for which time stands still
_LATENCY = (50e-6, 400e-6)  # s; of a loopback connection

Seen = Callable[[str, str, bytes], None]
"""Called with a link, the direction (amplifier or host) and the bytes, as they are sent."""


class VirtualLoop(VirtualTimeLoop):
    """The loop; rng: of the latencies of connections; seen: observer of their bytes.

    latency [s]: shortest and longest of a connection.
    """

    def __init__(self, rng: random.Random | None = None, seen: Seen | None = None) -> None:
        self.latency = _LATENCY
        super().__init__()
        self.rng = rng or random.Random(0)
        self.seen: Seen = seen or (lambda link, toward, data: None)
        self._servers: dict[int, _Server] = {}
        self._hosts: list[MemoryTransport] = []

    @property
    def waits_for_threads(self) -> bool:
        """Whether a daemon's threads work with files; other threads may hang, as in some tests."""
        return any(thread.name in _AWAITED for thread in threading.enumerate())

    async def create_server(self, factory: Any, host: Any = None, port: Any = 0, **_: Any) -> Any:
        """Listen on a port; OSError where it is taken."""
        number = port or next(n for n in range(_FIRST_PORT, 65_536) if n not in self._servers)
        if number in self._servers:
            raise OSError(98, "Address already in use")
        server = self._servers[number] = _Server(self, number, factory)
        return server

    async def create_connection(
        self, factory: Any, host: Any = None, port: Any = 0, **_: Any
    ) -> Any:
        """Connect to a listener; raises ConnectionRefusedError without one."""
        await asyncio.sleep(self.rng.uniform(*self.latency))
        server = self._servers.get(port)
        if server is None:
            raise ConnectionRefusedError(111, "Connection refused")
        host_side, far_side = factory(), server.factory()
        link = f"{host}:{port}"
        ours = MemoryTransport(self, host_side, link, "amplifier")
        theirs = MemoryTransport(self, far_side, link, "host")
        ours.peer, theirs.peer = theirs, ours
        self._hosts = [known for known in self._hosts if not known.is_closing()] + [ours]
        far_side.connection_made(theirs)
        host_side.connection_made(ours)
        return ours, host_side

    def kill_hosts(self) -> None:
        """Cut all connections without notice, as when a process dies."""
        for transport in self._hosts:
            transport.die()

    def forget_server(self, port: int) -> None:
        """Stop listening."""
        self._servers.pop(port, None)


class _Socket:
    """The socket methods used here."""

    def __init__(self, port: int) -> None:
        self._port = port

    def getsockname(self) -> tuple[str, int]:
        """Its address."""
        return "127.0.0.1", self._port

    def setsockopt(self, *_: Any) -> None:
        """Ignore options."""


class _Server:
    """A listener."""

    def __init__(self, loop: VirtualLoop, port: int, factory: Callable[[], Any]) -> None:
        self.factory = factory
        self.sockets = [_Socket(port)]
        self._loop = loop
        self._port = port

    def close(self) -> None:
        """Stop listening."""
        self._loop.forget_server(self._port)

    async def wait_closed(self) -> None:
        """Already closed."""


class MemoryTransport(asyncio.Transport):
    """One side of a connection; toward: receiver of its bytes."""

    def __init__(self, loop: VirtualLoop, protocol: Any, link: str, toward: str) -> None:
        super().__init__()
        self.peer: MemoryTransport
        self._loop = loop
        self._protocol = protocol
        self._link = link
        self._toward = toward
        self._arrives = 0.0  # time of the last bytes sent
        self._is_closed = False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """The socket; the default for all else."""
        return _Socket(0) if name == "socket" else default

    def get_write_buffer_size(self) -> int:
        """Always empty."""
        return 0

    def is_closing(self) -> bool:
        """Whether it is closed."""
        return self._is_closed

    def write(self, data: Any) -> None:
        """Send; it arrives in order, a little later."""
        if self._is_closed:
            return
        self._loop.seen(self._link, self._toward, bytes(data))
        self._later(self.peer._received, bytes(data))

    def close(self) -> None:
        """Close both sides."""
        if not self._is_closed:
            self._disconnect()
            self._later(self.peer._disconnect)

    def abort(self) -> None:
        """Close; the write buffer is always empty."""
        self.close()

    def die(self) -> None:
        """Close the other side without notice to this one."""
        if not self._is_closed:
            self._is_closed = True
            self._later(self.peer._disconnect)

    def _received(self, data: bytes) -> None:
        if not self._is_closed:
            feed(self._protocol, data)

    def _disconnect(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._loop.call_soon(self._protocol.connection_lost, None)

    def _later(self, callback: Callable[..., None], *args: Any) -> None:
        loop = self._loop
        # Timers of one moment fire in any order; bytes of one connection stay in order.
        soonest = self._arrives + 1e-9
        self._arrives = max(soonest, loop.time() + loop.rng.uniform(*loop.latency))
        loop.call_at(self._arrives, callback, *args)


def feed(protocol: Any, data: bytes) -> None:
    """Let a protocol receive bytes, as an event loop does."""
    if not isinstance(protocol, asyncio.BufferedProtocol):
        protocol.data_received(data)
        return
    while data:
        buffer = protocol.get_buffer(-1)
        part = data[: len(buffer)]
        buffer[: len(part)] = part
        protocol.buffer_updated(len(part))
        data = data[len(part) :]


def run_virtual(
    main: Coroutine[Any, Any, T], *, rng: random.Random | None = None, seen: Seen | None = None
) -> T:
    """Run a coroutine to its end in virtual time; raises Stuck for a deadlock."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(rng, seen)) as runner:
        return runner.run(main)


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Run a test in virtual time."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        return run_virtual(test(*args, **kwargs))

    return run


_PASSING = (50e-6, 900e-6)  # s; through driver and adapter
_SPLIT = 0.1  # share of pieces that arrive in two
_BOOT_TEXT = b"\r\nrst:0x1 (POWERON_RESET)\r\n"
_NOTICED = 0.002  # s; until the host notices a hang-up


class MemoryMachine:
    """Ports by name; `make_terminal` is for far ends, the rest for hosts.

    passing [s]: shortest and longest time of bytes on their way; late [s]: how much later what goes
    to the host leaves the far end, by port; attempts: how often each port was to be opened; boots
    [s]: for which a board that restarts whenever its port is opened prints text, and hears nothing.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        self.passing = _PASSING
        self.late: dict[str, float] = {}
        self.attempts = Counter[str]()
        self.boots = 0.0
        self._loop = loop
        self._terminals: dict[str, MemoryTerminal] = {}
        self._open: dict[str, MemoryPort] = {}

    def make_terminal(
        self, on_data: Callable[[bytes], None], *, unpluggable: bool
    ) -> "MemoryTerminal":
        terminal = MemoryTerminal(self, f"/dev/memory{len(self._terminals)}", on_data)
        self._terminals[terminal.port] = terminal
        return terminal

    async def open_port(
        self, name: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> "MemoryPort":
        """Open the host's side of a line; LinkError if it is unplugged or open already."""
        self.attempts[name] += 1
        await asyncio.sleep(self._loop.rng.uniform(*self.passing))
        terminal = self._terminals.get(name)
        if terminal is None or not terminal.is_plugged:
            raise LinkError(f"serial port {name} cannot be opened: no such port")
        if name in self._open:
            raise LinkError(f"serial port {name} cannot be opened: in use by another program")
        port = self._open[name] = MemoryPort(self, terminal, on_data, on_loss)
        if self.boots:
            port.hears_from = self._loop.time() + self.boots
            self.later(_NOTICED, port.outward.take, _BOOT_TEXT)  # which nothing judges
        return port

    def be_prompt(self) -> None:
        """Let bytes pass at once, on serial lines and TCP connections."""
        self.passing = self._loop.latency = (0.0, 0.0)

    def kill_host(self) -> None:
        """Close the host's ports without notice, as when its process dies."""
        for port in tuple(self._open.values()):
            port.close()

    def closed(self, name: str) -> None:
        self._open.pop(name, None)

    def deliver(self, link: str, toward: str, data: bytes, to: "_Direction") -> None:
        """Deliver bytes in order, after a delay, perhaps in two pieces."""
        late = self.late.get(link, 0.0) if toward == "host" else 0.0
        if late or to.leaves > self._loop.time():
            # Timers of one moment run in any order; bytes of one line must not.
            to.leaves = max(to.leaves + 1e-9, self._loop.time() + late)
            self._loop.call_at(to.leaves, self._pass, link, toward, data, to)
        else:
            self._pass(link, toward, data, to)

    def _pass(self, link: str, toward: str, data: bytes, to: "_Direction") -> None:
        loop, pieces = self._loop, [data]
        loop.seen(link, toward, data)
        if len(data) > 1 and loop.rng.random() < _SPLIT:
            at = loop.rng.randrange(1, len(data))
            pieces = [data[:at], data[at:]]
        for piece in pieces:
            soonest = to.arrives + 1e-9
            to.arrives = max(soonest, loop.time() + loop.rng.uniform(*self.passing))
            loop.call_at(to.arrives, to.take, piece)

    def later(self, delay: float, callback: Callable[..., None], *args: Any) -> None:
        self._loop.call_later(delay, callback, *args)

    def opened(self, name: str) -> "MemoryPort | None":
        return self._open.get(name)


def live_in_memory() -> MemoryMachine:
    """Connect hosts and far ends of the running virtual loop in memory."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    machine = MemoryMachine(loop)
    random.seed(loop.rng.random())  # of tokens, and of numbers on wires
    PORT_OPENER.set(machine.open_port)
    TERMINAL_MAKER.set(machine.make_terminal)
    return machine


class _Direction:
    """One direction of a line, until it is unplugged."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self.arrives = self.leaves = 0.0
        self.is_cut = False
        self._take = take

    def take(self, piece: bytes) -> None:
        """Take a piece, unless the line was cut or closed meanwhile."""
        if not self.is_cut:
            self._take(piece)


class MemoryTerminal(PseudoTerminal):
    """The far end's side of a line."""

    def __init__(self, machine: MemoryMachine, name: str, on_data: Callable[[bytes], None]) -> None:
        self.is_plugged = True
        self._machine = machine
        self._name = name
        self._on_data = on_data
        self.inward = _Direction(on_data)

    @property
    def port(self) -> str:
        return self._name

    def plug_in(self) -> None:
        if not self.is_plugged:
            self.is_plugged = True
            self.inward = _Direction(self._on_data)

    def listen(self) -> None:
        """Bytes arrive without it."""

    def unplug(self) -> None:
        if not self.is_plugged:
            return
        self.is_plugged = False
        self.inward.is_cut = True
        port = self._machine.opened(self._name)
        if port is not None:
            port.hang_up()

    def close(self) -> None:
        self.unplug()

    def write(self, data: bytes) -> None:
        """Send to the host; without an open port, bytes are lost."""
        port = self._machine.opened(self._name)
        if self.is_plugged and port is not None:
            self._machine.deliver(self._name, "host", data, port.outward)


class MemoryPort:
    """The host's side of a line."""

    def __init__(
        self,
        machine: MemoryMachine,
        terminal: MemoryTerminal,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._machine = machine
        self._terminal = terminal
        self._on_loss = on_loss
        self._is_closed = self._is_hung_up = False
        self.outward = _Direction(on_data)
        self.hears_from = 0.0

    @property
    def is_blocked(self) -> bool:
        return False

    def poll(self) -> None:
        """All that has come was handed over."""

    def write(self, data: bytes) -> None:
        if self._is_closed or self._is_hung_up:
            raise LinkError(f"serial line {self._terminal.port} was lost")
        if threads.now() < self.hears_from:
            return
        self._machine.deliver(self._terminal.port, "amplifier", data, self._terminal.inward)

    def hang_up(self) -> None:
        """Cut the line; the host notices a little later."""
        self._is_hung_up = self.outward.is_cut = True
        self._machine.closed(self._terminal.port)
        self._machine.later(_NOTICED, self._notice)

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = self.outward.is_cut = True
            if not self._is_hung_up:
                self._machine.closed(self._terminal.port)

    async def wait_closed(self) -> None:
        """Return at once."""

    def _notice(self) -> None:
        if not self._is_closed:
            self._on_loss(f"serial line {self._terminal.port} was lost (it hung up)")


LIMITS = GuardLimits(20.0, 1000.0, 1.0)

_MOMENT = 1e-6  # s

Alter = Callable[[str, bytes], list[tuple[float, bytes]]]
"""What becomes of bytes of a message, by its name, on their way: delays [s] and bytes, none lost.

A reply has the name of its request.
"""


def unaltered(name: str, data: bytes) -> list[tuple[float, bytes]]:
    """Bytes as they are, after 0.2 ms."""
    return [(0.0002, data)]


class FarEnd(Protocol):
    """The amplifiers' side of a wire."""

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""

    def tick(self, now: float) -> None:
        """Let happen what is due by itself."""


@dataclass(frozen=True)
class Kind:
    """A kind of wire: the host's side, and the amplifiers' side with the function it sends by.

    request_of: address and number of the message that begins with these bytes of the host; None
    where they go on with the one before.
    """

    wire: Callable[[], Wire]
    far_end: Callable[[Mapping[int, SimulatedAmplifier], Callable[[bytes], None]], FarEnd]
    request_of: Callable[[bytes], tuple[int, int] | None]


def _serial_request(data: bytes) -> tuple[int, int]:
    (frame,) = FrameReader().feed(data)
    return frame.address, frame.type


def _can_request(data: bytes) -> tuple[int, int]:
    frame = unpack_frames(data)[-1]
    first = next(each for each in unpack_frames(data) if each.id == frame.id)
    return frame.id - REQUEST, first.data[2]


def _modbus_request(data: bytes) -> tuple[int, int] | None:
    """Of unit, function and address: a write, or the read of the identity."""
    unit, function, box, low = data[:4]
    if function == 16:
        return unit, box
    return (unit, HELLO) if (box, low) == (4, 41) else None


KINDS: Mapping[str, Kind] = {
    "can": Kind(lambda: CanWire(500_000, sequence=0), CanAmplifiers, _can_request),
    "serial": Kind(lambda: SerialWire(921_600, sequence=0), SerialAmplifiers, _serial_request),
    "rtu": Kind(
        lambda: ModbusWire(115_200, is_rtu=True, number=0),
        partial(ModbusAmplifiers, is_rtu=True),
        _modbus_request,
    ),
    "tcp": Kind(
        lambda: ModbusWire(0, is_rtu=False, number=0, delay=NETWORK_DELAY),
        partial(ModbusAmplifiers, is_rtu=False),
        lambda data: _modbus_request(data[6:]),
    ),
}


class MemoryLine:
    """Simulated amplifiers at addresses 1, 2, ... of a line, and the host's amplifiers on it.

    inward, outward: what becomes of bytes for the amplifiers, and for the host; sent: the requests
    of the host as address:number, with their times; wire: None for the usual one of the kind.
    """

    is_blocked = False

    def __init__(self, kind: str, *names: str, channels: int = 2, wire: Wire | None = None) -> None:
        self.loop = asyncio.get_running_loop()
        self.far = {each: SimulatedAmplifier(each, channels=channels) for each in names}
        self.inward: Alter = unaltered
        self.outward: Alter = unaltered
        self.sent: list[tuple[float, str]] = []
        self.kind = KINDS[kind]
        self._sending = self._handling = ""
        self._due: dict[str, float] = {}  # s; of what was handed over last, by who takes it
        self.far_end = self.kind.far_end(dict(enumerate(self.far.values(), 1)), self.send)
        self.line = Line(wire or self.kind.wire(), "line")
        self.line.open(self)
        self.hosts = {
            each: Host(self.line, address, LIMITS, name=each)
            for address, each in enumerate(self.far, 1)
        }

    @property
    def retries(self) -> int:
        """Requests that were repeated."""
        return sum(host.counts.retries for host in self.hosts.values())

    def boot(self, node: int) -> None:
        """Have a CAN node begin anew, as after its supply was away."""
        frame = CanFrame(cob_id("nmt"), bytes((CANOPEN["nmt"]["reset_node"], node)))
        self.far_end.receive(pack_frames([frame]), self.loop.time())

    def write(self, data: bytes) -> None:
        """Send bytes of the host."""
        if (request := self.kind.request_of(data)) is not None:
            address, number = request
            self.sent.append((self.loop.time(), f"{address}:{number}"))
            self._sending = BY_NUMBER[number].name if number in BY_NUMBER else "Hello"
        for delay, altered in self.inward(self._sending, data):
            self.later(delay, self.arrives, self._sending, altered)

    def later(self, delay: float, take: Callable[..., None], *given: str | bytes) -> None:
        """Hand bytes over after a delay [s], those of one moment in order: timers fire in any."""
        due = self.loop.time() + delay
        if abs(due - self._due.get(take.__name__, 0.0)) < _MOMENT:
            due = self._due[take.__name__] + _MOMENT / 1000
        self._due[take.__name__] = due
        self.loop.call_at(due, take, *given)

    def poll(self) -> None:
        """All that has come was handed over."""

    def arrives(self, name: str, data: bytes) -> None:
        """Hand bytes of the host to the amplifiers; name: of the request."""
        self._handling = name
        self.far_end.receive(data, self.loop.time())

    def send(self, data: bytes) -> None:
        """Send bytes of the amplifiers."""
        for delay, altered in self.outward(self._handling, data):
            self.later(delay, self.line.received, altered)

    def levels(self, name: str = "") -> list[float]:
        """What the channels of an amplifier play now, of the first without a name."""
        far = self.far[name or next(iter(self.far))]
        far.tick(self.loop.time())
        return [
            round(far.playback.level(channel, self.loop.time()), 6)
            for channel in range(far.playback.channels)
        ]


async def group_of(*ends: MemoryLine, is_armed: bool = True, **options: Any) -> Group:
    """The group of all hosts of lines, open and armed; options: as a `Group` takes them."""
    hosts = {name: host for end in ends for name, host in end.hosts.items()}
    group = Group(hosts, **{"draw": lambda low, high: 77, **options})
    await group.open()
    if is_armed:
        await group.arm()
    return group
