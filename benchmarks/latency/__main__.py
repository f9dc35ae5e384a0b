"""Time from a touch to the bytes on the wires of a real daemon, and the cost of the daemon.

    python -m benchmarks.latency [--touches N] [--report]

The daemon, the floods of clients and the programs that load the machine are separate processes.
This process simulates the panel, and the amplifiers behind serial servers. The next touch is sent
when the set for the last touch has arrived and no other set is being sent, so each set belongs to
its own touch. A case with a planted delay proves that the delay is measured. If the machine has
other load (last column, in processors), the figures are upper bounds. It takes six minutes.

--report writes the section Latency of docs/measured/figures.md.
"""

import argparse
import asyncio
import os
import platform
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from benchmarks.latency.session import (
    DAEMON,
    RESTING,
    TIMEOUT,
    UNANSWERED,
    OtherLoad,
    Session,
    become_device,
    computed,
    daemon_session,
    move_ten,
    plain_session,
    rest_one,
    running,
    taps,
)
from benchmarks.setting import write_parts
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable

_FLOODS = Path(__file__).parents[2] / "tests" / "support" / "processes/floods.py"
RECONNECTING = ("again", 200)
SLOW, MALFORMED, ASKING = ("unreading", 10), ("garbage", 1), ("asking", 5)
ALL = (SLOW, MALFORMED, ASKING, RECONNECTING)  # these last: they leave no place to others
_SETTLING = 1.0  # s


@asynccontextmanager
async def floods(path: Path, *kinds: tuple[str, int]) -> AsyncIterator[None]:
    """Flood the daemon at a socket during a `with` block."""
    async with AsyncExitStack() as stack:
        for kind, count in kinds:
            command = (sys.executable, "-P", _FLOODS, kind, path, count)
            await stack.enter_async_context(running(*command))
        await asyncio.sleep(_SETTLING)
        yield


@asynccontextmanager
async def computing(count: int) -> AsyncIterator[None]:
    """Keep a number of processors busy during a `with` block."""
    async with AsyncExitStack() as stack:
        for _ in range(count):
            command = (sys.executable, "-c", "while True: sum(range(10_000))")
            await stack.enter_async_context(running(*command, has_line=False))
        yield


async def fresh_stops(session: Session, count: int) -> int:
    """Return how many of a number of new clients could stop the plate."""
    served = 0
    for _ in range(count):
        with suppress(RpcError, Unreachable):
            async with await AsyncClient.connect(session.socket, name="fresh") as era:
                await era.stop()
                served += 1
    return served


async def round_trips(session: Session, count: int) -> np.ndarray:
    """Return the times [s] from a touch by the client with the lease to the response."""
    assert session.era is not None
    times = []
    for number in range(count):
        at = session.rig.plate.length * (0.3 + 0.4 * number / count), session.rig.plate.width / 2
        begun = time.monotonic()
        await session.era.touch([at])
        times.append(time.monotonic() - begun)
        await asyncio.sleep(0.01)
    return np.array(times)


async def stops(session: Session, count: int) -> np.ndarray:
    """Return the times [s] from a stop request of the client with the lease to the last byte of the
    stop at the last amplifier, while a finger rests; infinite for a stop that does not arrive."""
    era, far, times = session.era, session.far, []
    assert era is not None
    async with AsyncExitStack() as armed:
        for _ in range(count):
            far.begin()
            session.touch(RESTING)
            await far.until(lambda: far.playing_since(1), UNANSWERED)
            begun = time.monotonic()
            stopping = asyncio.create_task(era.stop())
            stopped_at = await far.until(far.stopped_at, UNANSWERED)
            times.append(np.inf if stopped_at is None else stopped_at - begun)
            session.touch()
            await stopping
            await _clear(era)
            await armed.enter_async_context(era.armed("latency"))
    return np.array(times)


async def _clear(era: AsyncClient) -> None:
    """Clear a stop when the daemon has finished it; raises TimeoutError."""
    async with asyncio.timeout(TIMEOUT):
        while True:
            with suppress(RpcError):
                return await era.clear()
            await asyncio.sleep(0.02)


PAGE = Path(__file__).parents[2] / "docs" / "measured" / "figures.md"
TOUCHES = 300
PLANTED = 0.02  # s
_PLANTED = (sys.executable, "-m", "benchmarks.latency.planted", PLANTED)
_RIGS = {"4 ERAs on 1": "paper_plate", "16 on 4": "table"}
_COLUMNS = (
    "case",
    "without a set",
    "median",
    "99 %",
    "maximum",
    "daemon's own median",
    "processor time",
    "other load",
)
_FURTHER_COLUMNS = ("further", "rig", "measured", "other load")


@dataclass(frozen=True)
class Case:
    """Taps on a named rig: with the plain program, two at a time, under load, or delayed."""

    rig: str
    is_plain: bool = False
    is_two: bool = False
    is_loaded: bool = False
    is_planted: bool = False

    @property
    def name(self) -> str:
        """Name in the table."""
        words = [self.rig]
        if self.is_plain:
            words.append("plain asyncio")
        if self.is_two:
            words.append("two with their own vibrations")
        if self.is_loaded:
            words.append("loaded")
        if self.is_planted:
            words.append(f"{1e3 * PLANTED:g} ms planted")
        return ", ".join(words)


