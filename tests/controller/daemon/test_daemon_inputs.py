"""Touch inputs of a daemon: names of their frames, failures, clients that leave, several panels."""

import asyncio
import contextlib
import logging
import math
import random
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.api.methods import InputsEvent
from controller.cli.status_text import show_status
from controller.daemon.config import TouchInput
from controller.daemon.layouts import TouchInputs
from controller.gateway.metrics import exposition
from controller.sources.touch import Change, RejectCounter, Touch, TouchFrame, TouchSource
from controller.sources.touch_calibration import TouchCalibration, turned
from examples.make_touches import tuio_datagram
from kit.clock import in_virtual_time
from kit.fingers import bundle, free_port, message, panel
from kit.host_rules import tell_first
from model.errors import InputError
from processes.daemons import (
    Journal,
    ready_daemon,
    until,
)
from registry import threads


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
        places = [(touch.x, touch.y) for touch in first.touches]
        assert places == [pytest.approx((0.25, 0.5)), pytest.approx((0.75, 0.75))]
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
    urls = {"left": "a:", "right": "b:", "table": "c:"}

    inputs.start([TouchInput(name, url, turned(180)) for name, url in urls.items()])
    await until(lambda: len(frames) == 3 and caplog.messages)

    sources = [touch_frame.source for touch_frame in frames]
    assert sorted(sources) == ["left:'x\\x1b[2J'", "right:y", "table:z"]
    for touch_frame in frames:
        valid, invalid = touch_frame.touches
        assert (touch_frame.time, touch_frame.timeout) == (1.5, 3.0)
        assert valid == Touch(4, 0.75, 0.5)
        assert invalid.id == 5
        assert math.isnan(invalid.x)
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
    restart_pauses = [seconds for seconds in paused if seconds != 0.5]
    assert restart_pauses == [1.0, 2.0]
    assert [event.state for event in inputs.event.inputs] == ["ended"]
    await inputs.close()


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
