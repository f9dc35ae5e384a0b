"""What a daemon plays at the fingers of its clients: layouts, strengths, effects of programs."""

import asyncio
import math
import os
import signal
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import StatusResult, TouchParams
from drivers.protocol.definition import QUANTITIES
from kit.clock import in_virtual_time
from kit.fingers import answers_take
from model.arrays import FloatArray
from model.errors import InputError
from processes.daemons import ENABLED, READY, DaemonBench, error_code, until
from registry import threads
from tests.controller.daemon.served_daemon import (
    PLACES,
    SEATS,
    ServedDaemon,
    effects_of,
    levels_of,
    require_shown,
    roles_of,
    served_daemon,
)

HALVES = """
regions:
  west: {{rectangle: {{start: [0 m, 0 m], end: [0.15 m, 0.2 m]}}, on_press: {west}}}
  east: {{rectangle: {{start: [0.15 m, 0 m], end: [0.3 m, 0.2 m]}}, on_press: {east}}}
"""
"""Regions of a layout: a plate of two halves, each with an effect."""


async def plays(client: AsyncClient, effect: str, place: str, **options: float | bool) -> None:
    """Play an effect at a place by its name."""
    await client.play(effect, PLACES[place], **options)  # type: ignore[arg-type]


async def hold_for(daemon: ServedDaemon, seconds: float) -> StatusResult:
    """Let fingers that are held rest for a time, and read the status."""
    await asyncio.sleep(seconds)
    return await daemon.era.status()


@in_virtual_time
async def test_status_has_the_reasons_of_now_and_latencies_of_touches_apart() -> None:
    """Four touches, one of them a move; three lifts and the arming count as lifts."""
    async with served_daemon() as daemon:
        await daemon.era.arm("me", lease_s=60)
        status = await hold_for(daemon, 0.1)
        assert "no contact" in status.silence_reason

        for places in (["pad"], [], ["pad"], ["beside"], [], ["pad"], []):
            await daemon.touch(*places)

        status = await daemon.era.status()
        assert (status.latency_ms.count, status.lift_latency_ms.count) == (4, 4)
        await daemon.era.disarm()
        status = await hold_for(daemon, 0.1)
        assert status.silence_reason is None
        assert daemon.bench.daemon.publisher.view.silence_event() is None


async def touch_with_radii(daemon: ServedDaemon, *radii: float | None) -> None:
    """Report touches of these radii [m], 5 cm apart."""
    touches = [
        {"id": number, "x_m": 0.05 * number, "y_m": 0.1, "radius_m": radius}
        for number, radius in enumerate(radii, start=1)
    ]
    params = TouchParams.model_validate({"source": "pad", "touches": touches})
    await daemon.era.request("touch", params)


@in_virtual_time
async def test_radius_beyond_a_finger_is_a_hand_in_the_status() -> None:
    """Of 13 mm, over the API, beside a finger of 5 mm and one without a radius."""
    async with served_daemon() as daemon:
        await touch_with_radii(daemon, 0.013, 0.005, None)
        status = await daemon.era.status()
        assert roles_of(status) == ["hand", None, None]
        require_shown(status, "m: hand: a resting hand feels no effect; lift it, and touch with a")
        await daemon.era.arm("me", lease_s=60)
        await touch_with_radii(daemon, None, 0.013, 0.005)

        with pytest.raises(RpcError, match="a resting hand feels no effect"):
            await plays(daemon.era, "buzz", "pad")


HUM_LAYOUT = "elsewhere: null\neffects: {hum: {kind: buzz, level: 14}}" + HALVES.format(
    west="hum", east="hum"
)


@in_virtual_time
async def test_fingers_beyond_those_that_may_feel_effects_are_loads_alone() -> None:
    """Of three fingers two may feel effects; the third is served once another lifts.

    Until then it has its reason, and a program's effect there is refused.
    """
    layouts = {"panel": HUM_LAYOUT}
    async with served_daemon(further_lines="max_fingers: 2\n", layouts=layouts) as daemon:
        era = daemon.era
        await era.arm("me", lease_s=60)
        daemon.hold(era, "left", "pad", "east")
        status = await hold_for(daemon, 0.3)
        assert roles_of(status) == ["target", "target", "surplus"]
        assert effects_of(status) == daemon.felt_effects == ["hum", "hum", None]
        require_shown(status, r"surplus: more fingers are on the plate than can feel .*; lift")
        with pytest.raises(RpcError, match="max_fingers"):
            await plays(era, "hum", "east")
        await plays(era, "hum", "pad")

        daemon.lift()
        daemon.hold(era, "left")
        daemon.hold(daemon.guest, "east")
        await until(lambda: daemon.felt_effects == ["hum", "hum"])

        assert roles_of(await era.status()) == ["target", "target"]
        refusal = await daemon.reload_with(("max_fingers: 2", "max_fingers: 3"))
        assert "needs a restart" in refusal


