"""A daemon in use, in virtual time: dumps, layouts, signals and the service manager, strengths.

Dumps have what came before the plate was stopped; layouts are chosen by name; strengths of touch
sources, clients and regions act from the API to the skin.
"""

import asyncio
import contextlib
import json
import math
import os
import signal
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.api.client import AsyncClient, Client
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.cli.main import BAD_INPUT, run
from controller.demo.demonstration import layout_of_people
from controller.effects.strengths import MAX_NAMES
from controller.operation.fault_dumps import (
    MAX_LINE,
    MAX_RECORDS,
    FaultDumps,
    write_dump,
)
from controller.play.intent import BEING_CHOSEN, NO_CONTACTS
from controller.play.selection import GIVEN_UP
from courses import Planted
from daemons import (
    ENABLED,
    PLACE,
    READY,
    DaemonBench,
    Journal,
    daemon_at,
    energised,
    error_code,
    far_end,
    holding,
    next_event,
    ready_daemon,
    silent_from,
    until,
    until_state,
)
from drivers.host.amplifier import WATCHDOG
from drivers.protocol.definition import QUANTITIES
from gateway_bench import real_daemon
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import TWO_AMPLIFIERS, make_paper_rig
from registry import threads
from several_fingers import answers_take
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time


def dumped(folder: Path, kind: str) -> list[str]:
    """The dumps of a kind."""
    return [each.read_text("utf-8") for each in folder.glob(f"dumps/era-{kind}-*.jsonl")]


async def fails_in_the_loop(bench: DaemonBench, era: AsyncClient) -> None:
    """Let a turn of the control loop fail once."""

    def fail() -> bool:
        del vars(bench.daemon._controller.cycle._wake)["clear"]
        raise Planted("in the loop")

    vars(bench.daemon._controller.cycle._wake)["clear"] = fail


async def reports_a_fault(bench: DaemonBench, era: AsyncClient) -> None:
    """Let the amplifier have a fault."""
    bench.far.device.inject_fault(FaultWindow(fault="over_voltage"))


async def is_stopped(bench: DaemonBench, era: AsyncClient) -> None:
    """Stop as a client."""
    await era.stop()


@pytest.mark.parametrize(
    ("stops", "kind", "cause"),
    [
        (fails_in_the_loop, "fault", "in the loop"),
        (reports_a_fault, "fault", "OVER_VOLTAGE"),
        (is_stopped, "stop", "stopped by 'test'"),
    ],
)
@in_virtual_time
async def test_dump_names_the_last_touch_and_request_before_a_stop(
    tmp_path: Path,
    stops: Callable[[DaemonBench, AsyncClient], Awaitable[None]],
    kind: str,
    cause: str,
) -> None:
    """With what was played for the finger, what was refused, and how the plate came to stop."""
    async with ready_daemon(tmp_path, "dumps: {folder: dumps}\n") as (bench, era):
        lease = await era.arm("me", lease_s=30)
        assert await error_code(era.play("none", PLACE)) is ErrorCode.REFUSED
        async with holding(era, far=bench.far):
            await stops(bench, era)
            await until(lambda: dumped(tmp_path, kind))
        bench.far.device.recover()
    (text,) = dumped(tmp_path, kind)
    head, *lines = map(json.loads, text.splitlines())
    assert cause in head["cause"]
    assert lease.lease not in text

    def last(key: str, value: object = None) -> Any:
        """The last record with a key, or with a value of it."""
        return [each for each in lines if each.get(key) and value in (None, each[key])][-1]

    (finger,), (felt,) = last("contacts")["contacts"], last("pattern")["pattern"]
    assert (finger["key"], finger["x"]) == (["api:1:python", 1], pytest.approx(PLACE[0]))
    assert (felt["contact"]["key"], felt["verdict"]) == (finger["key"], "own")
    assert (last("request", "touch")["client"], last("request", "arm")["outcome"]) == (
        *("test", "done"),
    )
    assert "unknown effect" in last("request", "play")["refused"]
    assert last("request", "stop" if kind == "stop" else "touch")["time_s"] >= finger["since"]
    assert last("state")["state"].startswith("OPERATION_ENABLED -> ")
    assert {"Arm", "Set", "Reply"} <= {each.get("message") for each in lines}
    assert (times := [each["time_s"] for each in lines]) == sorted(times)


