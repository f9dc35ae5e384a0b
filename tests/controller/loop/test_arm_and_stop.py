"""Opening, arming, stopping, closing, losing, and what several amplifiers do together."""

import asyncio
import logging
from collections.abc import Callable

import pytest

from controller.loop.loop import Controller
from controller_bench import (
    ENABLED,
    FINGER,
    OTHER,
    STOPPED,
    BenchLines,
    FarEnd,
    make_bench,
    running,
)
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.host.members import GroupState
from drivers.protocol.records import Refusal, Values
from model.errors import InputError
from model.table.timing import Timing
from newest_contact import BuzzNewestContact
from set_table import SetTiming
from small_table import small_problem, small_table
from virtual_loop import in_virtual_time


def refusing(name: str, code: str) -> Callable[[str, Values], None]:
    """An answer that refuses requests of a name."""

    def answer(asked: str, values: Values) -> None:
        if asked == name:
            raise Refusal("as told", code)

    return answer


@in_virtual_time
async def test_lost_link_stops_the_others() -> None:
    """The loss is reported, and arming needs all to be opened again."""
    async with running("a", "b") as bench:
        await bench.hold(FINGER, seconds=0.1)

        bench.far_ends[0].line.lose("the cable was pulled")
        await asyncio.sleep(0.1)
        assert bench.controller.group.state is GroupState.LOST
        assert len(bench.far_ends[1].requests("Stop")) == 1
        (lost,) = bench.reports.lost
        assert "the cable was pulled" in lost
        with pytest.raises(CommandError, match=r"LOST.*open"):
            await bench.controller.arm()
    assert not bench.far_ends[1].is_open


@in_virtual_time
async def test_finger_of_a_silent_source_is_lifted_while_the_link_is_lost() -> None:
    """150 ms after its last frame, as with a link; not only once all are open again."""
    async with running() as bench:
        await bench.touches(FINGER, rest=0.05)
        bench.far_end.line.lose("the cable was pulled")
        await asyncio.sleep(0)
        assert bench.reports.contacts == [1]
        await asyncio.sleep(0.151)
        assert bench.reports.contacts == [1, 0]


@in_virtual_time
async def test_a_touch_while_arming_ends_is_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its set may be on the wire when the amplifiers are armed and what played is forgotten."""
    async with running() as bench:
        await bench.controller.disarm()
        arm = bench.controller.group.arm

        async def armed_late() -> None:
            await arm()
            await bench.touches(FINGER, rest=0)

        monkeypatch.setattr(bench.controller.group, "arm", armed_late)
        await bench.controller.arm()
        await bench.hold(FINGER, seconds=0.1)
        assert bench.states() == {ENABLED}
        assert bench.reports.applied[-1].contents


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, between stage and commit too, leaves nothing vibrating."""
    async with running("a", "b") as bench:
        wire = bench.far_ends[1].line.wire
        request = wire.request

        def fail(address: int, name: str, values: Values) -> bytes:
            if name == kind:
                raise ZeroDivisionError("a bug")
            return request(address, name, values)

        wire.request = fail  # type: ignore[method-assign]
        await bench.hold(FINGER, seconds=0.1)
        with pytest.raises(ZeroDivisionError):
            await bench.ended()
        assert bench.states() == {STOPPED}
        assert bench.controller.group.state is GroupState.STOPPED


@in_virtual_time
async def test_stop_is_latched_until_clear() -> None:
    """Arming is refused before, even if the amplifier restarts; touches are felt after it."""
    async with running() as bench:
        await bench.controller.stop()
        with pytest.raises(CommandRefused):
            await bench.controller.arm()
        bench.far_end.amplifier.restart(asyncio.get_running_loop().time())
        assert bench.far_end.state not in (STOPPED, ENABLED)
        with pytest.raises(CommandRefused):
            await bench.controller.arm()
        assert bench.controller.group.state is GroupState.STOPPED
        await bench.controller.clear()
        await bench.controller.arm()
        await bench.touches(FINGER, rest=0.01)
        assert not bench.far_end.sets()[-1].is_silent


