"""Opening, arming, stopping, closing, losing, and what several amplifiers do together."""

import asyncio
import logging
from dataclasses import replace
from typing import Any

import pytest

from chain import FINGER, OTHER, Chain, set_chain, set_running
from controller.play.loop import Controller
from drivers.errors import LinkError
from drivers.host.group import GroupState
from drivers.opening import Lines
from drivers.protocol.records import Refusal, Values
from model.answer.answer_report import Timing
from model.errors import InputError
from model.rig.rig import Channel
from plates import small_problem, small_table
from set_table import BuzzNewestContact, SetTiming
from sim.far_ends.wire_assignment import Wire
from virtual_lines import in_virtual_time

ENABLED, STOPPED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"


def states(chain: Chain) -> set[str]:
    """The states of all amplifiers."""
    return {end.state for end in chain.far_ends}


@in_virtual_time
async def test_a_touch_while_arming_ends_is_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its set may be on the wire when the amplifiers are armed and what played is forgotten."""
    async with set_running() as chain:
        await chain.controller.disarm()
        arm = chain.controller.group.arm

        async def armed_late() -> None:
            await arm()
            await chain.leave(0, FINGER)

        monkeypatch.setattr(chain.controller.group, "arm", armed_late)
        await chain.controller.arm()
        await chain.hold(0.1, down=[FINGER])
        assert states(chain) == {ENABLED}
        assert chain.applied[-1].contents


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, between stage and commit too, leaves nothing vibrating."""
    async with set_running("a", "b") as chain:
        wire = chain.controller.amplifiers["b"].line.wire
        request = wire.request

        def fail(address: int, name: str, values: Values, **more: bool) -> bytes:
            if name == kind:
                raise ZeroDivisionError("a bug")
            return request(address, name, values, **more)

        wire.request = fail  # type: ignore[method-assign]
        await chain.hold(0.1, down=[FINGER])
        running, chain.running = chain.running, None
        with pytest.raises(ZeroDivisionError):
            await running  # type: ignore[misc]
        assert states(chain) == {STOPPED}
        assert chain.controller.group.state is GroupState.STOPPED


@in_virtual_time
async def test_arm_arms_all_anew_when_one_no_longer_is() -> None:
    """One that another program has disarmed plays again, in sessions of which none was held."""
    async with set_running("a", "b", breaks="state") as chain:
        held = {end.amplifier.session for end in chain.far_ends}
        chain.far_ends[0].obey("Disarm", {"ramp": 0}, asyncio.get_running_loop().time())
        await chain.controller.arm()
        assert states(chain) == {ENABLED}
        assert held.isdisjoint({end.amplifier.session for end in chain.far_ends})


@in_virtual_time
async def test_incomplete_set_is_silenced_before_the_next() -> None:
    """A lift aborts the wait for commits, and a finger comes before silence: silence goes first.

    Some amplifiers may play the aborted set and others not, which is another pattern. The heartbeat
    that is due meanwhile waits for this silence.
    """
    async with set_running("a", "b") as chain:
        await asyncio.sleep(0.02)  # the heartbeat is due 50 ms after the first
        for end in chain.far_ends:
            end.delay(0.02)
        chain.put(FINGER)
        await asyncio.sleep(0.025)  # staged after 20 ms, and the commits wait for their replies
        assert [len(end.requests("Commit")) for end in chain.far_ends] == [1, 1]
        chain.put()
        chain.put(OTHER)
        await chain.hold(0.2, down=[OTHER])
        for end in chain.far_ends:
            after_arming, *sent = [
                name for name in end.names() if name in ("Set", "Commit", "Silence")
            ]
            assert after_arming == "Silence"
            assert sent == ["Set", "Commit", "Silence", "Set", "Commit"]
            commit, silence = end.times("Commit")[0], end.times("Silence")[1]
            assert not [time for time in end.times("Ping") if commit <= time <= silence]