HOME_LAYOUT = (
    "effects: {tick: {kind: click, duration: 0.2 s}, hum: {kind: buzz, level: 14}}"
    + HALVES.format(west="hum", east="tick")
)
CLIMATE_LAYOUT = "effects: {low: {kind: buzz, level: 10}}\nelsewhere: low\n"


async def lift_until_silent(daemon: ServedDaemon) -> None:
    """Lift all fingers, and wait until nothing plays."""
    daemon.lift()
    await daemon.touch()
    await until(lambda: not daemon.is_loud)


@in_virtual_time
async def test_effect_of_limited_duration_goes_on_when_the_layout_changes() -> None:
    """A tick of 0.2 s at a resting finger plays to its end; the new layout follows."""
    layouts = {"home": HOME_LAYOUT, "climate": CLIMATE_LAYOUT}
    async with served_daemon(layouts=layouts) as daemon:
        era = daemon.era
        await era.arm("me", lease_s=60)
        status = await era.status()
        assert (status.layout, status.layouts) == ("home", ["home", "climate"])
        await era.subscribe("layout")
        await daemon.hear("layout", name="home")
        daemon.hold(era, "east")
        await until(lambda: daemon.felt_effects == ["tick"])
        start = threads.now()

        await era.layout("climate")

        assert threads.now() - start <= 0.01
        await until(lambda: daemon.felt_effects == ["low"])
        assert threads.now() - start == pytest.approx(0.2, abs=0.02)
        await daemon.hear("layout", name="climate")
        assert (await era.status()).layout == "climate"


@pytest.mark.parametrize(("layout", "effect"), [("home", "hum"), ("climate", "low")])
@in_virtual_time
async def test_next_finger_feels_the_chosen_layout(layout: str, effect: str) -> None:
    """Within 10 ms; an unknown name, or that of the layout in use, changes nothing."""
    layouts = {"home": HOME_LAYOUT, "climate": CLIMATE_LAYOUT}
    async with served_daemon(layouts=layouts) as daemon:
        await daemon.era.arm("me", lease_s=60)
        assert await error_code(daemon.era.layout("climat")) is ErrorCode.INVALID_PARAMS
        with pytest.raises(RpcError, match="did you mean climate"):
            await daemon.era.layout("climat")
        await daemon.era.layout(layout)
        start = threads.now()

        daemon.hold(daemon.era, "west")
        await until(lambda: daemon.is_loud and daemon.felt_effects == [effect])

        assert threads.now() - start <= 0.01


async def reload_layout(daemon: ServedDaemon, east: str) -> None:
    """Reload a layout with another effect in the east, by a signal."""
    daemon.write_layout("panel", HALVES.format(west="buzz", east=east))
    os.kill(os.getpid(), signal.SIGHUP)
    player = daemon.bench.daemon.layouts.player
    await until(lambda: player.layout.regions[1].on_press == east)


async def why_held_back(daemon: ServedDaemon) -> Sequence[str | None]:
    """Why fingers feel nothing, each reason once; while armed, a silent plate says the same."""
    status = await daemon.era.status()
    reasons = list(dict.fromkeys(contact.held_back for contact in status.contacts))
    if status.state == ENABLED:
        assert reasons == [status.silence_reason]
    return reasons


