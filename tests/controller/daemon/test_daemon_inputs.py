"""Touch inputs of a daemon, and clients, files and panels that may hold its loop for 5 ms at most.

Inputs have names for their frames, failures, clients that leave, and several panels. The loop of an
armed plate is measured by the processor time of its thread, which, unlike wall-clock time, is much
the same on a busy machine.
"""

import asyncio
import contextlib
import json
import logging
import math
import random
import socket
import threading
import time
import types
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import make_params
from controller.api.methods import METHODS, TOPICS, InputsEvent
from controller.cli.status_text import show_status
from controller.daemon.config import TouchInput
from controller.daemon.layouts import TouchInputs
from controller.effects.file_effect import File
from controller.gateway.metrics import exposition
from controller.play.chooser import Chooser
from controller.sources import udp_source
from controller.sources.touch import Change, RejectCounter, Touch, TouchFrame, TouchSource
from controller.sources.touch_calibration import TouchCalibration, turned
from examples.make_touches import tuio_datagram
from kit.api_parameters import API_PARAMETERS
from kit.clock import MemoryMachine, VirtualLoop, in_virtual_time
from kit.fingers import bundle, frame, free_port, message, panel
from kit.host_rules import tell_first
from model.errors import InputError
from processes.daemons import (
    ENABLED,
    DaemonBench,
    Journal,
    holding,
    ready_daemon,
    until,
)
from registry import threads
from sim.transport.far_end import FarEnd


@in_virtual_time
async def test_touches_of_clients_are_delivered_and_lifted_when_one_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shares of a plate of 0.3048 by 0.2286 m, from its north-west corner, by client and source.

    They lift at once, of every source but one where that fails, which times out; others' stay.
    """
    frames: list[TouchFrame] = []
    async with ready_daemon(tmp_path) as (bench, era):
        tell_first(bench.daemon.controller.cycle, "deliver", frames.append)
        tracker = bench.daemon.controller.cycle.tracker
        update = tracker.update

        def failing(frame: TouchFrame, **options: bool) -> Change:
            if frame.source == "api:1:fails" and not frame.touches:
                raise ZeroDivisionError
            return update(frame, **options)

        monkeypatch.setattr(tracker, "update", failing)
        async with await bench.client() as leaving:
            await leaving.touch([(0.0762, 0.1143), (0.2286, 0.05715)], source="lifted")
            for source in ("fails", "one"):
                await leaving.touch([(0.1, 0.1)], source=source)
            await leaving.touch([], source="lifted")
            await era.touch([(0.2, 0.1)], source="one")
            down = [contact.source for contact in (await era.status()).contacts]
            assert down == ["api:1:fails", "api:1:one", "api:2:one"]
        first, *_, last = frames
        assert (first.source, first.origin) == ("api:1:lifted", "api:1")
        assert (last.source, last.origin) == ("api:2:one", "api:2")
        assert first.time <= threads.now()
        assert [(contact.x, contact.y) for contact in first.touches] == [
            pytest.approx(place) for place in ((0.25, 0.5), (0.75, 0.75))
        ]
        await asyncio.sleep(0.02)
        down = [contact.source for contact in (await era.status()).contacts]
        assert down == ["api:1:fails", "api:2:one"]


@dataclass
class Panel(TouchSource):
    """Delivers one frame, then continues or fails."""

    name: str
    error: Exception | None = None
    ended: list[str] = field(default_factory=list)

    @property
    def problem(self) -> str | None:
        """Fail, for one of the panels."""
        return None if self.name != "z" else str(1 / 0)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame, of a valid touch and an invalid one."""
        deliver(TouchFrame(self.name, 1.5, (Touch(4, 0.25, 0.5), Touch(5, math.nan, 0)), 3.0))
        if self.error is not None:
            raise self.error
        try:
            await asyncio.Event().wait()
        finally:
            self.ended.append(self.name)


def touch_inputs(
    deliver: Callable[[TouchFrame], None] = lambda frame: None,
    lift: Callable[[str], None] = lambda prefix: None,
) -> TouchInputs:
    """Inputs without a daemon."""
    return TouchInputs(deliver, lift, rejects=RejectCounter(logging.getLogger("test")))