def test_what_is_kept_for_a_dump_is_bounded(tmp_path: Path) -> None:
    """Whatever comes, in number and in length; a client that repeats itself leaves the others."""
    dumps, long = FaultDumps(tmp_path), "x" * 70_000
    dumps.requested("other", "arm", 0.0)
    for _ in range(10 * MAX_RECORDS):
        dumps.requested("me", "touch", 1.0)["outcome"] = long
    assert [each["times"] for each in dumps._ring.values()] == [1, 10 * MAX_RECORDS]
    for number in range(MAX_RECORDS):
        dumps.requested(f"client {number}", "stop", 2.0)
        dumps.note({"time_s": 2.0, "message": long})
        dumps.note({"time_s": math.inf, "contacts": [long]})
    kept = [*dumps._ring.values()]
    assert len(kept) == MAX_RECORDS
    lines = write_dump(tmp_path, kept, cause="").read_text("utf-8").splitlines()
    assert max(map(len, lines)) <= MAX_LINE
    assert "Infinity" not in "".join(lines)


LAYOUTS = "layouts: {home: home.yaml, climate: climate.yaml}\n"
WEST, EAST = (0.08, 0.1), (0.22, 0.1)
TICK = 0.2  # s


def write_layouts(folder: Path) -> None:
    """At home the west hums and the east ticks; for the climate all of it hums low."""
    half = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
    (folder / "home.yaml").write_text(
        f"effects: {{tick: {{kind: click, duration: {TICK} s}}, hum: {{kind: buzz, level: 14}}}}\n"
        f"regions: {{west: {half % (0, 0.15, 'hum')}, east: {half % (0.15, 0.3, 'tick')}}}\n",
        "utf-8",
    )
    low = "effects: {low: {kind: buzz, level: 10}}\nelsewhere: low\n"
    (folder / "climate.yaml").write_text(low, "utf-8")


@in_virtual_time
async def test_next_finger_feels_the_chosen_layout_and_a_tick_goes_on(tmp_path: Path) -> None:
    """Within 10 ms of the reply; at a finger that rests, what ends by itself plays to its end.

    An unknown name changes nothing, nor does that of the layout in use.
    """
    write_layouts(tmp_path)
    async with ready_daemon(tmp_path, LAYOUTS) as (bench, era):
        await era.arm("me", lease_s=60)
        view = bench.daemon._publisher.view

        def felt() -> list[str | None]:
            return [each.feels for each in view.contact_statuses()]

        status = await era.status()
        assert (status.layout, status.layouts) == ("home", ["home", "climate"])
        await era.subscribe("layout")
        assert (await next_event(era, "layout")).data["name"] == "home"
        async with holding(era, EAST):
            await until(lambda: felt() == ["tick"])
            began = threads.now()
            with pytest.raises(RpcError, match="did you mean climate") as caught:
                await era.layout("climat")
            assert caught.value.code is ErrorCode.INVALID_PARAMS
            assert (await era.layout("home")).layout == "home"
            assert (await era.layout("climate")).layout == "climate"
            assert threads.now() - began < 0.01
            await until(lambda: felt() == ["low"])
            assert threads.now() - began == pytest.approx(TICK, abs=0.02)
            assert (await next_event(era, "layout")).data["name"] == "climate"
            assert (await era.status()).layout == "climate"
        await era.touch([])
        for name, effect in (("home", "hum"), ("climate", "low")):
            await until(lambda: not any(bench.far.summary().levels))
            await era.layout(name)
            replied = threads.now()
            async with holding(era, WEST):
                await until(lambda effect=effect: felt() == [effect])
                assert any(bench.far.summary().levels)
                assert threads.now() - replied < 0.01
            await era.touch([])


