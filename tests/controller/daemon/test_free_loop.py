"""No client, file or panel holds the loop of a daemon for more than 5 ms.

The loop of an armed plate is measured by the processor time of its thread, which, unlike wall-clock
time, is much the same on a busy machine.
"""

import asyncio
import json
import math
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import make_params
from controller.api.methods import METHODS, TOPICS
from controller.effects.file_effect import File
from controller.play.chooser import Chooser
from controller.sources import udp_source
from kit.api_parameters import API_PARAMETERS
from kit.clock import MemoryMachine, VirtualLoop, in_virtual_time
from kit.fingers import frame
from processes.daemons import ENABLED, DaemonBench, holding, ready_daemon
from registry import threads
from sim.transport.far_end import FarEnd

LONGEST = 5
"""Longest processor time of an iteration [ms], of a machine that does `unit` in one."""
STOPPED_WITHIN = 20
"""Processor time until a stop is sent [ms], of the same machine."""
ROUNDS = 5
"""Of which the quickest counts: the first of anything may be slower."""
FILES = 8
"""Files of 60 s in each of two layouts."""
TOUCHED_FILE = 5
"""The file of the region that is touched, with short parts.

Answers to the finger, which are not measured, would take seconds for long parts.
"""
PLACE = (0.1, 0.02)
"""In that region [m]."""
JOB = [{"number": number, "values": [0.1 * number] * 8} for number in range(180)]
TWENTY_TOUCHES = [(0.02 * (n % 10) + 0.01, 0.02 * (n // 10) + 0.05) for n in range(20)]


def haptic_event(time: float, kind: str, number: int, **options: float) -> dict[str, Any]:
    """An event of AHAP with an intensity that depends on its number."""
    intensity = {"ParameterID": "HapticIntensity", "ParameterValue": 0.2 + 0.02 * (number % 40)}
    event = {"Time": time, "EventType": kind, "EventParameters": [intensity], **options}
    return {"Event": event}


def write_content(path: Path, number: int) -> None:
    """Write a file of parts, the last of the files with 1200 taps as well."""
    duration = 0.2 if number == TOUCHED_FILE else 2.0
    pattern = [
        haptic_event(duration * part, "HapticContinuous", part, EventDuration=duration)
        for part in range(number, 30)
    ]
    if number == FILES - 1:
        pattern += [haptic_event(0.05 * tap, "HapticTransient", tap) for tap in range(1200)]
    content = {"Version": 1.0, "Pattern": pattern}
    path.write_text(json.dumps(content), encoding="utf-8")


def write_layouts(folder: Path, level: float) -> str:
    """Write two layouts of files in regions with levels of their own; return the daemon's line."""
    for name in ("one", "two"):
        effects, regions = dict[str, Any](), dict[str, Any]()
        for number in range(FILES):
            file = f"{name}{number}.ahap"
            write_content(folder / file, number)
            effects[f"e{number}"] = {"kind": "file", "file": file, "level": level}
            west = 0.018 * number
            regions[f"r{number}"] = {
                "rectangle": {"start": [west, 0.0], "end": [west + 0.018, 0.04]},
                "on_press": f"e{number}",
                "level": level - 5,
            }
        layout = {"effects": effects, "regions": regions, "elsewhere": "buzz"}
        (folder / f"{name}.yaml").write_text(json.dumps(layout), encoding="utf-8")
    return "layouts: {one: one.yaml, two: two.yaml}\n"


NOT_MEASURED = (
    (VirtualLoop, "run_in_executor"),
    (Chooser, "choose"),
    (MemoryMachine, "_pass"),
    (FarEnd, "receive"),
)
"""What runs in threads or processes elsewhere, far ends and their judges, and answers to touches.

The time of an answer depends on the table and on what the machine has compiled; it has a benchmark
of its own (`benchmarks/latency`).
"""


@contextmanager
def iterations() -> Iterator[list[float]]:
    """Processor time [s] of each iteration of the loop, without what is not measured."""
    times = list[float]()
    excluded = [0.0]
    run_once = asyncio.BaseEventLoop._run_once

    def exclude(work: Callable[..., Any]) -> Callable[..., Any]:
        def run_excluded(*arguments: Any) -> Any:
            start = time.thread_time()
            excluded_at_start = excluded[0]
            try:
                return work(*arguments)
            finally:
                excluded[0] = excluded_at_start + time.thread_time() - start

        return run_excluded

    def run_measured(loop: asyncio.BaseEventLoop) -> None:
        excluded[0] = 0.0
        start = time.thread_time()
        run_once(loop)
        times.append(time.thread_time() - start - excluded[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.BaseEventLoop, "_run_once", run_measured)
        for owner, name in NOT_MEASURED:
            patch.setattr(owner, name, exclude(getattr(owner, name)))
        yield times


def unit() -> float:
    """Processor time [s] of a job in plain Python, beside what else this machine does now."""
    times = list[float]()
    for _ in range(15):
        start = time.thread_time()
        json.loads(json.dumps(JOB))
        times.append(time.thread_time() - start)
    return float(np.median(times))


@dataclass
class BusyPlate:
    """An armed daemon with layouts of many files, on which a finger rests."""

    folder: Path
    bench: DaemonBench
    era: AsyncClient
    receivers: list[Callable[..., None]]
    """What gets the datagrams of the panel."""
    numbers: Iterator[int] = field(default_factory=count)
    """So that each request brings something new."""

    def receive(self, datagram: bytes) -> None:
        """Receive a datagram of the panel."""
        self.receivers[0](datagram, ("127.0.0.1", 4000), threads.now())

    async def arm(self) -> None:
        """Arm for another client."""
        await self.era.arm("another", lease_s=60)

    async def renew(self) -> None:
        """Arm, and renew the lease."""
        await self.era.disarm()
        lease = await self.era.arm("me", lease_s=60)
        await self.era.renew(lease.lease)

    async def stop(self) -> None:
        """Stop, and arm again."""
        await self.era.stop()
        await self.era.clear()
        await self.era.arm("me", lease_s=60)

    async def disarm(self) -> None:
        """Disarm, and arm again."""
        await self.era.disarm()
        await self.era.arm("me", lease_s=60)

    async def touch(self) -> None:
        """Report twenty fingers, read the status, and lift them."""
        await self.era.touch(TWENTY_TOUCHES, source="many")
        await self.era.status()
        await self.era.touch([], source="many")

    async def layout(self) -> None:
        """Change to the other layout."""
        names = ("two", "one")
        await self.era.layout(names[next(self.numbers) % 2])

    async def reload(self) -> None:
        """Reload layouts with another level."""
        level = 20.0 - 0.1 * next(self.numbers)
        await asyncio.to_thread(write_layouts, self.folder, level)
        verdict = await self.era.reload()
        assert verdict.reloaded, verdict.reasons

    async def play(self) -> None:
        """Play a file of 60 s at levels at which it was not rendered, and points."""
        for _ in range(20):
            with suppress(RpcError):  # of one that must wait for too many
                level = 2 + 0.05 * next(self.numbers)
                await self.era.play("e3", PLACE, level_db_sl=level)
        points = [(0.12 * number, 0.5, 0.5) for number in range(250)]
        await self.era.play(points, PLACE, taps=points)

    async def strength(self) -> None:
        """Change every strength."""
        for name in (await self.era.status()).strengths:
            gain = -0.1 * (next(self.numbers) % 300)
            await self.era.strength(name, gain)

    async def subscribe(self) -> None:
        """Subscribe to all topics at the highest rate."""
        await self.era.subscribe(*TOPICS, rate_hz=60)

    async def unsubscribe(self) -> None:
        """Subscribe to none."""
        await self.era.unsubscribe(*TOPICS)

    async def receive_fingers(self) -> None:
        """Receive a datagram with 240 fingers off the regions, then one without."""
        places = np.random.default_rng(1).uniform(0.25, 0.95, (20, 2)).tolist()
        fingers = [(number, x, y) for number, (x, y) in enumerate(places)]
        datagram = await asyncio.to_thread(frame, *12 * fingers, fseq=next(self.numbers) + 1)
        self.receive(datagram)
        self.receive(frame(fseq=next(self.numbers) + 1))

    async def request(self, method: str) -> None:
        """Request a method with parameters that are valid, as far as the state allows."""
        await self.era.request(method, make_params(method, **API_PARAMETERS[method]))

    def requests(self) -> Mapping[str, Callable[[], Awaitable[None]]]:
        """What may come from outside: each method of the API, with much to do, and a panel."""
        requests: dict[str, Callable[[], Awaitable[None]]] = {}
        for name in API_PARAMETERS:
            requests[name] = getattr(self, name, partial(self.request, name))
        requests["datagrams of a panel"] = self.receive_fingers
        return requests


@asynccontextmanager
async def busy_plate(folder: Path) -> AsyncIterator[BusyPlate]:
    """An armed daemon with layouts of many files, a finger that rests, and a panel."""
    receivers = list[Callable[..., None]]()

    async def listen(host: str, port: int, receiver: Callable[..., None], **_: Any) -> Any:
        receivers.append(receiver)
        return SimpleNamespace(close=lambda: None)

    calibration = "{turned: 90, mirror: x}"
    panel = f"touch: [{{name: panel, url: 'tuio:', calibration: {calibration}}}]\n"
    strengths = "strengths: kept.json\n"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(udp_source, "listen", listen)
        lines = write_layouts(folder, 20.0) + panel + strengths
        async with ready_daemon(folder, lines) as (bench, era):
            await era.arm("me", lease_s=60)
            async with holding(era, PLACE, far=bench.far):
                yield BusyPlate(folder, bench, era, receivers)


async def shortest_of_longest(request: Callable[[], Awaitable[None]], times: list[float]) -> float:
    """The longest iteration that a request causes, in the quickest round, in units of the machine.

    The unit is measured beside each round: other processes may take the processor's caches at any
    time.
    """
    shortest = math.inf
    for _ in range(ROUNDS):
        times.clear()
        with suppress(RpcError):
            await request()
        await asyncio.sleep(0.1)
        longest = max(times) / await asyncio.to_thread(unit)
        shortest = min(longest, shortest)
        if shortest <= LONGEST:
            break
    return shortest


@in_virtual_time
async def test_nothing_from_outside_holds_the_loop(tmp_path: Path) -> None:
    """Each method of the API and each source, with as much as it may bring, for 5 ms at most."""
    async with busy_plate(tmp_path) as plate:
        requests = plate.requests()
        assert requests.keys() >= METHODS.keys()
        too_long = dict[str, float]()
        with iterations() as times:
            for name, request in requests.items():
                duration = await shortest_of_longest(request, times)
                if duration > LONGEST:
                    too_long[name] = duration
        assert too_long == {}
        assert (await plate.era.status()).state == ENABLED


async def soon(holds: Callable[[], object]) -> None:
    """Wait until a condition holds, without letting time pass: for what threads do."""
    while not holds():  # noqa: ASYNC110
        await asyncio.sleep(0)


def names_of_threads() -> list[str]:
    """The names of all threads that run now."""
    return [thread.name for thread in threading.enumerate()]


@in_virtual_time
async def test_stop_amid_a_reload_is_sent_at_once(tmp_path: Path) -> None:
    """Before the reload has ended, after 20 ms of processor time at most; all get their answers."""
    async with busy_plate(tmp_path) as plate, await plate.bench.client("another") as guest:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        is_written = asyncio.Event()
        observe = loop.seen

        def note_writing(link: str, toward: str, data: bytes) -> None:
            if toward == "amplifier":
                is_written.set()
            observe(link, toward, data)

        reloads = [asyncio.create_task(plate.era.reload()) for _ in range(3)]
        await soon(lambda: "reload" in names_of_threads())
        with iterations() as times:  # time stands still, so that no heartbeat is due
            loop.seen = note_writing
            stopping = asyncio.create_task(guest.stop())
            await is_written.wait()

        assert sum(times) <= STOPPED_WITHIN * unit()
        assert [reload.done() for reload in reloads] == [False] * 3
        await stopping
        verdicts = await asyncio.gather(*reloads)
        assert [verdict.reloaded for verdict in verdicts] == [True] * 3
        assert (await plate.era.status()).state == "QUICK_STOP_ACTIVE"


@in_virtual_time
async def test_content_rendered_amid_a_stop_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused although the plate is armed again by then, and may be played anew."""
    is_begun, is_released = threading.Event(), threading.Event()
    prepare = File.prepare

    def prepare_slowly(effect: File, level_db_sl: float | None) -> object:
        is_begun.set()
        is_released.wait(60)
        return prepare(effect, level_db_sl)

    steady = [(0.0, 1.0, 0.5), (1.0, 1.0, 0.5)]
    async with ready_daemon(tmp_path) as (bench, era), await bench.client("another") as guest:
        monkeypatch.setattr("kit.clock._AWAITED", ())  # time goes on beside the thread
        await guest.arm("me", lease_s=60)
        async with holding(guest, PLACE, far=bench.far):
            monkeypatch.setattr(File, "prepare", prepare_slowly)
            playing = asyncio.create_task(era.play(steady, PLACE))
            await soon(is_begun.is_set)
            await guest.stop()
            await guest.clear()
            await guest.arm("me", lease_s=60)

            is_released.set()
            with pytest.raises(RpcError, match="stopped or disarmed meanwhile"):
                await playing

            monkeypatch.setattr("kit.clock._AWAITED", ("content",))
            await era.play(steady, PLACE)