@pytest.mark.parametrize("order", ["stop", "disarm"])
@in_virtual_time
async def test_arm_is_refused_while_silencing(order: str) -> None:
    """Nothing is sent, because the order of arrival would decide; afterwards arming works."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    for far_end in bench.far_ends:
        far_end.delay = 0.02
    silencing = asyncio.create_task(getattr(bench.controller, order)())
    await asyncio.sleep(0)
    with pytest.raises(CommandRefused, match="arm again"):
        await bench.controller.arm()
    await silencing
    assert not bench.controller.group.is_armed
    assert [far_end.requests("Arm") for far_end in bench.far_ends] == [[], []]
    await bench.controller.clear()
    await bench.controller.arm()
    assert bench.controller.group.state is GroupState.ARMED
    await bench.controller.close()


@in_virtual_time
async def test_arm_arms_all_anew_when_one_no_longer_is() -> None:
    """One that another program has disarmed plays again, in a session that all have."""
    async with running("a", "b") as bench:
        held = {end.amplifier.session for end in bench.far_ends}
        bench.far_ends[0].obey("Disarm", {"ramp": 0}, asyncio.get_running_loop().time())
        await bench.controller.arm()
        assert bench.states() == {ENABLED}
        (session,) = {end.amplifier.session for end in bench.far_ends}
        assert session not in held


@in_virtual_time
async def test_failed_disarm_stops_all() -> None:
    """The error is raised after that."""
    async with running("a", "b") as bench:
        bench.far_ends[1].answer = refusing("Disarm", "BUSY")
        with pytest.raises(CommandRefused, match="BUSY"):
            await bench.controller.disarm()
        assert bench.states() == {STOPPED}


@in_virtual_time
async def test_stop_completes_when_its_caller_is_cancelled_twice() -> None:
    """While the amplifiers do not hear; they hear again after the second."""
    async with running("a", "b") as bench:
        for far_end in bench.far_ends:
            far_end.is_deaf = True
        stopping = asyncio.create_task(bench.controller.stop())
        for _ in range(2):
            await asyncio.sleep(0.005)
            stopping.cancel()
        for far_end in bench.far_ends:
            far_end.is_deaf = False
        with pytest.raises(asyncio.CancelledError):
            await stopping
        assert bench.states() == {STOPPED}


@in_virtual_time
async def test_incomplete_set_is_silenced_before_the_next() -> None:
    """A lift aborts the wait for commits, and a finger comes before silence: silence goes first.

    Some amplifiers may play the aborted set and others not, which is another pattern. The heartbeat
    that is due meanwhile waits for this silence.
    """
    async with running("a", "b") as bench:
        await asyncio.sleep(0.02)  # the heartbeat is due 50 ms after the first
        for far_end in bench.far_ends:
            far_end.delay = 0.02
        bench.touch(FINGER)
        await asyncio.sleep(0.025)  # staged after 20 ms, and the commits wait for their replies
        assert [len(far_end.requests("Commit")) for far_end in bench.far_ends] == [1, 1]
        bench.touch()
        bench.touch(OTHER)
        await bench.hold(OTHER, seconds=0.2)
        for far_end in bench.far_ends:
            after_arming, *sent = [
                name for name in far_end.names() if name in ("Set", "Commit", "Silence")
            ]
            assert after_arming == "Silence"
            assert sent == ["Set", "Commit", "Silence", "Set", "Commit"]
            commit, silence = far_end.times("Commit")[0], far_end.times("Silence")[1]
            assert not [time for time in far_end.times("Ping") if commit <= time <= silence]


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
            bench.far_end.obey(name, values, asyncio.get_running_loop().time())
        if left <= 0 or "Disarm" not in bench.far_end.names() or name == "Stop":
            return None
        left -= 1
        return {**bench.far_end.status(), "levels": [3000, 0]}

    caplog.set_level(logging.INFO)
    async with running() as bench:
        bench.far_end.answer = lag
    assert bool(bench.far_end.requests("Stop")) is is_stopped
    assert not bench.far_end.is_open
    assert [record.levelname for record in caplog.records] == logged


@in_virtual_time
async def test_error_of_opening_names_the_amplifier_that_cannot_be_reached() -> None:
    """By a line that cannot be opened, or by no reply; not those that were open before."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    bench.far_ends[1].is_deaf = True
    await bench.controller.release()
    with pytest.raises(LinkError) as mute:
        await bench.controller.open()

    def refuse() -> None:
        raise LinkError("no such device")

    bench.far_ends[1].connect = refuse  # type: ignore[method-assign, assignment]
    with pytest.raises(LinkError) as gone:
        await bench.controller.open()
    assert (mute.value.lost, gone.value.lost) == (("b",), ("b",))


@in_virtual_time
async def test_controller_refuses_amplifiers_that_do_not_fit_the_rig() -> None:
    """Other names, or fewer channels; nothing stays open."""
    bench = make_bench(channels=1)
    with pytest.raises(InputError, match=r"main.*other"):
        Controller(
            bench.rig,
            bench.table,
            lines=lambda: BenchLines({}),
            intent_source=BuzzNewestContact(),
            timing=SetTiming(),
            urls={"other": "fake://"},
        )
    with pytest.raises(InputError, match=r"ERA NE .*0 to 0 on amplifier main, got 1; .*rig file"):
        await bench.controller.open()
    assert not bench.far_end.is_open


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    link = FarEnd(channels=4)
    link.amplifier.capabilities["frequency_min"] = 8000  # 400 Hz
    link.amplifier.capabilities["frequency_max"] = 20_000
    table = small_table()
    controller = Controller(
        small_problem().rig,
        table,
        lines=lambda: BenchLines({"main": link}),
        intent_source=BuzzNewestContact(),
        timing=Timing(table),
    )
    with pytest.raises(InputError, match=r"400 to 500 Hz.*60 to 250 Hz"):
        await controller.open()
    assert controller.group.state is GroupState.CLOSED
    assert not link.is_open


@in_virtual_time
async def test_mute_amplifier_is_lost_though_the_finger_was_lifted() -> None:
    """Silence that it does not hear, repeated, does not put off when it must have fallen silent."""
    async with running("a", "b") as bench:
        await bench.hold(FINGER, seconds=0.2)
        bench.far_ends[1].is_deaf = True
        await bench.touches(rest=0.6)
        assert bench.reports.lost
        assert bench.controller.group.state is GroupState.LOST
        assert not any(bench.far_ends[0].levels())


@pytest.mark.parametrize("is_armed", [False, True])
@pytest.mark.parametrize("silencing", ["disarm", "stop", "close"])
@in_virtual_time
async def test_silencing_wins_over_arming(silencing: str, is_armed: bool) -> None:
    """Arming that is under way is refused; what was armed before is not armed anew."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    if is_armed:
        await bench.controller.arm()
    for far_end in bench.far_ends:
        far_end.delay = 0.005
    arming = asyncio.create_task(bench.controller.arm())
    await asyncio.sleep(0.001)
    await getattr(bench.controller, silencing)()
    with pytest.raises(CommandRefused, match="arm again"):
        await arming
    left = {"disarm": GroupState.DISARMED, "stop": GroupState.STOPPED, "close": GroupState.CLOSED}
    assert bench.controller.group.state is left[silencing]
    if silencing != "close":
        assert ENABLED not in bench.states()
