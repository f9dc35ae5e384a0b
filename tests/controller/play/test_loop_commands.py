"""The control loop arms, disarms, stops, opens and loses amplifiers, in virtual time."""

import asyncio
import logging
from dataclasses import replace
from typing import Any

import pytest

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.reports import PlayReport
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.host.group_states import GroupState
from drivers.opening import Lines
from drivers.protocol.records import Values
from kit.chain import FINGER, OTHER, Chain, set_chain, set_running
from kit.clock import in_virtual_time
from kit.plates import small_problem, small_table
from kit.set_table import SetTiming
from model.answer.answer_report import Timing
from model.errors import InputError
from model.rig.rig import Channel
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from tests.controller.play.driven_loop import DrivenLoop, refuse

REJECTED = (CommandError, CommandRefused)
COMMANDS = {
    "disarm": GroupState.DISARMED,
    "stop": GroupState.STOPPED,
    "close": GroupState.CLOSED,
}
"""Commands that end vibration, and the state to which they lead."""


@in_virtual_time
async def test_lost_link_stops_the_other_amplifier() -> None:
    """The loss is reported, and arming requires that all links are opened again."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await loop.hold(0.1, down=[FINGER])

        loop.far_ends[0].fault("unplug")
        await asyncio.sleep(0.1)

        assert loop.state is GroupState.LOST
        assert loop.count("Stop", of=1) >= 1
        assert len(loop.lost) == 1
        with pytest.raises(REJECTED, match=r"LOST.*open"):
            await loop.controller.arm()


@in_virtual_time
async def test_stop_is_latched_until_clear() -> None:
    """Arming is rejected until then, even if the amplifier restarts; touches are felt after it."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.controller.stop()
        with pytest.raises(REJECTED):
            await loop.controller.arm()

        loop.far_end.fault("reboot", lasts=0.1)
        await asyncio.sleep(0.2)
        assert loop.amplifier_states == ["SWITCH_ON_DISABLED"]
        with pytest.raises(REJECTED):
            await loop.controller.arm()
        assert loop.state is GroupState.STOPPED

        await loop.controller.clear()
        await loop.controller.arm()
        await loop.leave(0.03, FINGER)
        assert loop.is_loud


@pytest.mark.parametrize("command", ["stop", "disarm"])
@in_virtual_time
async def test_arm_is_refused_during_a_stop_or_disarm(command: str) -> None:
    """Nothing is sent, because the order of arrival would decide; afterwards arming works."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await loop.controller.disarm()
        loop.forget_requests()
        loop.delay_replies(0.02)

        ending = asyncio.create_task(getattr(loop.controller, command)())
        await asyncio.sleep(0)
        with pytest.raises(REJECTED, match="arm again"):
            await loop.controller.arm()
        await ending

        assert loop.state is COMMANDS[command]
        arm_counts = [loop.count("Arm", of=0), loop.count("Arm", of=1)]
        assert arm_counts == [0, 0]
        await loop.controller.clear()
        await loop.controller.arm()
        assert loop.state is GroupState.ARMED


@pytest.mark.parametrize("is_armed_already", [False, True])
@pytest.mark.parametrize("command", COMMANDS)
@in_virtual_time
async def test_arm_loses_against_any_command_that_ends_vibration(
    command: str, is_armed_already: bool
) -> None:
    """Arming that is in progress is rejected, and no amplifier stays armed."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await asyncio.sleep(0.03)
        if not is_armed_already:
            await loop.controller.disarm()
        loop.delay_replies(0.005)

        arming = asyncio.create_task(loop.controller.arm())
        await asyncio.sleep(0.001)
        await getattr(loop.controller, command)()

        with pytest.raises(REJECTED, match="arm again"):
            await arming
        assert loop.state is COMMANDS[command]
        assert "OPERATION_ENABLED" not in loop.amplifier_states