@in_virtual_time
async def test_daemon_goes_on_while_answers_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every reason is the present one; a stop is at once, and the end within a second.

    One finger needs no answer of the thread, which is asked once.
    """
    layouts = {"panel": HALVES.format(west="buzz", east="buzz")}
    async with served_daemon(layouts=layouts) as daemon:
        era = daemon.era
        questions = answers_take(monkeypatch, 1e6)
        daemon.hold(era, "west", "east")
        await asyncio.sleep(0.1)
        assert await why_held_back(daemon) == ["ready: arm first (era arm)"]

        await era.arm("test", lease_s=60)
        await asyncio.sleep(0.02)
        assert await why_held_back(daemon) == ["its vibration is being chosen; wait a moment"]
        await asyncio.sleep(1.1)
        (reason,) = await why_held_back(daemon)
        assert reason.startswith("no answer within 1 s: several fingers feel nothing until")

        stopped_from = threads.now()
        await era.stop()
        assert threads.now() - stopped_from <= 0.05
        assert await why_held_back(daemon) == ["stopped: clear (era clear), then arm again"]

        await reload_layout(daemon, "click")
        await era.clear()
        await daemon.reach(READY)
        await era.arm("test", lease_s=60)
        await lift_until_silent(daemon)
        assert (await era.status()).silence_reason == "no contact on the plate"

        daemon.hold(era, "west")
        await until(lambda: daemon.is_loud)
        assert await why_held_back(daemon) == [None]
        assert len(questions) == 1

        os.kill(os.getpid(), signal.SIGTERM)
        ended_from = threads.now()
        await until(daemon.bench.running.done)
        assert threads.now() - ended_from <= 1


@in_virtual_time
async def test_strengths_are_kept_by_name() -> None:
    """A client's name is for all its sources and namesakes, and for what it plays elsewhere.

    Each name counts once, also after its client and the daemon have come back.
    """
    async with served_daemon(has_seats=True, further_lines="strengths: kept.json\n") as daemon:
        await daemon.era.arm("test", lease_s=60)
        daemon.hold(await daemon.connect("seat"), "left", source="pen")
        daemon.hold(await daemon.connect("seat"), "right", source="seat")
        assert levels_of(await hold_for(daemon, 0.4)) == [20, 20]
        await daemon.era.strength("pen", -3)
        await daemon.era.strength("seat", -6)
        assert levels_of(await hold_for(daemon, 0.4)) == [11, 14]
        await daemon.era.strength("test", -2)
        await plays(daemon.era, "buzz", "right")
        assert levels_of(await hold_for(daemon, 0.4)) == [11, 12]

        await daemon.restart()
        await daemon.era.arm("test", lease_s=60)
        strengths = {"left": 0, "right": 0, "pen": -3, "seat": -6, "test": -2}
        assert (await daemon.era.status()).strengths == strengths
        daemon.hold(await daemon.connect("seat"), "left", source="pen")
        another = await daemon.connect("another")
        daemon.hold(another, "right", source="finger")
        assert levels_of(await hold_for(daemon, 0.4)) == [11, 20]
        await another.hello("seat")
        assert levels_of(await hold_for(daemon, 0.4)) == [11, 14]


@in_virtual_time
async def test_strength_that_leaves_a_finger_below_its_threshold_holds_it_back() -> None:
    """By 46 dB, of the client and of its source; the strength is kept over a restart."""
    async with served_daemon(has_seats=True, further_lines="strengths: kept.json\n") as daemon:
        await daemon.era.arm("test", lease_s=60)
        daemon.hold(await daemon.connect("seat"), "left", source="pen")
        daemon.hold(await daemon.connect("another"), "right", source="finger")
        await asyncio.sleep(0.4)
        await daemon.era.strength("seat", -6)
        await daemon.era.strength("pen", -40)

        status = await hold_for(daemon, 0.4)

        assert levels_of(status) == [-26, 20]
        assert [contact.verdict for contact in status.contacts] == ["held back", "own"]
        require_shown(status, "-46 dB")
        await daemon.restart()
        strengths = (await daemon.era.status()).strengths
        assert (strengths["seat"], strengths["pen"]) == (-6, -40)


REFUSED_STRENGTHS = (
    ("seat", 3.0, "^strength: gain_db must be .*at most 0.*, got"),
    ("seat", -41.0, "^strength: gain_db must be .*at least -40.*, got"),
    ("seat", math.nan, "^strength: gain_db must be .*finite.*, got"),
    ("rigt", -6.0, r"^name must be .*, got 'rigt'; did you mean right\? "),
)
"""Names, gains [dB] and messages."""


@in_virtual_time
async def test_strength_is_refused_beyond_its_range_or_for_an_unknown_name() -> None:
    """With the key and what was given."""
    async with served_daemon(has_seats=True) as daemon:
        for name, gain_db, message in REFUSED_STRENGTHS:
            with pytest.raises((RpcError, InputError), match=message):
                await daemon.era.strength(name, gain_db)


@in_virtual_time
async def test_two_people_at_one_panel_differ_by_region() -> None:
    """6 dB less where one of them sits, for what is felt and what is played there; kept by name.

    Gains of source and region add up.
    """
    async with served_daemon(has_seats=True, further_lines="strengths: kept.json\n") as daemon:
        await daemon.era.arm("test", lease_s=60)
        daemon.hold(await daemon.connect("seats"), *SEATS, source="panel")
        await asyncio.sleep(0.1)
        await daemon.era.strength("right", -6)
        assert levels_of(await hold_for(daemon, 0.4)) == [20, 14]
        await plays(daemon.era, "buzz", "right")
        assert levels_of(await hold_for(daemon, 0.4)) == [20, 14]

        await daemon.restart()
        await daemon.era.arm("test", lease_s=60)
        daemon.hold(await daemon.connect("seats"), *SEATS, source="panel")
        await asyncio.sleep(0.1)
        await daemon.era.strength("panel", -3)
        assert levels_of(await hold_for(daemon, 0.4)) == [17, 11]


EFFECTS_LAYOUT = """
effects:
  hum: {kind: buzz, level: 14}
  alert: {kind: buzz, duration: 10 s, level: 18}
