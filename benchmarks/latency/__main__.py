"""Time from a touch to the bytes on the wires of a real daemon, and what the daemon costs.

    python -m benchmarks.latency [--touches N] [--report]
    python -m benchmarks.latency --fingers [--touches N]

The daemon, floods and programs that load the machine are processes; the panel and the amplifiers,
behind serial servers, are this one. A touch is sent when the set of the one before has come and no
other is under way, so that the next set is its own; a case with a planted delay proves that. Six
minutes. Beside each figure is how busy other programs kept the processors: on a machine that is not
left alone figures are upper bounds. --report: write docs/measured/latency.md. --fingers: instead,
when ten fingers that land at once in one region are felt, on every rig of the examples, with the
kernels and without a compiler, and the peak memory of the daemon.

Own calls and files on the way are counted with amplifiers in this process, on a line of memory
each, which are left out; time is virtual, so that the counts do not depend on the machine. A touch
goes from its frame to the last byte of its set, answer included, after the first such touch; a
finger rests for two seconds, its frames coming 20 times a second. The floods of clients are those
of the tests (tests/support/processes/floods.py), each a process.
"""

import argparse
import asyncio
import math
import os
import platform
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from itertools import product
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
    peak_memory,
    plain_session,
    rest_one,
    running,
    taps,
)
from benchmarks.setting import write_parts
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.loop import PlayReport
from controller.sources.touch import (
    Touch,
    TouchFrame,
)
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.opening import Lines
from drivers.wires.serial_line import SerialWire
from kit.clock import run_virtual
from model.answer.answer_report import Timing
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table_file import cached_table
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from ways import Recorder

_ROOT = Path(__file__).parents[2]
_FRAME_INTERVAL, _RESTING = 0.05, 2.0  # s
_LEVEL = 15.0  # dB SL


class FarEnd:
    """An amplifier behind a line of memory."""

    is_blocked = False

    def __init__(self, channels: int, written: Callable[[], None]) -> None:
        self._written = written
        self._end = SerialAmplifiers({1: SimulatedAmplifier("any", channels=channels)}, self._reply)
        self.line = Line(SerialWire(0, sequence=0), "line")
        self.line.open(self)

    def write(self, data: bytes) -> None:
        """Take bytes of the host."""
        self._written()
        asyncio.get_running_loop().call_soon(self._receive, data)

    def poll(self) -> None:
        """Do nothing: all that has come was handed over."""

    def _receive(self, data: bytes) -> None:
        self._end.receive(data, asyncio.get_running_loop().time())

    def _reply(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self.line.received, data)


