"""Clients, files and panels hold the control loop of an armed plate for 5 ms at most.

Measured by the processor time of the loop's thread, which, unlike wall-clock time, is much the same
on a busy machine.
"""

import asyncio
import json
import threading
import time
import types
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.methods import METHODS, TOPICS
from controller.effects.kinds import File
from controller.play.selection import Chooser
from controller.sources import udp_source
from daemons import ENABLED, DaemonBench, daemon_table, holding, ready_daemon
from model.answer.answer_report import Timing
from registry import threads
from several_fingers import frame
from sim.transport.far_end import FarEnd
from virtual_lines import MemoryMachine, VirtualLoop, in_virtual_time

LONGEST, STOPPED_WITHIN = 0.005, 0.020  # s of processor time
ROUNDS = 2  # of which the quicker counts: the first of anything may be slower
FILES = 8  # of 60 s, in each of two layouts
PLACE, THERE = (0.1, 0.02), 5  # in a region, with the file of that number
TOUCHES = [(0.02 * (each % 10) + 0.01, 0.02 * (each // 10) + 0.05) for each in range(20)]


def write_layouts(folder: Path, level: float) -> str:
    """Write two layouts of files in regions with levels of their own; return the daemon's line."""
    for name in ("one", "two"):
        effects, regions = dict[str, Any](), dict[str, Any]()
        for number in range(FILES):
            # Answers to the finger, which are not measured, would take seconds for a long one.
            part = 0.2 if number == THERE else 2.0
            parts = [
                {"Event": {"Time": part * each, "EventDuration": part, **_KIND, **_intensity(each)}}
                for each in range(number, 30)
            ]
            taps = [
                {"Event": {"Time": 0.05 * each, "EventType": "HapticTransient", **_intensity(each)}}
                for each in range(1200)
            ]
            pattern = [*parts, *(taps if number == FILES - 1 else [])]
            content = {"Version": 1.0, "Pattern": pattern}
            (folder / f"{name}{number}.ahap").write_text(json.dumps(content), encoding="utf-8")
            effects[f"e{number}"] = {
                "kind": "file",
                "file": f"{name}{number}.ahap",
                "level": level,
            }
            corners = {"start": [0.018 * number, 0.0], "end": [0.018 * number + 0.018, 0.04]}
            regions[f"r{number}"] = {
                "rectangle": corners,
                "on_press": f"e{number}",
                "level": level - 5,
            }
        layout = {"effects": effects, "regions": regions, "elsewhere": "buzz"}
        (folder / f"{name}.yaml").write_text(json.dumps(layout), encoding="utf-8")
    return "layouts: {one: one.yaml, two: two.yaml}\n"


_KIND = {"EventType": "HapticContinuous"}


def _intensity(number: int) -> dict[str, Any]:
    value = 0.2 + 0.02 * (number % 40)
    return {
        "EventParameters": [{"ParameterID": "HapticIntensity", "ParameterValue": value}],
    }


_LEFT_OUT = (
    (VirtualLoop, "run_in_executor"),
    (Chooser, "choose"),
    (MemoryMachine, "_pass"),
    (FarEnd, "receive"),
)


@contextmanager
def iterations() -> Iterator[list[float]]:
    """Processor time [s] of each iteration of the loop.

    Without what runs in threads or processes elsewhere, far ends and their judges, and without
    answers to touches, whose time depends on the table and on what the machine has compiled
    (`benchmarks/latency`).
    """
    times, apart = list[float](), [0.0]
    once = asyncio.BaseEventLoop._run_once

    def left_out(work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*given: Any) -> Any:
            before, already = time.thread_time(), apart[0]
            try:
                return work(*given)
            finally:
                apart[0] = already + time.thread_time() - before

        return timed

    def measured(loop: asyncio.BaseEventLoop) -> None:
        apart[0], before = 0.0, time.thread_time()
        once(loop)
        times.append(time.thread_time() - before - apart[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.BaseEventLoop, "_run_once", measured)
        for owner, name in _LEFT_OUT:
            patch.setattr(owner, name, left_out(getattr(owner, name)))
        yield times


Panel = Callable[[bytes], None]


@asynccontextmanager
async def touched(folder: Path) -> AsyncIterator[tuple[DaemonBench, AsyncClient, Panel]]:
    """An armed daemon with layouts of many files, a finger that rests, and a panel."""
    received: list[Callable[..., None]] = []

    async def listen(host: str, port: int, given: Callable[..., None], **_: Any) -> Any:
        received.append(given)
        return types.SimpleNamespace(close=lambda: None)

    calibration = "{turned: 90, mirror: x}"
    panel = f"touch: [{{name: panel, url: 'tuio:', calibration: {calibration}}}]\n"
    kept = "strengths: kept.json\ndumps: {folder: dumps}\n"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(udp_source, "listen", listen)
        lines = write_layouts(folder, 20.0) + panel + kept
        async with ready_daemon(folder, lines) as (bench, era):
            await era.arm("me", lease_s=60)
            async with holding(era, PLACE, far=bench.far):
                yield (
                    bench,
                    era,
                    lambda sent: received[0](sent, ("127.0.0.1", 4000), threads.now()),
                )


def calls(folder: Path, bench: DaemonBench, era: AsyncClient, panel: Panel) -> dict[str, Any]:
    """What is sent, by the method of the API or the source, each time with something new."""
    numbers = count()
    # Off the regions: an answer to a long file, which is not measured, would take seconds.
    places = np.random.default_rng(1).uniform(0.25, 0.95, (20, 2)).tolist()

    async def reload() -> None:
        await asyncio.to_thread(write_layouts, folder, 20.0 - 0.1 * next(numbers))
        result = await era.reload()
        assert result.reloaded, result.reasons

    async def play() -> None:
        """Play a file of 60 s at levels at which it was not rendered, and points."""
        for _ in range(20):
            with suppress(RpcError):  # of one that must wait for too many
                await era.play("e3", PLACE, level_db_sl=2 + 0.05 * next(numbers))
        points = [[0.12 * each, 0.5, 0.5] for each in range(250)]
        await era.play(points, PLACE, taps=points)

    async def strength() -> None:
        for each in (await era.status()).strengths:
            await era.strength(each, -0.1 * (next(numbers) % 300))

    async def datagrams() -> None:
        fingers = [(number, x, y) for number, (x, y) in enumerate(places)]
        panel(await asyncio.to_thread(frame, *12 * fingers, fseq=next(numbers) + 1))
        panel(frame(fseq=next(numbers) + 1))

    async def touch() -> None:
        await era.touch(TOUCHES, source="many")
        await era.status()
        await era.touch([], source="many")

    async def follow() -> None:
        table = daemon_table()
        bench.daemon._controller.replace_answers(table, Timing(table))

    async def again(name: str) -> None:
        await era.stop()
        await era.clear()
        if name == "disarm":
            await era.arm("me", lease_s=60)
            await era.disarm()
        await era.arm("me", lease_s=60)

    async def renew() -> None:
        await era.disarm()
        await era.renew((await era.arm("me", lease_s=60)).lease)

    return {
        "hello": lambda: era.hello("me"),
        "status": era.status,
        "arm": lambda: era.arm("another", lease_s=60),
        "renew": renew,
        "disarm": lambda: again("disarm"),
        "stop": lambda: again("stop"),
        "clear": era.clear,
        "forget": era.forget,
        "touch": touch,
        "layout": lambda: era.layout(("two", "one")[next(numbers) % 2]),
        "reload": reload,
        "effects": era.effects,
        "play": play,
        "strength": strength,
        "subscribe": lambda: era.subscribe(*TOPICS, rate_hz=60),
        "unsubscribe": lambda: era.unsubscribe(*TOPICS),
        "datagrams of a panel": datagrams,
        "a table that follows": follow,
    }


@in_virtual_time
async def test_nothing_from_outside_holds_the_loop(tmp_path: Path) -> None:
    """Each method of the API and each source, with as much as it may bring, for 5 ms at most."""
    worst = dict[str, float]()
    async with touched(tmp_path) as (bench, era, panel):
        sent = calls(tmp_path, bench, era, panel)
        assert sent.keys() >= METHODS.keys()
        with iterations() as times:
            for name, send in sent.items():
                longest = []
                for _ in range(ROUNDS):
                    times.clear()
                    with suppress(RpcError):
                        await send()
                    await asyncio.sleep(0.1)
                    longest.append(max(times))
                worst[name] = min(longest)
        assert (await era.status()).state == ENABLED
    assert {name: each for name, each in worst.items() if each > LONGEST} == {}


async def soon(holds: Callable[[], object]) -> None:
    """Wait until a condition holds, without letting time pass: for what threads do."""
    while not holds():  # noqa: ASYNC110
        await asyncio.sleep(0)


@in_virtual_time
async def test_stop_amid_a_reload_is_sent_at_once(tmp_path: Path) -> None:
    """Before the reload has ended, after 20 ms of processor time at most; all get their answers."""
    async with touched(tmp_path) as (bench, era, _), await bench.client("another") as other:
        loop, written = asyncio.get_running_loop(), asyncio.Event()
        assert isinstance(loop, VirtualLoop)
        seen = loop.seen

        def noted(link: str, toward: str, data: bytes) -> None:
            if toward == "amplifier":
                written.set()
            seen(link, toward, data)

        reloads = [asyncio.create_task(era.reload()) for _ in range(3)]
        await soon(lambda: any(each.name == "reload" for each in threading.enumerate()))
        with iterations() as times:  # time stands still, so that no heartbeat is due
            loop.seen = noted
            stopping = asyncio.create_task(other.stop())
            await written.wait()
        assert sum(times) <= STOPPED_WITHIN
        assert not any(each.done() for each in reloads)
        await stopping
        assert all(each.reloaded for each in await asyncio.gather(*reloads))
        assert (await era.status()).state == "QUICK_STOP_ACTIVE"


@in_virtual_time
async def test_content_rendered_amid_a_stop_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused although the plate is armed again by then, and may be played anew."""
    begun, released, prepare = threading.Event(), threading.Event(), File.prepare

    def slow(effect: File, level_db_sl: float | None) -> object:
        begun.set()
        released.wait(60)
        return prepare(effect, level_db_sl)

    steady = [(0.0, 1.0, 0.5), (1.0, 1.0, 0.5)]
    async with ready_daemon(tmp_path) as (bench, era), await bench.client("another") as other:
        monkeypatch.setattr("virtual_lines._AWAITED", ())  # time goes on beside the thread
        await other.arm("me", lease_s=60)
        async with holding(other, PLACE, far=bench.far):
            monkeypatch.setattr(File, "prepare", slow)
            playing = asyncio.create_task(era.play(steady, PLACE))
            await soon(begun.is_set)
            await other.stop()
            await other.clear()
            await other.arm("me", lease_s=60)
            released.set()
            with pytest.raises(RpcError, match="stopped or disarmed meanwhile"):
                await playing
            monkeypatch.setattr("virtual_lines._AWAITED", ("content",))
            await era.play(steady, PLACE)