async def test_inputs_run_beside_each_other(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Frames carry the configured name and lie on the plate; a failure lifts, the others run on.

    They keep their time and ids; not finite stays so, for contacts to refuse.
    """
    panels = {
        "a:": Panel("x\x1b[2J"),
        "b:": Panel("y", OSError("unplugged")),
        "c:": Panel("z"),
    }
    monkeypatch.setattr("controller.daemon.config.open_source", panels.__getitem__)
    monkeypatch.setattr("controller.daemon.layouts.WATCH_INTERVAL", 0.01)
    frames: list[TouchFrame] = []
    lifted: list[str] = []
    inputs = touch_inputs(frames.append, lifted.append)
    left_input, two, three = (
        TouchInput(name, url, turned(180))
        for name, url in (("left", "a:"), ("right", "b:"), ("table", "c:"))
    )
    inputs.start([left_input, two, three])
    await until(lambda: len(frames) == 3 and caplog.messages)
    assert sorted(touch_frame.source for touch_frame in frames) == [
        "left:'x\\x1b[2J'",
        "right:y",
        "table:z",
    ]
    for touch_frame in frames:
        assert (touch_frame.time, touch_frame.timeout) == (1.5, 3.0)
        assert touch_frame.touches[0] == Touch(4, 0.75, 0.5)
        assert (touch_frame.touches[1].id, math.isnan(touch_frame.touches[1].x)) == (5, True)
    assert caplog.messages == ["touch source right: failed, restarting: unplugged"]
    assert lifted == ["right:"]
    states = ["open", "missing", "mute"]
    await until(lambda: [event.state for event in inputs.event.inputs] == states)
    await inputs.close()
    assert (panels["a:"].ended, panels["c:"].ended) == (["x\x1b[2J"], ["z"])
    assert sorted(lifted[1:]) == ["left:", "table:"]


LEFT: list[TouchInputs] = []
"""With a source that never ends: kept, for what is collected ends with a warning."""


def test_closing_waits_for_no_source_that_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plug-in that swallows its cancellation holds neither a reload nor the exit."""
    started = asyncio.Event()

    class Stubborn(TouchSource):
        async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
            started.set()
            while True:
                with contextlib.suppress(asyncio.CancelledError):
                    await asyncio.sleep(60)

    monkeypatch.setattr("controller.daemon.config.open_source", lambda url: Stubborn())
    monkeypatch.setattr("controller.daemon.layouts.SOURCE_CLOSE_TIMEOUT", 0.0)

    async def serve() -> None:
        LEFT.append(touch_inputs())
        LEFT[0].start([TouchInput("left", "a:", TouchCalibration())])
        await started.wait()
        await LEFT[0].close()

    program = threading.Thread(target=asyncio.run, args=(serve(),), daemon=True)
    program.start()
    program.join(20)
    assert not program.is_alive()


async def test_failed_input_is_restarted_after_growing_pauses(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Until it finishes without an error."""
    errors: list[Exception | None] = [InputError("not plugged in"), OSError("gone"), None]
    runs: list[str] = []

    class Late(TouchSource):
        async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
            runs.append("run")
            error = errors.pop(0)
            if error is not None:
                raise error

    paused: list[float] = []
    sleep = asyncio.sleep

    async def pause(seconds: float) -> None:
        paused.append(seconds)
        await sleep(0)

    monkeypatch.setattr("controller.daemon.config.open_source", lambda url: Late())
    monkeypatch.setattr("controller.daemon.layouts.asyncio.sleep", pause)
    monkeypatch.setattr("controller.daemon.layouts.WATCH_INTERVAL", 0.5)
    inputs = touch_inputs()
    inputs.start([TouchInput("left", "a:", TouchCalibration())])
    while len(runs) < 3:
        await sleep(0.001)
    failed = "touch source left: failed, restarting: "
    assert caplog.messages == [f"{failed}not plugged in", f"{failed}gone"]
    assert (len(runs), [pause for pause in paused if pause != 0.5]) == (3, [1.0, 2.0])
    assert [event.state for event in inputs.event.inputs] == ["ended"]
    await inputs.close()


@in_virtual_time
async def test_daemon_combines_contacts_of_panels_and_clients(tmp_path: Path) -> None:
    """One is the target, two are quiet; each lies where its source's calibration puts it.

    The plate is 0.3048 m by 0.2286 m, TUIO counts downwards, and one panel is upside down.
    """
    first_port, second_port = free_port(), free_port()
    further_lines = (
        "touch:\n"
        f'  - {{name: left, url: "tuio:127.0.0.1:{first_port}"}}\n'
        f'  - {{name: right, url: "tuio:127.0.0.1:{second_port}", calibration: {{turned: 180}}}}\n'
    )
    async with ready_daemon(tmp_path, further_lines) as (_, era):
        await era.arm("me", lease_s=60)
        positions: dict[tuple[str, int], tuple[float, float]] = {}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 2000):
                for port in (first_port, second_port):
                    frame = TouchFrame("panel", 0.0, (Touch(7, 0.25, 0.25),))
                    sender.sendto(tuio_datagram(frame, number), ("127.0.0.1", port))
                await era.touch([(0.15, 0.1)])
                await asyncio.sleep(0.02)
                contacts = (await era.status()).contacts
                if sorted(contact.role or "" for contact in contacts) == [
                    "quiet",
                    "quiet",
                    "target",
                ]:
                    positions = {
                        (contact.source.partition(":")[0], contact.id): (contact.x_m, contact.y_m)
                        for contact in contacts
                    }
                    break
        assert positions == {
            ("left", 7): pytest.approx((0.0762, 0.17145)),
            ("right", 7): pytest.approx((0.2286, 0.05715)),
            ("api", 1): pytest.approx((0.15, 0.1)),
        }


@in_virtual_time
async def test_daemon_names_inputs_that_are_missing_or_mute(tmp_path: Path) -> None:
    """First in the status, in an event and in the metrics, with what came instead, until it plays.

    What a source rejects is counted with what cannot be a contact.
    """
    port = free_port()
    further_lines = (
        "touch:\n"
        '  - {name: gone, url: "evdev:/dev/input/event987"}\n'
        f'  - {{name: table, url: "tuio:127.0.0.1:{port}"}}\n'
    )
    unknown_profile = bundle(message("set", 1, 0.5, 0.5, 0.1, address="/tuio/25Dblb"))
    fingers = TouchFrame("table", 0.0, (Touch(1, 0.5, 0.5), Touch(2, 1.5, 0.5)))
    async with ready_daemon(tmp_path, further_lines) as (_, era):
        summaries = []
        for datagram in (unknown_profile, tuio_datagram(fingers, 1)):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.sendto(datagram, ("127.0.0.1", port))
            await asyncio.sleep(12)
            status = await era.status()
            summaries.append([line.split(":")[:2] for line in show_status(status).splitlines()])
        await era.subscribe("inputs")
        event = await era.next_event()
    gone, ready = ["touch gone", " missing"], ["ready", *summaries[0][2][1:]]
    assert summaries[0][:3] == [gone, ["touch table", " mute"], ready]
    assert summaries[1][:2] == [gone, ready]
    assert status.rejected_touches == {"profile_25Dblb": 1, "off_plate": 1}
    assert "/tuio/25Dblb" in status.rejected_examples["profile_25Dblb"]
    assert InputsEvent.model_validate(event.data).inputs == status.inputs
    exposed = exposition(status).decode()
    assert 'era_touch_input_open{input="gone"} 0.0' in exposed
    assert 'era_touch_input_open{input="table"} 1.0' in exposed


@in_virtual_time
async def test_few_of_a_flood_of_touches_become_sets(tmp_path: Path) -> None:
    """Of three fingers that jump at 10 kHz fewer than a quarter; silent once they lift.

    A touch that came and went during a pause, whose frames are read together, 120 ms and 60 ms
    after they came, plays nothing.
    """
    port, chance, count = free_port(), random.Random(3), 1000
    async with ready_daemon(tmp_path, panel(port)) as (bench, era):
        journal = Journal(bench.far)
        await era.arm("me", lease_s=60)
        begin = threads.now()
        for ago, touches in ((0.12, (Touch(1, 0.4, 0.5),)), (0.06, ())):
            bench.daemon.controller.cycle.deliver(TouchFrame("brief", begin - ago, touches))
        await journal.hear(10)
        assert not journal.raising_since(begin)
        begin = threads.now()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(count + 1):
                touches = tuple(
                    Touch(finger, chance.uniform(0.1, 0.9), chance.uniform(0.1, 0.9))
                    for finger in range(3 if number < count else 0)
                )
                frame = TouchFrame("flood", 0.0, touches)
                sender.sendto(tuio_datagram(frame, -1), ("127.0.0.1", port))
                await asyncio.sleep(1e-4)
        assert journal.raising_since(begin)
        await until(lambda: not any(bench.far.summary().levels))
        silent = threads.now()
        await journal.hear(5)
        assert not journal.raising_since(silent)
        assert len(journal.raising_since(begin)) < count / 4


LONGEST, STOPPED_WITHIN = 5, 20  # ms of processor time, of a machine that does `unit` in one
_JOB = [{"number": number, "values": [0.1 * number] * 8} for number in range(180)]
ROUNDS = 5  # of which the quickest counts: the first of anything may be slower
FILES = 8  # of 60 s, in each of two layouts
PLACE, THERE = (0.1, 0.02), 5  # in a region, with the file of that number
TOUCHES = [(0.02 * (number % 10) + 0.01, 0.02 * (number // 10) + 0.05) for number in range(20)]


def write_layouts(folder: Path, level: float) -> str:
    """Write two layouts of files in regions with levels of their own; return the daemon's line."""
    for name in ("one", "two"):
        effects, regions = dict[str, Any](), dict[str, Any]()
        for number in range(FILES):
            # Answers to the finger, which are not measured, would take seconds for a long one.
            part = 0.2 if number == THERE else 2.0
            parts = [
                {
                    "Event": {
                        "Time": part * index,
                        "EventDuration": part,
                        **_KIND,
                        **_intensity(index),
                    }
                }
                for index in range(number, 30)
            ]
            taps = [
                {
                    "Event": {
                        "Time": 0.05 * index,
                        "EventType": "HapticTransient",
                        **_intensity(index),
                    }
                }
                for index in range(1200)
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
        def timed(*arguments: Any) -> Any:
            start, already = time.thread_time(), apart[0]
            try:
                return work(*arguments)
            finally:
                apart[0] = already + time.thread_time() - start

        return timed

    def measured(loop: asyncio.BaseEventLoop) -> None:
        apart[0], start = 0.0, time.thread_time()
        once(loop)
        times.append(time.thread_time() - start - apart[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.BaseEventLoop, "_run_once", measured)
        for owner, name in _LEFT_OUT:
            patch.setattr(owner, name, left_out(getattr(owner, name)))
        yield times


def unit() -> float:
    """Processor time [s] of a job in plain Python, beside what else this machine does now."""
    times = []
    for _ in range(15):
        start = time.thread_time()
        json.loads(json.dumps(_JOB))
        times.append(time.thread_time() - start)
    return float(np.median(times))


LoopIsFreePanel = Callable[[bytes], None]


@asynccontextmanager
async def touched(folder: Path) -> AsyncIterator[tuple[DaemonBench, AsyncClient, LoopIsFreePanel]]:
    """An armed daemon with layouts of many files, a finger that rests, and a panel."""
    received: list[Callable[..., None]] = []

    async def listen(host: str, port: int, receiver: Callable[..., None], **_: Any) -> Any:
        received.append(receiver)
        return types.SimpleNamespace(close=lambda: None)

    calibration = "{turned: 90, mirror: x}"
    panel = f"touch: [{{name: panel, url: 'tuio:', calibration: {calibration}}}]\n"
    strengths = "strengths: kept.json\n"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(udp_source, "listen", listen)
        lines = write_layouts(folder, 20.0) + panel + strengths
        async with ready_daemon(folder, lines) as (bench, era):
            await era.arm("me", lease_s=60)
            async with holding(era, PLACE, far=bench.far):
                yield (
                    bench,
                    era,
                    lambda sent: received[0](sent, ("127.0.0.1", 4000), threads.now()),
                )


def calls(
    folder: Path, bench: DaemonBench, era: AsyncClient, panel: LoopIsFreePanel
) -> dict[str, Any]:
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
        points = [[0.12 * number, 0.5, 0.5] for number in range(250)]
        await era.play(points, PLACE, taps=points)

    async def strength() -> None:
        for name in (await era.status()).strengths:
            await era.strength(name, -0.1 * (next(numbers) % 300))

    async def datagrams() -> None:
        fingers = [(number, x, y) for number, (x, y) in enumerate(places)]
        panel(await asyncio.to_thread(frame, *12 * fingers, fseq=next(numbers) + 1))
        panel(frame(fseq=next(numbers) + 1))

    async def touch() -> None:
        await era.touch(TOUCHES, source="many")
        await era.status()
        await era.touch([], source="many")

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

    async def request(name: str) -> None:
        await era.request(name, make_params(name, **API_PARAMETERS[name]))

    return {name: partial(request, name) for name in API_PARAMETERS} | {
        "arm": lambda: era.arm("another", lease_s=60),
        "renew": renew,
        "disarm": lambda: again("disarm"),
        "stop": lambda: again("stop"),
        "clear": era.clear,
        "touch": touch,
        "layout": lambda: era.layout(("two", "one")[next(numbers) % 2]),
        "reload": reload,
        "play": play,
        "strength": strength,
        "subscribe": lambda: era.subscribe(*TOPICS, rate_hz=60),
        "unsubscribe": lambda: era.unsubscribe(*TOPICS),
        "datagrams of a panel": datagrams,
    }


@in_virtual_time
async def test_nothing_from_outside_holds_the_loop(tmp_path: Path) -> None:
    """Each method of the API and each source, with as much as it may bring, for 5 ms at most.

    These are of a machine that does the job of `unit` in one, measured beside each round: other
    processes may take the processor's caches at any time.
    """
    worst = dict[str, float]()
    async with touched(tmp_path) as (bench, era, panel):
        sent = calls(tmp_path, bench, era, panel)
        assert sent.keys() >= METHODS.keys()
        with iterations() as times:
            for name, send in sent.items():
                for _ in range(ROUNDS):
                    times.clear()
                    with suppress(RpcError):
                        await send()
                    await asyncio.sleep(0.1)
                    now = max(times) / await asyncio.to_thread(unit)
                    worst[name] = min(now, worst.get(name, math.inf))
                    if worst[name] <= LONGEST:
                        break
        assert (await era.status()).state == ENABLED
    assert {name: duration for name, duration in worst.items() if duration > LONGEST} == {}


async def soon(holds: Callable[[], object]) -> None:
    """Wait until a condition holds, without letting time pass: for what threads do."""
    while not holds():  # noqa: ASYNC110
        await asyncio.sleep(0)


@in_virtual_time
async def test_stop_amid_a_reload_is_sent_at_once(tmp_path: Path) -> None:
    """Before the reload has ended, after 20 ms of processor time at most; all get their answers."""
    async with (
        touched(tmp_path) as (bench, era, _),
        await bench.client("another") as stopping_client,
    ):
        loop, written = asyncio.get_running_loop(), asyncio.Event()
        assert isinstance(loop, VirtualLoop)
        observe = loop.seen

        def noted(link: str, toward: str, data: bytes) -> None:
            if toward == "amplifier":
                written.set()
            observe(link, toward, data)

        reloads = [asyncio.create_task(era.reload()) for _ in range(3)]
        await soon(lambda: any(reload.name == "reload" for reload in threading.enumerate()))
        with iterations() as times:  # time stands still, so that no heartbeat is due
            loop.seen = noted
            stopping = asyncio.create_task(stopping_client.stop())
            await written.wait()
        assert sum(times) <= STOPPED_WITHIN * unit()
        assert not any(reload.done() for reload in reloads)
        await stopping
        assert all(reload.reloaded for reload in await asyncio.gather(*reloads))
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
    async with (
        ready_daemon(tmp_path) as (bench, era),
        await bench.client("another") as stopping_client,
    ):
        monkeypatch.setattr("kit.clock._AWAITED", ())  # time goes on beside the thread
        await stopping_client.arm("me", lease_s=60)
        async with holding(stopping_client, PLACE, far=bench.far):
            monkeypatch.setattr(File, "prepare", slow)
            playing = asyncio.create_task(era.play(steady, PLACE))
            await soon(begun.is_set)
            await stopping_client.stop()
            await stopping_client.clear()
            await stopping_client.arm("me", lease_s=60)
            released.set()
            with pytest.raises(RpcError, match="stopped or disarmed meanwhile"):
                await playing
            monkeypatch.setattr("kit.clock._AWAITED", ("content",))
            await era.play(steady, PLACE)