class MemoryLines(Lines):
    """A new line of memory for each amplifier; written: called at each write."""

    def __init__(self, rig: Rig, written: Callable[[], None]) -> None:
        super().__init__()
        self._rig = rig
        self._written = written

    async def amplifier(
        self,
        url: str,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> Amplifier:
        """Return a host's amplifier."""
        wired = [each.number for each in self._rig.wiring.values() if each.amplifier == name]
        far_end = FarEnd(max(wired) + 1, self._written)
        return Amplifier(far_end.line, 1, limits, name=name, is_output=is_output)


async def measure(rig: Rig) -> list[str]:
    """Return the cells of a rig."""
    recorder, played = Recorder(), asyncio.Event()
    table, _ = cached_table(rig)
    controller = Controller(
        rig,
        table,
        lines=lambda before: MemoryLines(rig, recorder.written),
        intent_source=EffectPlayer(SurfaceLayout(effects=default_effects(_LEVEL))),
        timing=Timing(table),
        watchdog=2.0,
    )

    def reported(report: PlayReport) -> None:
        if report.contents:
            played.set()

    controller.cycle.observers.reported.append(reported)
    await controller.open()
    await controller.arm()
    running = asyncio.create_task(controller.cycle.run())
    x, y = rig.plate.length / 3, rig.plate.width / 3

    def deliver(*touches: Touch) -> None:
        controller.cycle.deliver(TouchFrame("panel", asyncio.get_running_loop().time(), touches))

    async def rest() -> None:
        for _ in range(round(_RESTING / _FRAME_INTERVAL)):
            deliver(Touch(3, x, y))
            await asyncio.sleep(_FRAME_INTERVAL)

    deliver(Touch(1, x, y))
    await asyncio.sleep(_FRAME_INTERVAL)
    deliver()
    await asyncio.sleep(1.0)
    with recorder:
        played.clear()
        deliver(Touch(2, x + 0.02, y))
        await played.wait()
    touched = recorder.way(is_until_written=True)
    in_drivers = sum(n for file, n in touched.calls.items() if file.startswith("drivers/"))
    await rest()
    with recorder:
        await rest()
    resting = recorder.way(is_until_written=True).calls.total() / _RESTING
    await controller.close()
    await running
    return [f"{touched.calls.total()}", f"{in_drivers}", f"{len(touched.files)}", f"{resting:.0f}"]


def table(rigs: Mapping[str, str]) -> str:
    """Measure the rigs of examples, whose names are the values; returns a table."""
    rows = [
        "| rig | touch: calls (goal 300) | of these in drivers | files (goal 22) "
        "| resting: calls a second (goal 3000) |",
        "|---|---|---|---|---|",
    ]
    for name, file in rigs.items():
        cells = run_virtual(measure(load_rig(_ROOT / "examples" / f"{file}.yaml")))
        rows.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(rows)


_FLOODS = Path(__file__).parents[2] / "tests" / "support" / "processes/floods.py"
RECONNECTING = ("again", 200)
SLOW, MALFORMED, ASKING = ("unreading", 10), ("garbage", 1), ("asking", 5)
ALL = (SLOW, MALFORMED, ASKING, RECONNECTING)  # these last: they leave no place to others
_SETTLING = 1.0  # s


@asynccontextmanager
async def floods(path: Path, *kinds: tuple[str, int]) -> AsyncIterator[None]:
    """Flood the daemon at a socket while this lasts."""
    async with AsyncExitStack() as stack:
        for kind, count in kinds:
            command = (sys.executable, "-P", _FLOODS, kind, path, count)
            await stack.enter_async_context(running(*command))
        await asyncio.sleep(_SETTLING)
        yield


@asynccontextmanager
async def computing(count: int) -> AsyncIterator[None]:
    """Keep so many processors busy while this lasts."""
    async with AsyncExitStack() as stack:
        for _ in range(count):
            command = (sys.executable, "-c", "while True: sum(range(10_000))")
            await stack.enter_async_context(running(*command, has_line=False))
        yield


async def fresh_stops(session: Session, count: int) -> int:
    """Return how many of so many new clients were served a stop."""
    served = 0
    for _ in range(count):
        with suppress(RpcError, Unreachable):
            async with await AsyncClient.connect(session.socket, name="fresh") as era:
                await era.stop()
                served += 1
    return served


async def round_trips(session: Session, count: int) -> np.ndarray:
    """Return the times [s] of so many touches of the lease's holder, each until its response."""
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
    """Return the times [s] of so many stops beside a finger, from the request of the lease's holder
    to the last byte of the stop at the last amplifier; infinite for one that was not seen."""
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
    """Clear a stop, once the daemon has done with it; raises TimeoutError."""
    async with asyncio.timeout(TIMEOUT):
        while True:
            with suppress(RpcError):
                return await era.clear()
            await asyncio.sleep(0.02)


PAGE = Path(__file__).parents[2] / "docs" / "measured" / "latency.md"
TOUCHES = 300
PLANTED = 0.02  # s
_RIGS = {"4 ERAs on 1": "paper_plate", "16 on 4": "table"}
_PLANTED = (sys.executable, "-m", "benchmarks.latency.planted", PLANTED)
_WITHOUT_KERNELS = (
    *(sys.executable, "-c"),
    "import model.compiled.kernels as compiled\ncompiled.kernels = lambda: None\n"
    "from era_haptics.command import main\nmain()",
    "daemon",
)
_EXAMPLES = ("paper_plate", "tutorial_rig", "eight_eras", "car_display", "glass_panel", "table")
_FINGERS_HEAD = (
    "| rig | kernels | landings | felt after: median, at most | goal | peak memory | other load |\n"
    "|---" + 6 * "|---" + "|"
)
_HEAD = (
    "| case | touches | without a set | sets | median | 99th | maximum | of that amplifiers "
    "| daemon: median | wire | CPU | other load |\n|---" + 11 * "|---" + "|"
)
_FURTHER_HEAD = "| | rig | measured | goal | other load |\n|---|---|---|---|---|"


@dataclass(frozen=True)
class Case:
    """Taps: the name of the rig, and whether they are the baseline's, two at a time, beside floods
    and programs that compute, or delayed; goal [ms] of the median."""

    rig: str
    is_plain: bool = False
    is_two: bool = False
    is_loaded: bool = False
    is_planted: bool = False
    goal: float | None = None

    @property
    def name(self) -> str:
        """For the table."""
        words = (
            "plain asyncio" if self.is_plain else None,
            "two with their own contents" if self.is_two else None,
            "loaded" if self.is_loaded else None,
            f"{1e3 * PLANTED:g} ms planted" if self.is_planted else None,
        )
        return ", ".join([self.rig, *filter(None, words)])


CASES = (
    *(Case(rig, goal=goal) for rig, goal in zip(_RIGS, (1.4, 3.8), strict=True)),
    *(Case(rig, is_two=True, goal=goal) for rig, goal in zip(_RIGS, (2.9, 5.3), strict=True)),
    Case("4 ERAs on 1", is_planted=True),
    Case("4 ERAs on 1", is_loaded=True),
    *(Case(rig, is_plain=True) for rig in _RIGS),
)


@asynccontextmanager
async def opened(case: Case) -> AsyncIterator[Session]:
    """The session of a case, with what loads it."""
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


async def row(case: Case, count: int) -> str:
    """Measure a case; returns its row."""
    async with opened(case) as session:
        load, before = OtherLoad(), computed(session.pid)
        found = await taps(session, count, is_two=case.is_two)
        cost, others = (computed(session.pid) - before) / count, load.processors()
        own = None if session.era is None else (await session.era.status()).latency_ms
    quantiles = np.quantile(found.times, [0.5, 0.99, 1.0], method="inverted_cdf")
    cells = [
        case.name,
        str(count),
        str(found.unanswered),
        str(found.sets),
        *map(_ms, quantiles),
        _ms(found.in_amplifiers),
        "" if own is None or own.median is None else f"{own.median:.2f}",
        _ms(found.wire),
        _ms(cost),
        f"{others:.2f}",
    ]
    if case.goal is not None:
        cells[4] += f" (goal {case.goal:g})"
    return _joined(cells)


async def moving(session: Session, touches: int) -> str:
    """The processor time of ten moving fingers."""
    return await _processor(session, move_ten, touches / 30)


async def resting(session: Session, touches: int) -> str:
    """The processor time of one finger that rests."""
    return await _processor(session, rest_one, touches / 30)


async def fresh(session: Session, touches: int) -> str:
    """How many stops of new clients are served."""
    return f"{await fresh_stops(session, touches // 3)} of {touches // 3}"


async def trips(session: Session, touches: int) -> str:
    """Round trips of the lease's holder."""
    return _late(await round_trips(session, touches))


async def stop_times(session: Session, touches: int) -> str:
    """Times of stops."""
    return _late(await stops(session, touches))


_Act: TypeAlias = Callable[[Session, int], Awaitable[str]]
FURTHER: Sequence[tuple[str, str, str, _Act, tuple[tuple[str, int], ...]]] = (
    ("processor, ten moving fingers at 60 Hz", "4 ERAs on 1", "half", moving, ()),
    ("processor, one finger that rests", "16 on 4", "2 %", resting, ()),
    (
        *("stops of new clients beside 200 that reconnect", "4 ERAs on 1", "all"),
        *(fresh, (RECONNECTING,)),
    ),
    (
        "touch of the lease's holder beside these, slow readers and bad JSON, round trip",
        *("4 ERAs on 1", "99th 20 ms", trips),
        (SLOW, MALFORMED, RECONNECTING),
    ),
    ("stop until the wire, beside all floods", "4 ERAs on 1", "99th 5 ms", stop_times, ALL),
)


async def further_row(
    name: str, rig: str, goal: str, act: _Act, kinds: Sequence[tuple[str, int]], touches: int
) -> str:
    """Measure something else than taps; returns its row."""
    async with daemon_session(_RIGS[rig]) as session, floods(session.socket, *kinds):
        load = OtherLoad()
        text, others = await act(session, touches), load.processors()
    return _joined([name, rig, text, goal, f"{others:.2f}"])


async def fingers_row(rig: str, count: int, *, has_kernels: bool) -> str:
    """Let ten fingers land so often in the west half of a plate; returns a row."""
    program = DAEMON if has_kernels else _WITHOUT_KERNELS
    load, times = OtherLoad(), list[float]()
    async with daemon_session(rig, program=program, is_two=True) as session:
        far = session.far
        for number in range(count):
            far.begin()
            places = [(0.06 + 0.09 * (n % 5), (0.3, 0.7)[n // 5]) for n in range(10)]
            sent_at = session.touch(*(Touch(10 * number + n, *at) for n, at in enumerate(places)))
            found = await far.until(lambda: far.playing_since(1), 2.0)
            times.append(math.inf if found is None else found - sent_at)
            session.touch()
            await far.quiet()
        peak = peak_memory(session.pid)
    median, most = np.quantile(times, [0.5, 1.0], method="inverted_cdf")
    kernels, goal = ("yes", "50 ms") if has_kernels else ("no", "300 ms")
    felt = f"{_ms(median)}, {_ms(most)} ms"
    return _joined(
        [rig, kernels, str(count), felt, goal, f"{peak / 1e6:.0f} MB", f"{load.processors():.2f}"]
    )


async def _processor(
    session: Session, act: Callable[[Session, float], Awaitable[None]], seconds: float
) -> str:
    await act(session, 1.0)
    before = computed(session.pid)
    await act(session, seconds)
    return f"{100 * (computed(session.pid) - before) / seconds:.1f} %"


def _late(times: np.ndarray) -> str:
    median, late, most = np.quantile(times, [0.5, 0.99, 1.0], method="inverted_cdf")
    return f"median {_ms(median)}, 99th {_ms(late)}, at most {_ms(most)} ms (of {len(times)})"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _joined(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


async def measured(touches: int) -> tuple[str, str]:
    """Measure everything with real daemons, printing each row; returns two tables."""
    tables: list[list[str]] = []

    def add(line: str) -> None:
        tables[-1].append(line)
        print(line, flush=True)

    tables.append([])
    add(_HEAD)
    for case in CASES:
        add(await row(case, touches))
    tables.append([])
    add(_FURTHER_HEAD)
    for each in FURTHER:
        add(await further_row(*each, touches))
    first, second = ("\n".join(lines) for lines in tables)
    return first, second


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.latency", description=__doc__)
    parser.add_argument("--touches", type=int, default=TOUCHES, help="of each case")
    parser.add_argument("--report", action="store_true", help="write docs/measured/latency.md")
    parser.add_argument("--fingers", action="store_true", help="ten fingers, on every rig")
    options = parser.parse_args()
    if options.fingers:
        become_device()
        print(_FINGERS_HEAD)
        for rig, has_kernels in product(_EXAMPLES, (True, False)):
            found = asyncio.run(fingers_row(rig, options.touches, has_kernels=has_kernels))
            print(found, flush=True)
        return
    own = table(_RIGS)
    print(own, flush=True)
    note = "" if become_device() else " Real-time priority was not permitted."
    begun = time.monotonic()
    figures, further = asyncio.run(measured(options.touches))
    minutes = (time.monotonic() - begun) / 60
    if options.report:
        note = (
            f"`python -m benchmarks.latency --report` took {minutes:.0f} minutes with "
            f"{options.touches} touches a case (Python {platform.python_version()}, "
            f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors).{note}"
        )
        parts = {"taps": f"{note}\n\n{figures}", "further": further, "calls": own}
        write_parts(PAGE, parts)


if __name__ == "__main__":
    main()