@pytest.mark.real_time
def test_commands_choose_a_layout_and_reload(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a daemon's process, with what they print and refuse, in its log, too.

    For a layout that is removed while it is in use the first is.
    """
    write_layouts(tmp_path)

    def era(*line: str) -> tuple[int, str]:
        status = run([*line, "--socket", str(tmp_path / "era.sock")], ["controller.cli.commands"])
        return status, "".join(capsys.readouterr())

    with real_daemon(tmp_path, LAYOUTS) as socket, Client.connect(socket) as client:
        status, said = era("layout", "use", "climate", "--json")
        assert (status, json.loads(said)["layout"]) == (0, "climate")
        status, said = era("layout", "use", "climat")
        assert status == BAD_INPUT
        assert said.count("\n") == 1
        assert "did you mean climate" in said
        assert "\n  layout climate (of home, climate)\n" in era("status")[1]
        assert era("strength", "python", "-6") == era("strength") == (0, "python: -6 dB\n")
        config, home = tmp_path / "daemon.yaml", tmp_path / "home.yaml"
        text = config.read_text("utf-8")
        home.write_text("elsewhere: null\n", "utf-8")
        for keys, elsewhere, is_done, reasons in (
            (text, "buzz", True, ["layouts.home: changed"]),
            (f"{text}mode: phased\n", "click", False, ["mode: ", "layouts.home: changed, but not"]),
            (
                text.replace(", climate: climate.yaml", ""),
                "click",
                True,
                ["layouts.home: changed", "layouts.climate: removed", "layout in use: home"],
            ),
        ):
            config.write_text(keys, "utf-8")
            home.write_text(f"elsewhere: {elsewhere}\n", "utf-8")
            status, said = era("reload", "--json")
            assert (status, json.loads(said)["reloaded"]) == (1 - is_done, is_done)
            for found, expected in zip(json.loads(said)["reasons"], reasons, strict=True):
                assert found.startswith(expected)
            assert (client.status().layout == "climate") is ("climate" in keys)
    log = [json.loads(line) for line in (tmp_path / "daemon.log").read_text("utf-8").splitlines()]
    verdicts = [each["level"] for each in log if each["message"].startswith("config: reload")]
    assert verdicts == ["info", "error", "info"]


JUMPS = (86_400.0, -86_400.0, 0.4, -0.4, 3e8, -1.7e9, 0.0)
"""How far [s] the wall clock is from the real one: days, less than a lease, decades."""


@in_virtual_time
async def test_daemon_ignores_jumps_of_wall_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a day, back, by less than a lease, by years: it plays on, and leases keep their time."""
    real = time.time
    async with ready_daemon(tmp_path) as (bench, era):
        await era.arm("test", lease_s=3)
        armed = threads.now()
        async with holding(era, far=bench.far):
            for jump in JUMPS:
                monkeypatch.setattr(time, "time", lambda jump=jump: real() + jump)
                status = await era.status()
                assert status.unix_time_s == pytest.approx(real() + jump, abs=60)
                renewed = threads.now()
                await until(lambda renewed=renewed: threads.now() > renewed + 0.3)
                assert any(bench.far.summary().levels)
            status = await era.status()
            assert not status.rejected_touches
            assert status.lease_left_s == pytest.approx(armed + 3 - threads.now(), abs=0.01)
            await until_state(era, READY)
            assert threads.now() - armed == pytest.approx(3, abs=0.1)


@pytest.mark.parametrize(
    ("number", "changes"), [(signal.SIGTERM, ()), (signal.SIGINT, TWO_AMPLIFIERS)]
)
@in_virtual_time
async def test_daemon_ramps_down_reads_back_and_disarms_when_terminated(
    tmp_path: Path, number: signal.Signals, changes: Sequence[tuple[str, str]]
) -> None:
    """While playing: zero along 50 ms, read back, high voltage off; ended within 1 s."""
    async with (
        far_end(tmp_path, changes=changes) as far,
        daemon_at(far, tmp_path, changes=changes) as bench,
        await bench.client() as era,
    ):
        journal = Journal(far)
        await until_state(era, READY)
        await era.arm("test", lease_s=60)
        async with holding(era, far=far):
            begin = threads.now()
            os.kill(os.getpid(), number)
            await until(bench.running.done)
        assert threads.now() - begin < 1
        for name in far.devices:
            requests = [entry for entry in journal.since(begin) if entry.amplifier == name]
            end = next(entry for entry in requests if entry.name == "Disarm")
            assert end.values["ramp"] == 50
            after = [entry for entry in requests if entry.time > end.time]
            assert {entry.name for entry in after} == {"GetStatus"}
            assert not any(after[-1].levels)  # read back until it is silent
            assert far.summary(name).state == "SWITCH_ON_DISABLED"


@in_virtual_time
async def test_daemon_ends_when_terminated_over_dead_link(tmp_path: Path) -> None:
    """It does not wait for a hung amplifier, which silences itself in time."""
    async with ready_daemon(tmp_path) as (bench, era):
        journal = Journal(bench.far)
        await era.arm("test", lease_s=60)
        assert await until_state(era, ENABLED)
        async with holding(era, far=bench.far):
            bench.far.device.inject_fault(FaultWindow(fault="hang"))
            begin = threads.now()
            bench.daemon.shut_down("end of the test")
            await until(bench.running.done)
        assert threads.now() - begin < 1
        await until(lambda: not energised(bench.far))
        assert silent_from(bench.far) - journal.last_fed("main") <= WATCHDOG + 0.005 + 1e-9


@in_virtual_time
async def test_daemon_notifies_systemd(tmp_path: Path) -> None:
    """READY=1, WATCHDOG=1, RELOADING=1 and STOPPING=1."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
        heard: list[str] = []

        def has_heard(text: str) -> bool:
            with contextlib.suppress(BlockingIOError):
                while True:
                    heard.append(manager.recv(4096).decode())
            return any(text in message for message in heard)

        async with ready_daemon(tmp_path, environment=environment) as (bench, _):
            for text in ("READY=1", "WATCHDOG=1", "STATUS=ready: "):
                await until(lambda text=text: has_heard(text))
            os.kill(os.getpid(), signal.SIGHUP)
            await until(lambda: has_heard("RELOADING=1\nMONOTONIC_USEC="))
            os.kill(os.getpid(), signal.SIGTERM)
            await until(bench.running.done)
            assert has_heard("STOPPING=1")


LEFT, RIGHT = (0.08, 0.1), (0.22, 0.1)
_HALF = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
_LAYOUT = f"regions: {{west: {_HALF % (0, 0.15, 'buzz')}, east: {_HALF % (0.15, 0.3, '%s')}}}\n"


async def said(era: AsyncClient) -> set[str | None]:
    """Why fingers feel nothing; the status says the same where nothing plays though it is armed."""
    status = await era.status()
    reasons = {each.held_back for each in status.contacts}
    if status.state == ENABLED:
        assert {status.silence_reason} == reasons
    return reasons


@in_virtual_time
async def test_a_daemon_goes_on_while_answers_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every reason is the present one; a stop is at once, and the end within a second."""
    layout = tmp_path / "layout.yaml"
    layout.write_text(_LAYOUT % "buzz", "utf-8")
    async with ready_daemon(tmp_path, "layouts: {panel: layout.yaml}\n") as (bench, era):
        asked = answers_take(monkeypatch, 1e6)
        async with holding(era, LEFT, RIGHT):
            await until(lambda: bench.daemon._controller.cycle.tracker.contacts)
            assert await said(era) == {"ready: arm first (era arm)"}
            await era.arm("test", lease_s=60)
            await until(lambda: asked)
            assert await said(era) == {BEING_CHOSEN}
            begin = threads.now()
            await until(lambda: threads.now() > begin + 1.1)
            assert await said(era) == {GIVEN_UP}
            begin = threads.now()
            await era.stop()
            assert threads.now() - begin < 0.05
            assert await said(era) == {"stopped: clear (era clear), then arm again"}
            layout.write_text(_LAYOUT % "click", "utf-8")
            os.kill(os.getpid(), signal.SIGHUP)
            await until(lambda: bench.daemon._layouts.player.layout.regions[1].on_press == "click")
            await era.clear()
            await until_state(era, READY)
            await era.arm("test", lease_s=60)
            assert len(asked) == 1
        await until(lambda: not bench.daemon._controller.cycle.tracker.contacts)
        await until(lambda: not any(bench.far.summary().levels))
        assert (await era.status()).silence_reason == NO_CONTACTS
        async with holding(era, LEFT, far=bench.far):  # one alone needs no thread
            assert await said(era) == {None}
        layout.write_text(_LAYOUT % "buzz", "utf-8")
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: bench.daemon._layouts.player.layout.regions[1].on_press == "buzz")
        async with holding(era, LEFT, RIGHT):
            await until(lambda: len(asked) == 2)
            begin = threads.now()
            os.kill(os.getpid(), signal.SIGTERM)
            await until(bench.running.done)
            assert threads.now() - begin < 1