@in_virtual_time
async def test_disarm_that_an_amplifier_refuses_stops_all() -> None:
    """The error is raised after the stop."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        refuse(loop.far_ends[1], "Disarm")
        with pytest.raises(REJECTED, match="WRONG_STATE"):
            await loop.controller.disarm()
        assert loop.amplifier_states == ["QUICK_STOP_ACTIVE"] * 2


@in_virtual_time
async def test_stop_completes_when_its_caller_is_cancelled_twice() -> None:
    """The amplifiers do not hear at first; they hear again after the second cancellation."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        for far_end in loop.far_ends:
            far_end.fault("drop", toward="amplifier")
        stopping = asyncio.create_task(loop.controller.stop())
        for _ in range(2):
            await asyncio.sleep(0.005)
            stopping.cancel()

        for far_end in loop.far_ends:
            far_end.recover()
        await asyncio.gather(stopping, return_exceptions=True)

        assert loop.amplifier_states == ["QUICK_STOP_ACTIVE"] * 2


@in_virtual_time
async def test_arm_changes_nothing_while_armed() -> None:
    """No second Arm is sent, because it would begin another session; heartbeats continue."""
    async with set_running(of=DrivenLoop) as loop:
        loop.forget_requests()
        await asyncio.gather(loop.controller.arm(), loop.controller.arm())
        await asyncio.sleep(0.125)

        assert loop.count("Arm") == 0
        assert loop.count("Ping") >= 1
        assert loop.state is GroupState.ARMED


@in_virtual_time
async def test_touch_as_arming_ends_is_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its set may be on the wire when the amplifiers are armed and active layers are forgotten."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.controller.disarm()
        arm = loop.controller.group.arm

        async def arm_and_touch() -> None:
            await arm()
            loop.put(FINGER)

        monkeypatch.setattr(loop.controller.group, "arm", arm_and_touch)
        await loop.controller.arm()
        await loop.hold(0.1, down=[FINGER])

        assert loop.amplifier_states == ["OPERATION_ENABLED"]
        assert loop.is_loud


@pytest.mark.parametrize("fault", [{"kind": "drop", "toward": "amplifier"}, {"kind": "unplug"}])
@in_virtual_time
async def test_open_names_the_amplifier_that_cannot_be_reached(fault: dict[str, Any]) -> None:
    """It does not reply, or its line cannot be opened; the other amplifier is not named."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await loop.controller.disarm()
        await loop.controller.release()
        loop.far_ends[1].fault(**fault)
        with pytest.raises(LinkError) as caught:
            await loop.controller.open()
        assert [*caught.value.lost] == ["b"]


@in_virtual_time
async def test_no_plan_fails_while_an_amplifier_is_identified_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A resting finger is planned for when no amplifier is open, and felt once both are armed.

    One has a lost line; the other was closed and does not report its capabilities.
    """
    async with set_running("a", "b", of=DrivenLoop) as loop:
        lost, closed = loop.far_ends
        lost.fault("unplug")
        await loop.hold(0.5)
        with pytest.raises(LinkError):
            await loop.controller.open()
        refuse(closed, "GetCaps")
        await loop.controller.stop_all()
        await loop.hold(0.5, down=[FINGER])
        assert "plan failed" not in caplog.text

        lost.recover()
        closed.answer = lambda name, values: None
        await loop.controller.open()
        await loop.controller.clear()
        await loop.controller.arm()
        await loop.hold(0.1)
        assert loop.is_loud


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, also between stage and commit, leaves nothing vibrating."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        wire = loop.controller.amplifiers["b"].line.wire
        request = wire.request

        def fail(address: int, name: str, values: Values, **options: bool) -> bytes:
            if name == kind:
                raise ZeroDivisionError("a bug")
            return request(address, name, values, **options)

        wire.request = fail  # type: ignore[method-assign]
        await loop.hold(0.1, down=[FINGER])
        running, loop.running = loop.running, None
        assert running is not None
        with pytest.raises(ZeroDivisionError):
            await running

        assert loop.amplifier_states == ["QUICK_STOP_ACTIVE"] * 2
        assert loop.state is GroupState.STOPPED


