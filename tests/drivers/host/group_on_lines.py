"""Groups of simulated amplifiers on lines of every kind of wire, in virtual time.

A `Rig` is the host's group with the amplifiers at the far ends of its lines. What a person would
feel is read from the simulated amplifiers. An alteration (`inward`, `outward` of a line) decides
what becomes of bytes on their way; `late` and `in_turn` make some.
"""

import asyncio
import random
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, TypeVar

import pytest

from drivers.errors import LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.joint_sets import PlayedSet
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import BY_NUMBER, CLOCK_UNKNOWN
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Envelope
from drivers.voices import Voice
from drivers.wires.serial_line import SerialWire
from kit.clock import KINDS, Alter, MemoryLine, group_of, in_virtual_time, unaltered
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

_T = TypeVar("_T")

SILENT = [0.0, 0.0]
HALF = [0.5, 0.0]
"""Levels of an amplifier whose first channel plays 0.5."""


def on_wires(*wires: str) -> Callable[[Callable[..., Any]], Any]:
    """Run a test in virtual time on each of these kinds of wires, or on all."""

    def decorate(test: Callable[..., Any]) -> Any:
        return pytest.mark.parametrize("wire", wires or KINDS)(in_virtual_time(test))

    return decorate


class Rig:
    """A group and its lines."""

    def __init__(self, lines: Sequence[MemoryLine], group: Group) -> None:
        self.lines = lines
        self.group = group
        self.hosts: Mapping[str, Amplifier] = group.amplifiers
        """The host's view of each amplifier."""
        self.far: dict[str, SimulatedAmplifier] = {}
        """The simulated amplifiers by name."""
        for line in lines:
            self.far.update(line.far)
        self.since = 0.0
        self.watch()

    @property
    def line(self) -> MemoryLine:
        """The first line."""
        return self.lines[0]

    @property
    def levels(self) -> dict[str, list[float]]:
        """The levels that all channels play now, by amplifier."""
        return {name: line.levels(name) for line in self.lines for name in line.far}

    @property
    def retries(self) -> int:
        """Requests that were repeated."""
        return sum(line.retries for line in self.lines)

    def watch(self) -> None:
        """Note requests, and count seconds, from now on."""
        self.since = self.line.loop.time()
        for line in self.lines:
            line.sent.clear()

    def elapsed(self) -> float:
        """Return the time since `watch` [s]."""
        return self.line.loop.time() - self.since

    def requests(self, line: int = 0) -> list[str]:
        """Return the requests on a line since `watch`, such as "a Set" or "all Commit"."""
        return [self._request(line, sent) for _, sent in self.lines[line].sent]

    def sent_after(self, request: str, line: int = 0) -> float:
        """Return the time from `watch` to the first request of this kind on a line [s]."""
        index = self.requests(line).index(request)
        return self.lines[line].sent[index][0] - self.since

    def _request(self, line: int, sent: str) -> str:
        address, number = map(int, sent.split(":"))
        receiver = ["all", *self.lines[line].far][address]
        message = BY_NUMBER[number].name if number in BY_NUMBER else "Hello"
        return f"{receiver} {message}"

    async def wait_until_sent(self, request: str) -> None:
        """Wait until a request is the last on the first line."""
        while self.requests()[-1:] != [request]:  # noqa: ASYNC110
            await asyncio.sleep(0.0001)

    def voices(self, name: str, channel: int = 0) -> tuple[Voice, ...]:
        """Return what an amplifier plays on a channel."""
        self.far[name].tick(self.line.loop.time())
        return self.far[name].playback.all_voices[channel]

    def alter_replies(self, alter: Alter) -> None:
        """Alter all replies on all lines."""
        for line in self.lines:
            line.outward = alter

    async def play(self, level: float) -> None:
        """Play 100 Hz at a level on the first channel of all amplifiers, in layer 0."""
        await self.apply(layer(0, tone(level)))

    async def apply(self, *layers: AmplifierLayer) -> PlayedSet:
        """Apply the same layers to all amplifiers."""
        return await self.group.apply(dict.fromkeys(self.hosts, layers))

    async def beat(self, times: int) -> None:
        """Beat so often, every 50 ms."""
        for _ in range(times):
            await asyncio.sleep(0.05)
            await self.group.beat()

    async def stop(self) -> dict[str, bool]:
        """Stop all amplifiers; return which have confirmed it."""
        outcomes = await self.group.stop()
        for name, outcome in outcomes.items():
            assert outcome.is_confirmed or outcome.cause, name
        return {name: outcome.is_confirmed for name, outcome in outcomes.items()}