PLACES = {"left": (0.03, 0.11), "right": (0.216, 0.0572)}
FADE, WINDOW, STEP = 0.100, 0.050, 0.001  # s
LOWER = 10 ** (-6 / 20)  # of -6 dB
STEEPEST = (1 - LOWER) * math.pi / 2 * STEP / FADE
"""Largest change of an envelope of 1 along the raised cosine, within a step."""
LEVEL_STEP = 1 / QUANTITIES["level"].per_unit


@cache
def phased_table() -> LocalizationTable:
    """For two contents at once, of levels that a step on the wire does not round by much."""
    frequencies, rig = np.arange(60.0, 301.0, 20.0), make_paper_rig(12, 9)
    rig = replace(rig, promised_thresholds=(rig.threshold,))
    return build_table(rig, frequencies=frequencies, drive_mode="phased")


@asynccontextmanager
async def seats(folder: Path, more: str = "") -> AsyncIterator[tuple[DaemonBench, AsyncClient]]:
    """An armed daemon with a region for each of two, whose fingers lie on its plate."""
    layout = layout_of_people(make_paper_rig(12, 9).plate, dict.fromkeys(PLACES))
    (folder / "layout.yaml").write_text(json.dumps(layout), encoding="utf-8")

    def table(rig: Rig) -> LocalizationTable:
        return phased_table()

    async with ready_daemon(folder, f"layouts: {{panel: layout.yaml}}\n{more}", table=table) as (
        bench,
        era,
    ):
        bench.far.bench.place_fingers(PLACES, now=threads.now())
        await era.arm("test", lease_s=60)
        yield bench, era