@pytest.mark.parametrize(
    ("late_replies", "stop_count", "log_levels"), [(2, 0, []), (1000, 1, ["ERROR"])]
)
@in_virtual_time
async def test_close_waits_for_zero_then_stops(
    caplog: pytest.LogCaptureFixture, late_replies: int, stop_count: int, log_levels: list[str]
) -> None:
    """Levels are read again; an amplifier that keeps a level is stopped, which is logged."""
    replies_left = late_replies

    def report_a_level(name: str, values: Values) -> Values | None:
        nonlocal replies_left
        if name == "Disarm":
            loop.far_end.obey(name, values, threads.now())
        is_disarming = "Disarm" in loop.far_end.names()
        if replies_left <= 0 or not is_disarming or name == "Stop":
            return None
        replies_left -= 1
        return {**loop.far_end.status(), "levels": [3000, 0, 0]}

    caplog.set_level(logging.INFO)
    async with set_running(of=DrivenLoop) as loop:
        loop.far_end.answer = report_a_level

    assert min(loop.count("Stop"), 1) == stop_count
    assert not loop.far_end.is_open
    assert [record.levelname for record in caplog.records] == log_levels


@in_virtual_time
async def test_open_rejects_amplifiers_that_do_not_fit_the_rig() -> None:
    """Other names, or fewer channels than the rig wires; nothing stays open."""
    async with set_chain() as chain:
        rig = chain.far.bench.rig
        wiring = {**rig.wiring, "NE": Channel("main", 3)}
        cases = [
            (rig, {"other": "sim://"}, r"main.*other"),
            (replace(rig, wiring=wiring), chain.far.urls, "ERA NE .*0 to 2 on amplifier main"),
        ]
        for case_rig, urls, problem in cases:
            with pytest.raises(InputError, match=problem):
                await Controller(
                    case_rig,
                    chain.table,
                    lines=Lines,
                    intent_source=EffectPlayer(SurfaceLayout()),
                    timing=SetTiming(),
                    urls=urls,
                ).open()
            assert not chain.far_end.is_open


@in_virtual_time
async def test_open_rejects_a_table_without_playable_frequencies() -> None:
    """The error names the bands of amplifier and table; nothing stays open."""
    table = small_table()
    wire = SimulatedWire("serial")
    options: dict[str, Any] = {"capabilities": {"frequency_min": 8000}, "timing": Timing(table)}
    async with Chain.on(wire, small_problem().rig, table, **options) as chain:
        with pytest.raises(InputError, match=r"60 to 250 Hz.*400-500"):
            await chain.controller.open()
        assert chain.controller.group.state is GroupState.CLOSED
        assert not chain.far_end.is_open


@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat() -> None:
    """It comes when the set is reported as active, by replies as late as the heartbeat is due."""
    counts_before_lift: list[int] = []  # requests to each amplifier

    def lift(report: PlayReport) -> None:
        if report.contents:
            counts_before_lift.extend(len(far_end.asked) for far_end in chain.far_ends)
            chain.put()

    async with set_running("a", "b", observe=lambda loop: loop.reported.append(lift)) as chain:
        await asyncio.sleep(0.046)
        for far_end in chain.far_ends:
            far_end.delay(0.002)
        await chain.leave(0.05, FINGER)
        for far_end, count in zip(chain.far_ends, counts_before_lift, strict=True):
            assert far_end.names(count)[:2] == ["Silence", "Ping"]


@in_virtual_time
async def test_incomplete_set_is_silenced_before_the_next() -> None:
    """A lift aborts the wait for commits, and a finger comes before silence: silence goes first.

    Some amplifiers may play the aborted set and others not, which is another pattern. The heartbeat
    that is due meanwhile, 50 ms after the first, waits for this silence.
    """
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await asyncio.sleep(0.02)
        loop.forget_requests()
        loop.delay_replies(0.02)
        await loop.leave(0.025, FINGER)  # staged after 20 ms; commits wait for their replies
        commit_counts = [loop.count("Commit", of=0), loop.count("Commit", of=1)]
        assert commit_counts == [1, 1]

        loop.put()
        loop.put(OTHER)
        await loop.hold(0.2, down=[OTHER])

        for far_end in loop.far_ends:
            requests = [name for name in far_end.names() if name not in ("Ping", "GetStatus")]
            assert requests == ["Set", "Commit", "Silence", "Set", "Commit"], far_end.name
            commit, silence = far_end.times("Commit")[0], far_end.times("Silence")[0]
            early_pings = [time for time in far_end.times("Ping") if commit <= time <= silence]
            assert early_pings == [], far_end.name
