"""How long exchanges take on a wire whose far end is a process of its own."""

import contextlib
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.contents import Layer, Tone
from drivers.errors import CommandRefused
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.protocol.table import QUANTITIES
from registry.limits import GuardLimits

CHANNELS = 4
SESSION = 1
CALM = 2.0  # s; the longest watchdog
REFUSALS = 1000
_LIMITS = GuardLimits(20.0, 1000.0, 1.0)
_LEVEL = 0.2


@dataclass(frozen=True)
class Times:
    """Of many exchanges: median, 99th percentile and maximum [s], and their number per second."""

    median: float
    p99: float
    maximum: float
    rate: float

    @classmethod
    def of(cls, times: Sequence[float]) -> "Times":
        """What single times [s] amount to."""
        ordered = sorted(times)
        return cls(
            median=statistics.median(ordered),
            p99=ordered[int(0.99 * len(ordered))],
            maximum=ordered[-1],
            rate=len(ordered) / (sum(ordered) or 1.0),
        )


@contextlib.contextmanager
def far_end(rig: Path, options: Sequence[str], *, amplifiers: int = 1) -> Iterator[list[str]]:
    """The URLs of the amplifiers of a rig behind a wire, as long as the context lasts."""
    command = [sys.executable, "-P", "-m", "sim", str(rig), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            lines = [process.stdout.readline() for _ in range(amplifiers)]
            yield [line.strip().partition(": ")[2] for line in lines]
        finally:
            process.terminate()


@contextlib.asynccontextmanager
async def armed(urls: Sequence[str]) -> AsyncIterator[Group]:
    """A group of the amplifiers at these URLs, armed, as long as the context lasts."""
    lines = Lines()
    amplifiers: dict[str, Amplifier] = {}
    for number, url in enumerate(urls):
        name = f"amplifier {number}"
        amplifiers[name] = await lines.amplifier(url, _LIMITS, name=name)
    group = Group(amplifiers, watchdog=CALM)
    try:
        await group.open()
        await group.arm()
        yield group
        await group.stop()
    finally:
        await lines.close()


def layer(number: int, *, channels: int = CHANNELS) -> Layer:
    """The layer of the set of a number: every channel, each set with a frequency of its own."""
    frequency = 110.0 + number % 50
    return Layer(0, tuple(Tone(each, frequency, _LEVEL) for each in range(channels)), 0.0)


def make_sets(count: int) -> list[Values]:
    """Return the values of so many Set messages of the same layers, played at once."""
    frequency, level = QUANTITIES["frequency"], QUANTITIES["level"]
    made = []
    for number in range(count):
        commands = tuple(
            Command(one.channel, frequency.to_wire(one.frequency), level.to_wire(one.level), 0)
            for one in layer(number).tones
        )
        stream = pack_layers([LayerSet(0, 0, 0, commands)])
        made += parts(stream, session=SESSION, token=number % 0xFFFF + 1, now=True)
    return made


def arm_values() -> Values:
    """The values of the request that arms."""
    return {"session": SESSION, "watchdog": QUANTITIES["watchdog"].to_wire(CALM)}


async def ours(url: str, count: int) -> list[float]:
    """The time [s] of each of so many sets that the host has an amplifier play at once."""
    async with armed([url]) as group:
        (amplifier,) = group.amplifiers.values()
        return [await _played(amplifier, number) for number in range(count)]


async def after_refusals(url: str, count: int) -> tuple[list[float], list[float]]:
    """Processor times [s] of so many sets before and after 1 000 that the amplifier refuses."""
    async with armed([url]) as group:
        (amplifier,) = group.amplifiers.values()
        before = [await _played(amplifier, each, time.process_time) for each in range(count)]
        for number in range(REFUSALS):
            with contextlib.suppress(CommandRefused):
                await _played(amplifier, number % (count - 1))  # an old token
                raise AssertionError("a set with an old token must be refused")
            await amplifier.ping()  # says that it does not play, and feeds the watchdog
        after = range(count, 2 * count)
        return before, [await _played(amplifier, each, time.process_time) for each in after]


async def _played(
    amplifier: Amplifier, number: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    begin = clock()
    await amplifier.stage(number % 0xFFFF + 1, [layer(number)], now=True)
    return clock() - begin


@dataclass(frozen=True)
class Together:
    """Of rounds in which all amplifiers play: times [s], processor time [s] of each, skews [s]."""

    times: Sequence[float]
    computed: float
    skews: Sequence[float]


async def all_at_once(urls: Sequence[str], count: int) -> Together:
    """Measure so many rounds: staged on all amplifiers, committed at one moment, confirmed."""
    times, skews = [], []
    async with armed(urls) as group:
        computed = time.process_time()
        for number in range(count):
            layers = {name: [layer(number, channels=1)] for name in group.amplifiers}
            begin = time.perf_counter()
            await group.apply(layers)
            times.append(time.perf_counter() - begin)
            sent = [each.played_at for each in group.amplifiers.values()]
            skews.append(max(sent) - min(sent))
        computed = time.process_time() - computed
    return Together(times, computed / count, skews)