async def hold(seconds: float, *touching: tuple[AsyncClient, str, str]) -> None:
    """Let clients report a finger each for a time [s]: their sources, and where."""
    end = threads.now() + seconds
    while threads.now() < end:
        for era, source, place in touching:
            await era.touch([PLACES[place]], source=source)
        await asyncio.sleep(0.02)


def envelope(bench: DaemonBench, finger: str, frequency: float, at: FloatArray) -> FloatArray:
    """Amplitude of one tone at a fingertip [m/s²] at times [s], under a Hann window."""
    records, _ = bench.far.bench.records(at[0] - WINDOW, at[-1] + WINDOW)
    felt = records[finger]
    turned = np.exp(-2j * np.pi * frequency * felt.times) * (felt.accelerations @ felt.weights)
    weights = np.cos(np.pi * np.clip((felt.times - at[:, None]) / WINDOW, -0.5, 0.5)) ** 2
    return np.asarray(np.abs(weights @ turned) / weights.sum(axis=1))


@in_virtual_time
async def test_gain_of_a_source_is_felt_at_its_finger_alone_along_a_fade(tmp_path: Path) -> None:
    """6 dB less within 100 ms and back, monotone and as steep as a raised cosine; others as before.

    On the amplifier exactly, at the skin as the plate follows.
    """
    async with seats(tmp_path) as (bench, era):
        both = [(era, name, name) for name in PLACES]
        await hold(1.0, *both)
        tones = {each.effect: each.frequency_hz for each in (await era.status()).contacts}
        planner = bench.daemon._controller.cycle.planner
        assert planner is not None
        (sent,) = [
            n for n, one in planner.slots.contents.items() if "right" in one.content.key[0].source
        ]
        settled_at = planner.slots.contents[sent].settled_at
        for gain, first, last in ((-6.0, 1.0, LOWER), (0.0, LOWER, 1.0)):
            set_at = threads.now()
            await era.strength(name="left", gain_db=gain)
            await hold(0.02, *both)
            led = np.arange(threads.now(), set_at + 0.2, STEP)
            moving = [
                np.array([abs(tone.transition.at(time)) for time in led])
                for channel in bench.far.amplifier.outputs
                for tone in channel
                if tone.frequency == pytest.approx(tones["left"], abs=0.01)
            ]
            await hold(0.4, *both)
            at = np.arange(set_at, set_at + 0.3, STEP)
            for name, frequency in tones.items():
                found = envelope(bench, name or "", frequency or 0.0, at)
                if name == "left":
                    moving.append(found)
                    reached = found[round((FADE + WINDOW / 2 + 0.01) / STEP) :]
                    assert 20 * np.log10(reached / found[0]) == pytest.approx(gain or 6.0, abs=0.2)
                    assert 20 * np.log10(found[-1] / found[0]) == pytest.approx(gain or 6, abs=0.05)
                else:
                    assert 20 * np.log10(found / found[0]) == pytest.approx(0.0, abs=0.1)
            assert planner.slots.contents[sent].settled_at == settled_at  # not sent again
            assert len(moving) == 5
            for course in moving:
                changes = np.diff(course / course[-1] * last) * math.copysign(1, last - first)
                rounded = LEVEL_STEP / np.abs(course).min() / (1 - LOWER)
                slack = 0.1 if course is moving[-1] else 0.01 + rounded
                assert -slack * STEEPEST <= changes.min()
                assert changes.max() <= (1 + slack) * STEEPEST