@in_virtual_time
async def test_no_plan_fails_while_an_amplifier_is_identified_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stop finds all closed, one by a lost line, and the other tells no capabilities any more.

    The finger that rests is planned for meanwhile, and felt once both are open again and armed.
    """
    async with set_running("a", "b") as chain:
        chain.far_ends[1].fault("unplug")
        await chain.hold(0.5)
        with pytest.raises(LinkError):
            await chain.controller.open()
        known, other = chain.far_ends

        def refuse(name: str, values: Values) -> None:
            if name == "GetCaps":
                raise Refusal("as told", "WRONG_STATE")

        known.lie(refuse)
        await chain.controller.stop_all()
        await chain.hold(0.5, down=[FINGER])
        assert not [each for each in caplog.records if "plan failed" in each.getMessage()]
        known.answer = lambda name, values: None
        other.recover()
        await chain.controller.open()
        await chain.controller.clear()
        await chain.controller.arm()
        await chain.hold(0.1)
        assert any(known.levels)


@pytest.mark.parametrize(
    ("count", "is_stopped", "logged"), [(2, False, []), (1000, True, ["ERROR"])]
)
@in_virtual_time
async def test_close_waits_for_zero_then_stops(
    caplog: pytest.LogCaptureFixture, count: int, is_stopped: bool, logged: list[str]
) -> None:
    """Delayed levels are read again; an amplifier that keeps one is stopped, which is logged."""
    left = count

    def lag(name: str, values: Values) -> Values | None:
        nonlocal left
        if name == "Disarm":
            chain.far_end.obey(name, values, asyncio.get_running_loop().time())
        if left <= 0 or "Disarm" not in chain.far_end.names() or name == "Stop":
            return None
        left -= 1
        return {**chain.far_end.status(), "levels": [3000, 0, 0]}

    caplog.set_level(logging.INFO)
    async with set_running(breaks="silent") as chain:
        chain.far_end.answer = lag
    assert bool(chain.far_end.requests("Stop")) is is_stopped
    assert not chain.far_end.is_open
    assert [record.levelname for record in caplog.records] == logged


@in_virtual_time
async def test_error_of_opening_names_the_amplifier_that_cannot_be_reached() -> None:
    """By a line that cannot be opened, or by no reply; not those that were open before."""
    async with set_chain("a", "b") as chain:
        await chain.controller.open()
        chain.far_ends[1].fault("drop", toward="amplifier")
        await chain.controller.release()
        with pytest.raises(LinkError) as mute:
            await chain.controller.open()
        chain.far_ends[1].fault("unplug")
        with pytest.raises(LinkError) as gone:
            await chain.controller.open()
    assert (mute.value.lost, gone.value.lost) == (("b",), ("b",))


@in_virtual_time
async def test_error_of_opening_names_the_amplifiers_of_a_line() -> None:
    """All that share a line which cannot be opened, as a CAN bus; not one on another line."""
    async with set_chain("a", "b", "c") as chain:
        line = chain.controller.urls["b"]
        chain.far_ends[1].fault("unplug")
        chain.controller.urls["c"] = f"{line}&address=2"
        with pytest.raises(LinkError) as gone:
            await chain.controller.open()
    assert gone.value.lost == ("b", "c")


@in_virtual_time
async def test_controller_refuses_amplifiers_that_do_not_fit_the_rig() -> None:
    """Other names, or fewer channels; nothing stays open."""
    async with set_chain() as chain:
        rig, urls = chain.far.bench.rig, chain.far.urls
        wiring = {**rig.wiring, "NE": Channel("main", 3)}
        for changed, given, problem in (
            (rig, {"other": "sim://"}, r"main.*other"),
            (replace(rig, wiring=wiring), urls, r"ERA NE .*0 to 2 on amplifier main, got 3; .*rig"),
        ):
            with pytest.raises(InputError, match=problem):
                await Controller(
                    changed,
                    chain.table,
                    lines=Lines,
                    intent_source=BuzzNewestContact(),
                    timing=SetTiming(),
                    urls=given,
                ).open()
            assert not chain.far_end.is_open


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    table, wire = small_table(), Wire("serial")
    given: dict[str, Any] = {"capabilities": {"frequency_min": 8000}, "timing": Timing(table)}
    async with Chain.on(wire, small_problem().rig, table, **given) as chain:
        with pytest.raises(InputError, match=r"60 to 250 Hz.*400-500"):
            await chain.controller.open()
        assert chain.controller.group.state is GroupState.CLOSED
        assert not chain.far_end.is_open