async def connect(
    *lines: str, wire: str, is_armed: bool = True, baud: int = 0, **options: Any
) -> Rig:
    """Return an open group of amplifiers, a letter each on each line.

    baud: of serial lines; options: of the group.
    """
    ends = []
    for names in lines:
        host_wire = SerialWire(baud, sequence=0) if baud else None
        ends.append(MemoryLine(wire, *names, wire=host_wire))
    draw = random.Random(7).randint
    return Rig(ends, await group_of(*ends, is_armed=is_armed, draw=draw, **options))


async def begin(request: Awaitable[_T]) -> "asyncio.Future[_T]":
    """Start a request, and let the loop turn once."""
    running = asyncio.ensure_future(request)
    await asyncio.sleep(0)
    return running


def tone(level: float, frequency: float = 100.0, channel: int = 0, **options: Any) -> AmplifierTone:
    """Return a tone; options: of `AmplifierTone`."""
    return AmplifierTone(channel, frequency, level, **options)


def layer(
    number: int, *tones: AmplifierTone, ramp: float = 0.001, **options: Any
) -> AmplifierLayer:
    """Return a layer with a ramp of 1 ms; options: of `AmplifierLayer`."""
    return AmplifierLayer(number, tones, ramp, **options)


def of_parts(count: int, level: float = 0.05) -> list[AmplifierLayer]:
    """Return layers whose set has about so many parts: two onsets of 24 knots take 111 words."""
    onset = Envelope(20, ((100, 0),) * 24)
    tones = [tone(level, onset=onset), tone(level, channel=1, onset=onset)]
    return [layer(number, *tones) for number in range(count)]


def losing(name: str, count: int = 1) -> Alter:
    """Lose so many messages of a name, or their replies."""
    remaining = count

    def alter(message: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal remaining
        if message == name and remaining > 0:
            remaining -= 1
            return []
        return unaltered(message, data)

    return alter


def delay_randomly(line: MemoryLine, chance: random.Random) -> None:
    """Delay bytes by up to 14 ms in each direction, as on a busy machine."""
    line.inward = line.outward = lambda _, data: [(chance.uniform(0.0, 0.014), data)]


def lost(_: str, __: bytes) -> list[tuple[float, bytes]]:
    """Lose all bytes."""
    return []


def late(seconds: float, **by_name: float) -> Alter:
    """Delay bytes by a time [s], or by another one for messages of some names."""
    return lambda name, data: [(by_name.get(name, seconds), data)]


def in_turn(*delays: float) -> Alter:
    """Delay messages by these times [s] in turn, and all later ones by the last."""
    remaining = list(delays)

    def alter(_: str, data: bytes) -> list[tuple[float, bytes]]:
        delay = remaining.pop(0) if len(remaining) > 1 else remaining[0]
        return [(delay, data)]

    return alter


def report(amplifier: SimulatedAmplifier, **values: Any) -> None:
    """Have an amplifier report other values in each status."""
    status = amplifier.status
    amplifier.status = lambda now: {**status(now), **values}  # type: ignore[method-assign]


def intercept(
    amplifier: SimulatedAmplifier, name: str, answer: Callable[[Callable[[], Values]], Values]
) -> None:
    """Have an amplifier answer requests of a name by a function of its own handling."""
    handle = amplifier.handle

    def intercepted(request: str, values: Values, now: float, **options: Any) -> Values:
        def own() -> Values:
            return handle(request, values, now, **options)

        return answer(own) if request == name else own()

    amplifier.handle = intercepted  # type: ignore[method-assign]


def refuse(
    amplifier: SimulatedAmplifier, name: str, status: str, *, after: int = 0, times: int = 99
) -> None:
    """Have an amplifier refuse some requests of a name, once it has taken some."""
    count = 0

    def answer(own: Callable[[], Values]) -> Values:
        nonlocal count
        count += 1
        if after < count <= after + times:
            raise Refusal("as told", status)
        return own()

    intercept(amplifier, name, answer)


def block_writes(line: MemoryLine, *numbers: int) -> None:
    """Have the port of a line reject the writes with these numbers, from 1 on."""
    count = 0

    def blocked(data: bytes) -> None:
        nonlocal count
        count += 1
        if count in numbers:
            raise LinkTimeout("write blocked; check the network")
        MemoryLine.write(line, data)

    line.write = blocked  # type: ignore[method-assign]


def set_unsteered_clock(rig: Rig, name: str, ahead: float) -> None:
    """Give an amplifier a clock that is ahead by a time [s] and cannot be steered."""
    amplifier = rig.far[name]
    amplifier.clock = AmplifierClock(Crystal(ahead=ahead), since=rig.line.loop.time())
    amplifier.capabilities["clock_error"] = CLOCK_UNKNOWN