@in_virtual_time
async def test_strengths_are_kept_by_name(tmp_path: Path) -> None:
    """A client's for all its sources and those of its namesakes, and for what it plays elsewhere.

    Each name counts once, also after its client and the daemon have come back; what they leave
    below the threshold is held back. What is no strength, or not a known name, is refused.
    """

    async def levels(era: AsyncClient) -> list[float]:
        await asyncio.sleep(0.4)
        return [round(each.level_db_sl or 0.0, 1) for each in (await era.status()).contacts]

    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        one, other = await bench.client("seat"), await bench.client("seat")
        held = asyncio.create_task(hold(1e3, (one, "pen", "left"), (other, "seat", "right")))
        assert await levels(era) == [20, 20]
        await era.strength(name="pen", gain_db=-3)
        await era.strength(name="seat", gain_db=-6)
        assert await levels(era) == [11, 14]
        await era.strength(name="test", gain_db=-2)
        await era.play("buzz", PLACES["right"])
        assert await levels(era) == [11, 12]
        for gain, what in ((3.0, "at most 0"), (-41.0, "at least -40"), (math.nan, "finite")):
            with pytest.raises(InputError, match=f"^strength: gain_db must be .*{what}.*, got"):
                await era.strength(name="pen", gain_db=gain)
        with pytest.raises(RpcError, match=r"^name must be .*, got 'pan'; did you mean pen\? "):
            await era.strength(name="pan", gain_db=-6)
        held.cancel()
        await asyncio.gather(one.close(), other.close())
    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        regions = dict.fromkeys(PLACES, 0.0)
        kept = {"pen": -3, "seat": -6, "test": -2}
        assert (await era.status()).strengths == {**regions, **kept}
        one, other = await bench.client("seat"), await bench.client("another")
        held = asyncio.create_task(hold(1e3, (one, "pen", "left"), (other, "finger", "right")))
        assert await levels(era) == [11, 20]
        await other.hello("seat")  # another name by now, while its finger rests
        assert await levels(era) == [11, 14]
        await other.hello("another")
        await era.strength(name="another", gain_db=0)
        await era.strength(name="pen", gain_db=-40)
        assert await levels(era) == [-26, 20]
        weak, felt = (await era.status()).contacts
        assert (weak.verdict, felt.verdict) == ("held back", "own")
        assert "-46 dB" in (weak.held_back or "")
        held.cancel()
        await asyncio.gather(one.close(), other.close())
    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        assert (await era.strength(name="another", gain_db=-1)).strengths == {"another": -1}
        await bench.client("era")
        assert (await era.status()).strengths.keys() == {"another", *PLACES, "pen", "seat", "test"}


