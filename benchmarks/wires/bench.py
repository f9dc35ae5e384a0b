"""How long exchanges take on a wire whose far end is a process of its own."""

import asyncio
import contextlib
import itertools
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.operation.simultaneous import simultaneous_commits
from drivers.protocol.messages import Capabilities
from drivers.registry import open_backend

CHANNELS = 4
SESSION = 1
CALM = 2.0  # s; the longest watchdog


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
            rate=len(ordered) / sum(ordered),
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


def make_sets(
    capabilities: Capabilities, count: int, *, channels: int = CHANNELS
) -> list[SafeCommandSet]:
    """So many sets of four channels, each with a token of its own."""
    # A guard lets two thousand sets a second through; by this clock they are a second apart.
    seconds = itertools.count(0.0)
    guard = Guard(GuardLimits(10.0, 600.0, 1.0), capabilities, clock=lambda: next(seconds))
    return [
        guard.check(
            CommandSet(
                token=number % 65535 + 1,
                commands=tuple(
                    DriveCommand(channel, 110.0 + number % 50, 0.2) for channel in range(channels)
                ),
                ramp=0.0,
                valid_for=0.0,
            )
        )
        for number in range(count)
    ]


async def ours(url: str, count: int) -> list[float]:
    """The time [s] of each of so many applies through `Amplifier`."""
    amplifier = Amplifier(open_backend(url), reply_timeout=1.0)
    await amplifier.open()
    await amplifier.arm(CALM)
    times = []
    for safe in make_sets(amplifier.capabilities, count):
        begin = time.perf_counter()
        await amplifier.apply(safe)
        times.append(time.perf_counter() - begin)
    await amplifier.disarm()
    await amplifier.close()
    return times


async def all_at_once(urls: Sequence[str], count: int) -> list[float]:
    """The time [s] of each of so many rounds in which every amplifier plays a set."""
    amplifiers = [Amplifier(open_backend(url), reply_timeout=1.0) for url in urls]
    for amplifier in amplifiers:
        await amplifier.open()
        await amplifier.arm(CALM)
    times = []
    for safe in make_sets(amplifiers[0].capabilities, count, channels=1):
        begin = time.perf_counter()
        await asyncio.gather(*(amplifier.apply(safe) for amplifier in amplifiers))
        times.append(time.perf_counter() - begin)
    for amplifier in amplifiers:
        await amplifier.disarm()
        await amplifier.close()
    return times


async def sent_apart(urls: Sequence[str], count: int) -> list[float]:
    """How far apart [s] the commits of each of so many starts go out, the first to the last."""
    amplifiers = [Amplifier(open_backend(url), reply_timeout=1.0) for url in urls]
    for amplifier in amplifiers:
        await amplifier.open()
        await amplifier.arm(CALM)
    apart = []
    for safe in make_sets(amplifiers[0].capabilities, count, channels=1):
        await asyncio.gather(*(amplifier.stage(safe) for amplifier in amplifiers))
        commits = [(one.wire_times.commit(), partial(one.commit, safe.token)) for one in amplifiers]
        await asyncio.gather(*simultaneous_commits(commits))
        sent = [amplifier.last_sent_at for amplifier in amplifiers]
        apart.append(max(sent) - min(sent))
    for amplifier in amplifiers:
        await amplifier.disarm()
        await amplifier.close()
    return apart