CASES = (
    *(Case(rig) for rig in _RIGS),
    *(Case(rig, is_two=True) for rig in _RIGS),
    Case("4 ERAs on 1", is_planted=True),
    Case("4 ERAs on 1", is_loaded=True),
    *(Case(rig, is_plain=True) for rig in _RIGS),
)


@asynccontextmanager
async def opened(case: Case) -> AsyncIterator[Session]:
    """Open the session of a case, with its load."""
    async with AsyncExitStack() as stack:
        rig = _RIGS[case.rig]
        if case.is_plain:
            session = await stack.enter_async_context(plain_session(rig))
        else:
            program = _PLANTED if case.is_planted else DAEMON
            daemon = daemon_session(rig, program=program, is_two=case.is_two)
            session = await stack.enter_async_context(daemon)
        if case.is_loaded:
            await stack.enter_async_context(floods(session.socket, *ALL))
            await stack.enter_async_context(computing(2))
        yield session


async def case_row(case: Case, count: int) -> str:
    """Measure a case; return its row."""
    async with opened(case) as session:
        load = OtherLoad()
        begin = computed(session.pid)
        answers = await taps(session, count, is_two=case.is_two)
        processor_time = (computed(session.pid) - begin) / count
        other_load = load.processors()
        status = None if session.era is None else await session.era.status()
    median, late, most = np.quantile(answers.times, [0.5, 0.99, 1.0], method="inverted_cdf")
    own_median = None if status is None or status.latency_ms is None else status.latency_ms.median
    own = "" if own_median is None else f"{own_median:.2f}"
    times = f"{_ms(median)} | {_ms(late)} | {_ms(most)} | {own} | {_ms(processor_time)}"
    return f"| {case.name} | {answers.unanswered} of {count} | {times} | {other_load:.2f} |"


async def moving(session: Session, touches: int) -> str:
    """Return the processor time with ten moving fingers."""
    return await _processor(session, move_ten, touches / 30)


async def resting(session: Session, touches: int) -> str:
    """Return the processor time with a resting finger."""
    return await _processor(session, rest_one, touches / 30)


async def fresh(session: Session, touches: int) -> str:
    """Return how many stops of new clients are served."""
    return f"{await fresh_stops(session, touches // 3)} of {touches // 3}"


async def trips(session: Session, touches: int) -> str:
    """Return the round trips of the lease's holder."""
    return _quantiles(await round_trips(session, touches))


async def stop_times(session: Session, touches: int) -> str:
    """Return the times of stops."""
    return _quantiles(await stops(session, touches))


_Act: TypeAlias = Callable[[Session, int], Awaitable[str]]
FURTHER: Sequence[tuple[str, str, _Act, tuple[tuple[str, int], ...]]] = (
    ("processor time, ten moving fingers at 60 Hz", "4 ERAs on 1", moving, ()),
    ("processor time, one resting finger", "16 on 4", resting, ()),
    ("stops of new clients while 200 reconnect", "4 ERAs on 1", fresh, (RECONNECTING,)),
    (
        "round trip of a touch by the client with the lease, under floods",
        "4 ERAs on 1",
        trips,
        (SLOW, MALFORMED, RECONNECTING),
    ),
    ("stop to wire under all floods", "4 ERAs on 1", stop_times, ALL),
)


async def further_row(
    name: str, rig: str, act: _Act, kinds: Sequence[tuple[str, int]], touches: int
) -> str:
    """Measure something other than taps; return its row."""
    async with daemon_session(_RIGS[rig]) as session, floods(session.socket, *kinds):
        load = OtherLoad()
        result = await act(session, touches)
        other_load = load.processors()
    return f"| {name} | {rig} | {result} | {other_load:.2f} |"


async def _processor(
    session: Session, act: Callable[[Session, float], Awaitable[None]], seconds: float
) -> str:
    await act(session, 1.0)
    begin = computed(session.pid)
    await act(session, seconds)
    return f"{100 * (computed(session.pid) - begin) / seconds:.1f} %"


def _quantiles(times: np.ndarray) -> str:
    median, late, most = np.quantile(times, [0.5, 0.99, 1.0], method="inverted_cdf")
    return f"median {_ms(median)}, 99 % {_ms(late)}, maximum {_ms(most)} ms"


def _head(columns: Sequence[str]) -> str:
    return f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


async def measured(touches: int) -> str:
    """Measure everything with real daemons, printing each row; return both tables."""
    lines: list[str] = []

    def add(line: str) -> None:
        lines.append(line)
        print(line, flush=True)

    add(_head(_COLUMNS))
    for case in CASES:
        add(await case_row(case, touches))
    add("")
    add(_head(_FURTHER_COLUMNS))
    for further in FURTHER:
        add(await further_row(*further, touches))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.latency", description=__doc__)
    parser.add_argument("--touches", type=int, default=TOUCHES, help="of each case")
    parser.add_argument("--report", action="store_true", help=f"write {PAGE.name}")
    options = parser.parse_args()
    has_priority = become_device()
    begin = time.monotonic()
    tables = asyncio.run(measured(options.touches))
    minutes = (time.monotonic() - begin) / 60
    if options.report:
        note = (
            f"`python -m benchmarks.latency --report` took {minutes:.0f} minutes with "
            f"{options.touches} touches a case (Python {platform.python_version()}, "
            f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors)."
        )
        if not has_priority:
            note += " Real-time priority was not permitted."
        write_parts(PAGE, {"taps": f"{note}\n\n{tables}"})


if __name__ == "__main__":
    main()