@in_virtual_time
async def test_two_people_at_one_panel_differ_by_region(tmp_path: Path) -> None:
    """6 dB less where one of them sits, for what is felt and what is played there; kept by name.

    Gains of source and region add up.
    """

    async def levels(era: AsyncClient) -> dict[str, float]:
        await asyncio.sleep(0.4)
        places = {x: name for name, (x, _) in PLACES.items()}
        contacts = (await era.status()).contacts
        return {places[each.x_m]: round(each.level_db_sl or 0.0, 1) for each in contacts}

    async def both(panel: AsyncClient) -> None:
        while True:
            await panel.touch([*PLACES.values()], source="panel")
            await asyncio.sleep(0.02)

    kept = "strengths: kept.json\n"
    for gains, expected in (
        ({"right": -6}, {"left": 20, "right": 14}),
        ({"panel": -3}, {"left": 17, "right": 11}),  # and the region's, which was kept
    ):
        async with seats(tmp_path, kept) as (bench, era):
            panel = await bench.client("seats")
            held = asyncio.create_task(both(panel))
            await asyncio.sleep(0.1)
            for name, gain in gains.items():
                await era.strength(name, gain)
            assert await levels(era) == expected
            await era.play("buzz", PLACES["right"])
            assert await levels(era) == expected
            with pytest.raises(RpcError, match=r"got 'rigt'; did you mean right\? "):
                await era.strength("rigt", -6)
            held.cancel()
            await panel.close()
    assert json.loads((tmp_path / "kept.json").read_text()) == {"right": -6, "panel": -3}


@in_virtual_time
async def test_a_disk_that_hangs_delays_no_other_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Strengths hold and are answered; touches and disarming go on, and the newest is kept.

    One that is full is logged once.
    """
    disk, full = asyncio.Event(), [True]

    async def hangs(work: Callable[[Path], None], file: Path) -> None:
        await disk.wait()
        if full:
            raise OSError(28, "No space left on device")
        work(file)

    async with seats(tmp_path, "strengths: kept.json\n") as (_, era):
        monkeypatch.setattr(asyncio, "to_thread", hangs)
        setting = [era.strength(name="test", gain_db=-1.0 - gain) for gain in range(10)]
        await asyncio.wait_for(asyncio.gather(*setting), 0.5)
        await era.touch([PLACES["left"]])
        await era.disarm()
        disk.set()
        await asyncio.sleep(0.1)
        assert caplog.text.count("strengths: not kept: [Errno 28] No space left on device") == 1
        full.clear()
        await era.strength("test", -11.0)
    assert json.loads((tmp_path / "kept.json").read_text()) == {"test": -11.0}


@in_virtual_time
async def test_names_with_a_strength_are_bounded(tmp_path: Path) -> None:
    """A client that invents sources fills neither memory nor file: 64 names may have one."""
    async with ready_daemon(tmp_path, "strengths: kept.json\n") as (_, era):
        names = [f"{number} {'x' * 70}" for number in range(MAX_NAMES + 1)]
        for name in names:
            await era.touch([PLACES["left"]], source=name)
            await asyncio.sleep(0.01)
            if name is names[-1]:
                with pytest.raises(RpcError, match=r"^strengths must be of at most 64 names"):
                    await era.strength(name=name, gain_db=-1)
                await era.strength(name=names[0], gain_db=0)
            await era.strength(name=name, gain_db=-1)
    kept = json.loads((tmp_path / "kept.json").read_text())
    assert kept == dict.fromkeys(names[1:], -1)


@in_virtual_time
async def test_every_name_that_is_listed_can_be_set(tmp_path: Path) -> None:
    """Also that of a sender whose own name is as long as may be, and not printable."""
    async with ready_daemon(tmp_path) as (bench, era):
        sender = f"table:tuio:10.0.0.2/{chr(0x1F600) * 100!a}"
        bench.daemon._layouts.player.strengths.note(sender)
        assert (await era.strength(name=sender, gain_db=-6)).strengths == {sender: -6}