regions:
  pad: {rectangle: {start: [0, 0], end: [0.15, 0.15]}, on_press: hum}
  quiet: {rectangle: {start: [0.16, 0], end: [0.3, 0.15]}}
elsewhere: null
"""
POINTS = [(0, 1, 0.5), (30, 1, 0.5)]


@in_virtual_time
async def test_daemon_plays_effects_by_region_and_by_name() -> None:
    """A region's effect plays at its own level, and nothing where a region has none.

    A request plays there at once, not with the next heartbeat.
    """
    async with served_daemon(layouts={"panel": EFFECTS_LAYOUT}) as daemon:
        era = daemon.era
        assert await error_code(plays(era, "alert", "beside")) is ErrorCode.WRONG_STATE
        await era.arm("me", lease_s=60)
        daemon.hold(era, "pad")
        await daemon.status_when(lambda status: effects_of(status) == ["hum"])
        assert levels_of(await era.status()) == [14]

        await lift_until_silent(daemon)
        daemon.hold(era, "beside")
        status = await daemon.status_when(lambda status: effects_of(status) == [None])
        assert "no effect plays there" in status.silence_reason
        assert await error_code(plays(era, "alert", "pad")) is ErrorCode.REFUSED  # no finger

        start = threads.now()
        await plays(era, "alert", "beside", level_db_sl=12)
        await until(lambda: daemon.felt_effects == ["alert"])
        assert threads.now() - start <= 0.02
        assert levels_of(await hold_for(daemon, 0.2)) == pytest.approx([12], abs=0.5)

        await era.play(POINTS, PLACES["beside"], level_db_sl=12, loop=True)
        status = await daemon.status_when(lambda status: effects_of(status) == ["points"])
        assert levels_of(status) == pytest.approx([12], abs=0.5)
        assert status.silence_reason is None


@in_virtual_time
async def test_play_returns_start_and_levels_as_the_status_reports_them() -> None:
    """Of a click over the continuous vibration that it interrupts, and of that vibration."""
    async with served_daemon(has_seats=True, layouts={"quiet": "elsewhere: null"}) as daemon:
        era = daemon.era
        async with daemon.guest.resting([PLACES[seat] for seat in SEATS]), era.armed("me"):
            hum = await era.play([(0, 1, 0.5), (5, 1, 0.5)], PLACES["left"], level_db_sl=18)
            assert hum.outcome == "played"
            assert hum.start_s == pytest.approx(threads.now(), abs=0.01)
            left, right = (await hold_for(daemon, 0.1)).contacts
            assert (hum.frequency_hz, hum.verdict) == (left.frequency_hz, left.verdict)
            assert hum.level_db_sl == left.level_db_sl
            assert hum.promised_contrast_db == left.promised_contrast_db
            assert hum.promised_level_db_sl == left.promised_level_db_sl
            (other,) = hum.other_fingers
            assert (other.source, other.id) == (right.source, right.id)
            assert other.foreign_level_db_sl == right.foreign_level_db_sl
            assert other.rig_foreign_level_db_sl == right.rig_foreign_level_db_sl

            click = await era.play("click", PLACES["left"])
            assert click.outcome == "played"
            assert click.level_db_sl == pytest.approx(24, abs=0.01)  # 6 dB above
            again = await era.play("click", PLACES["right"])
            assert (again.start_s or 0) - (click.start_s or 0) >= 0.06  # it waits for its turn


@in_virtual_time
async def test_play_returns_why_an_effect_is_late_or_held_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Held back by a strength, after a choice of 0.5 s, by a stop, and before its first click."""
    tap = [(0.5, 1.0, 0.5)]
    short, steady = [(0, 1, 0.5), (0.2, 1, 0.5)], [(0, 1, 0.5), (5, 1, 0.5)]
    async with served_daemon(has_seats=True, layouts={"quiet": "elsewhere: null"}) as daemon:
        era = daemon.era
        async with daemon.guest.resting([PLACES[seat] for seat in SEATS]):
            await era.arm("me", lease_s=60)
            waiting = await era.play([], PLACES["left"], taps=tap)
            assert (waiting.outcome, waiting.start_s) == ("pending", None)
            assert "pauses" in (waiting.reason or "")
            await asyncio.sleep(1.0)

            await era.strength("test", -40)
            weak = await era.play(steady, PLACES["left"], level_db_sl=12)
            assert (weak.outcome, weak.level_db_sl) == ("held back", None)
            assert "strength" in (weak.reason or "")
            await era.strength("test", 0)

            answers_take(monkeypatch, 0.5)
            late = await era.play(short, PLACES["right"])
            assert (late.outcome, late.start_s) == ("late", None)

            await asyncio.sleep(1.0)
            stopped = asyncio.create_task(era.play(steady, PLACES["right"]))
            await asyncio.sleep(0.1)
            await daemon.guest.stop()
            held_back = await stopped
            assert held_back.outcome == "held back"
            assert "stopped" in (held_back.reason or "")


