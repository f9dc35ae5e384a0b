"""A line of protocol 4 in virtual time, of any kind of wire: hosts and simulated amplifiers."""

import asyncio
import functools
import inspect
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.playing import Layer, Tone
from drivers.ports import NETWORK_DELAY
from drivers.protocol.definition import BY_NUMBER, HELLO
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CANOPEN, REQUEST, CanFrame, cob_id, pack_frames, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_frames import FrameReader
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from virtual_loop import run_virtual

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
    far_end: Callable[[Mapping[int, Amplifier], Callable[[bytes], None]], FarEnd]
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
        self.far = {each: Amplifier(each, channels=channels) for each in names}
        self.inward: Alter = unaltered
        self.outward: Alter = unaltered
        self.sent: list[tuple[float, str]] = []
        self.kind = KINDS[kind]
        self._sending = self._handling = ""
        self._due: dict[str, float] = {}  # s; of what was handed over last, by who takes it
        self._end = self.kind.far_end(dict(enumerate(self.far.values(), 1)), self._send)
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
        self._end.receive(pack_frames([frame]), self.loop.time())

    def write(self, data: bytes) -> None:
        """Send bytes of the host."""
        if (request := self.kind.request_of(data)) is not None:
            address, number = request
            self.sent.append((self.loop.time(), f"{address}:{number}"))
            self._sending = BY_NUMBER[number].name if number in BY_NUMBER else "Hello"
        for delay, altered in self.inward(self._sending, data):
            self.later(delay, self._arrived, self._sending, altered)

    def later(self, delay: float, take: Callable[..., None], *given: str | bytes) -> None:
        """Hand bytes over after a delay [s], those of one moment in order: timers fire in any."""
        due = self.loop.time() + delay
        if abs(due - self._due.get(take.__name__, 0.0)) < _MOMENT:
            due = self._due[take.__name__] + _MOMENT / 1000
        self._due[take.__name__] = due
        self.loop.call_at(due, take, *given)

    def poll(self) -> None:
        """All that has come was handed over."""

    def _arrived(self, name: str, data: bytes) -> None:
        self._handling = name
        self._end.receive(data, self.loop.time())

    def _send(self, data: bytes) -> None:
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


def tone(channel: int = 0, level: float = 0.5, **other: object) -> Tone:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Tone(channel, 100.0, level, **other)  # type: ignore[arg-type]


def layer(number: int, *tones: Tone, **other: object) -> Layer:
    """A layer with a ramp of 1 ms."""
    return Layer(number, tones, 0.001, **other)  # type: ignore[arg-type]


async def group_of(*ends: MemoryLine, is_armed: bool = True, **options: Any) -> Group:
    """The group of all hosts of lines, open and armed; options: as a `Group` takes them."""
    hosts = {name: host for end in ends for name, host in end.hosts.items()}
    group = Group(hosts, **{"draw": lambda low, high: 77, **options})
    await group.open()
    if is_armed:
        await group.arm()
    return group


def with_group(
    test: Callable[[Group, list[MemoryLine]], Awaitable[None]], wire: str, *lines: tuple[str, ...]
) -> None:
    """Run a test with an armed group of amplifiers, by their names on each line of a kind."""

    async def run() -> None:
        ends = [MemoryLine(wire, *names) for names in lines]
        await test(await group_of(*ends), ends)

    run_virtual(run())


def grouped(*lines: tuple[str, ...], wire: str = "") -> Callable[[Callable[..., Any]], Any]:
    """Run a test with an armed group and the lines that it is on: `with_group` as a decorator.

    wire: the kind of all lines, else the argument or fixture of that name.
    """

    def decorate(test: Callable[..., Any]) -> Callable[..., None]:
        given = [*inspect.signature(test).parameters.values()][2:]
        own = [each.name for each in given]
        if not wire and "wire" not in own:
            given.append(inspect.Parameter("wire", inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(test)
        def run(**arguments: Any) -> None:
            passed = {name: arguments[name] for name in own}
            kind = wire or arguments["wire"]
            with_group(lambda group, ends: test(group, ends, **passed), kind, *lines)

        run.__signature__ = inspect.Signature(given)  # type: ignore[attr-defined]
        return run

    return decorate


def losing(*names: str, count: int = 1) -> Alter:
    """Loses so many frames of these messages, in whichever direction."""
    left = count

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal left
        if name in names and left > 0:
            left -= 1
            return []
        return unaltered(name, data)

    return alter