@in_virtual_time
async def test_fingers_rest_until_the_end_of_the_block() -> None:
    """Also after lost connections; then they are lifted immediately."""
    async with served_daemon() as daemon:
        async with daemon.guest.resting([PLACES["pad"]]):
            landed = (await hold_for(daemon, 1.0)).contacts
            assert len(landed) == 1
            for connection in [*daemon.bench.daemon.server.clients]:
                connection.abort()
            landed = (await hold_for(daemon, 1.0)).contacts
            assert len(landed) == 1
        assert (await hold_for(daemon, 0.0)).contacts == []


REFUSED_EFFECTS: Sequence[tuple[Any, dict[str, Any], str]] = (
    ("unknown", {}, "unknown"),
    ("alert", {"level_db_sl": 18.1}, "level"),
    ("alert", {"level_db_sl": -20.1}, "level"),  # all would be silent
    ("alert", {"loop": True}, "loop must be left out"),
    (POINTS, {"level_db_sl": 20.1}, "^level must be from -20 to 20 dB SL, got 20.1"),
    ([(30, 1, 0.5), (0, 1, 0.5)], {}, r"time of intensity\[1\] must be 30 to 60 s, got 0 s"),
    ([(0, 1.1, 0.5)], {}, r"intensity\[0\] must be 0 to 1"),
)
"""Effects or points, options and messages."""


@in_virtual_time
async def test_effect_of_a_program_is_refused_if_it_is_unknown_invalid_or_too_strong() -> None:
    """The message says why."""
    async with served_daemon(layouts={"panel": EFFECTS_LAYOUT}) as daemon:
        await daemon.era.arm("me", lease_s=60)
        daemon.hold(daemon.era, "beside")
        await daemon.status_when(lambda status: len(status.contacts) == 1)

        for effect, options, message in REFUSED_EFFECTS:
            with pytest.raises((RpcError, InputError), match=message):
                await daemon.era.play(effect, PLACES["beside"], **options)


@in_virtual_time
async def test_daemon_ignores_jumps_of_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a day, less than a lease, or years: it plays on, and a lease of 3 s keeps its time."""
    real_time = time.time
    async with served_daemon() as daemon:
        await daemon.era.arm("test", lease_s=3)
        start = threads.now()
        daemon.hold(daemon.era, "pad")
        await until(lambda: daemon.is_loud)

        for jump in (86400, -86400, 0.4, -0.4, 3e8, -1.7e9, 0):
            with monkeypatch.context() as clock:
                clock.setattr(time, "time", lambda jump=jump: real_time() + jump)
                status = await hold_for(daemon, 0.3)
                assert status.unix_time_s == pytest.approx(time.time(), abs=60)
            assert daemon.is_loud, jump
            assert status.rejected_touches == {}

        await daemon.reach(READY)
        assert threads.now() - start == pytest.approx(3.0, abs=0.1)


FADE = 0.100
"""Duration of a fade to another strength [s]."""
WINDOW = 0.050
"""Window in which an amplitude is measured [s]."""
STEP = 0.001
"""Between two moments at which amplitudes are compared [s]."""
LOWER = 10 ** (-6 / 20)
"""The amplitude of -6 dB."""
STEEPEST = (1 - LOWER) * math.pi / 2 * STEP / FADE
"""Largest change of an envelope of 1 along the raised cosine, within a step."""
LEVEL_STEP = 1 / QUANTITIES["level"].per_unit


def felt_amplitudes(
    bench: DaemonBench, finger: str, frequency: float, times: FloatArray
) -> FloatArray:
    """Amplitude of one tone at a fingertip [m/s²] at times [s], under a Hann window."""
    records, _ = bench.far.bench.records(times[0] - WINDOW, times[-1] + WINDOW)
    felt = records[finger]
    signal_at_finger = felt.accelerations @ felt.weights
    demodulated = np.exp(-2j * np.pi * frequency * felt.times) * signal_at_finger
    offsets = (felt.times - times[:, None]) / WINDOW
    weights = np.cos(np.pi * np.clip(offsets, -0.5, 0.5)) ** 2
    return np.asarray(np.abs(weights @ demodulated) / weights.sum(axis=1))


def driven_amplitudes(bench: DaemonBench, frequency: float, times: FloatArray) -> list[FloatArray]:
    """Amplitude at times [s] of each channel's tone of a frequency."""
    courses = list[FloatArray]()
    for channel in bench.far.amplifier.outputs:
        for tone in channel:
            if tone.frequency == pytest.approx(frequency, abs=0.01):
                amplitudes = [abs(tone.transition.at(moment)) for moment in times]
                courses.append(np.array(amplitudes))
    return courses


def check_fade(course: FloatArray, ends: tuple[float, float], slack: float) -> None:
    """Require that a course goes from one end to the other, no steeper than a raised cosine."""
    start, end = ends
    direction = math.copysign(1, end - start)
    changes = np.diff(course / course[-1] * end) * direction
    assert changes.min() >= -slack * STEEPEST
    assert changes.max() <= (1 + slack) * STEEPEST


def settled_at_right_seat(bench: DaemonBench) -> float:
    """When the layer of the finger at the right seat was last sent, and has settled."""
    slots = bench.daemon.controller.cycle.planner.slots.by_layer.values()
    (slot,) = [slot for slot in slots if "right" in slot.content.key.finger.source]
    return slot.settled_at


@in_virtual_time
async def test_gain_of_a_source_is_felt_at_its_finger_alone_along_a_fade() -> None:
    """6 dB less within 100 ms and back, monotone and as steep as a raised cosine; others as before.

    On the amplifier exactly, at the skin as the plate follows.
    """
    async with served_daemon(has_seats=True) as daemon:
        bench, era = daemon.bench, daemon.era
        fingers = {seat: PLACES[seat] for seat in SEATS}
        bench.far.bench.place_fingers(fingers, now=threads.now())
        await era.arm("test", lease_s=60)
        for seat in SEATS:
            daemon.hold(era, seat, source=seat)
        status = await hold_for(daemon, 1.0)
        tones = {contact.effect: contact.frequency_hz for contact in status.contacts}
        settled_at = settled_at_right_seat(bench)

        for gain, ends in ((-6.0, (1.0, LOWER)), (0.0, (LOWER, 1.0))):
            change = gain or 6.0
            set_at = threads.now()
            await era.strength("left", gain)
            await asyncio.sleep(0.02)
            driven_times = np.arange(threads.now(), set_at + 0.2, STEP)
            driven = driven_amplitudes(bench, tones["left"], driven_times)
            await asyncio.sleep(0.4)
            times = np.arange(set_at, set_at + 0.3, STEP)
            left = felt_amplitudes(bench, "left", tones["left"], times)
            right = felt_amplitudes(bench, "right", tones["right"], times)

            assert 20 * np.log10(right / right[0]) == pytest.approx(0.0, abs=0.1)
            assert settled_at_right_seat(bench) == settled_at  # it was not sent again
            after_fade = left[round((FADE + WINDOW / 2 + 0.01) / STEP) :]
            assert 20 * np.log10(after_fade / left[0]) == pytest.approx(change, abs=0.2)
            assert 20 * np.log10(left[-1] / left[0]) == pytest.approx(change, abs=0.05)
            check_fade(left, ends, slack=0.1)
            assert len(driven) == 4
            for course in driven:
                rounding = LEVEL_STEP / course.min() / (1 - LOWER)
                check_fade(course, ends, slack=0.01 + rounding)
