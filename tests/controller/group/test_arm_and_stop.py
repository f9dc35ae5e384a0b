"""Arming, stopping, closing, and what several amplifiers must do together."""

import asyncio

import pytest

from controller.group.amplifier_group import Phase
from controller.loop.loop import Controller
from controller_bench import FINGER, OTHER, make_bench, running
from drivers.amplifier import Amplifier
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Commit,
    Disarm,
    Fault,
    GetStatus,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from model.errors import InputError
from model.vibration.excitation import Tone
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_controller_starts_disarmed() -> None:
    """Until armed, contacts are followed and nothing is sent; then fingers already there feel."""
    bench = make_bench()
    with pytest.raises(CommandError):
        await bench.controller.arm()
    await bench.controller.open()
    assert bench.controller.phase is Phase.DISARMED
    task = asyncio.create_task(bench.controller.run())
    await bench.hold(FINGER, seconds=0.3)
    assert bench.reports.contacts == [1]
    assert bench.far_end.requests(Apply, Ping, Arm) == []
    await bench.controller.arm()
    await bench.hold(FINGER, seconds=0.1)
    assert [each.is_silent for each in bench.far_end.sets()] == [False]
    await bench.controller.disarm()
    await bench.hold(OTHER, seconds=0.3)
    assert len(bench.far_end.sets()) == 1
    assert isinstance(bench.far_end.asked[-1][1], Disarm)
    await bench.controller.close()
    await task


@in_virtual_time
async def test_lost_link_stops_the_others_and_ends_the_loop() -> None:
    """A link that breaks stops the other amplifier, is told, and ends the loop with the error."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    await bench.hold(FINGER, seconds=0.1)

    def break_off(request: Request) -> Reply | None:
        raise LinkError("the cable was pulled")

    bench.far_ends[0].answer = break_off
    await asyncio.sleep(0.1)
    assert bench.controller.phase is Phase.LOST
    assert len(bench.far_ends[1].requests(Stop)) == 1
    assert len(bench.reports.lost) == 1
    assert "the cable was pulled" in bench.reports.lost[0]
    with pytest.raises(LinkError, match="the cable was pulled"):
        await task
    with pytest.raises(CommandError, match=r"LOST.*open"):
        await bench.controller.arm()
    await bench.controller.close()
    assert not bench.far_ends[1].is_open


@in_virtual_time
async def test_amplifiers_stage_before_any_commits() -> None:
    """Several amplifiers stage under one token, all before any commits, and are read back."""
    async with running("a", "b") as bench:
        bench.far_ends[0].delay = 0.004
        before = len(bench.far_ends[1].asked)
        bench.touch(FINGER)
        await asyncio.sleep(0.03)
        first, second = bench.far_ends
        kinds = [type(request) for _, request in second.asked[before:]]
        assert kinds == [Stage, Commit, GetStatus]
        assert second.times(Commit)[-1] >= first.times(Stage)[-1] + 0.004
        tokens = {
            request.command_set.token
            for far_end in bench.far_ends
            for request in [far_end.requests(Stage)[-1]]
            if isinstance(request, Stage)
        }
        assert tokens == {first.token} == {second.token}
        assert bench.reports.applied[-1].drive.keys() == {"SW"}


@pytest.mark.parametrize(
    ("kind", "reply"),
    [
        (Stage, Nak(NakCode.BAD_VALUE, 1)),
        (Commit, Nak(NakCode.BAD_TOKEN)),
        (
            GetStatus,
            Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 9999, True, 25.0, 0.2, (0.0, 0.0)),
        ),
        (Ping, Status(AmplifierState.FAULT, Fault.ARC, 1, False, 25.0, 0.0, (0.0, 0.0))),
    ],
)
@in_virtual_time
async def test_failure_of_one_stops_all(kind: type[Request], reply: Reply) -> None:
    """Whatever one amplifier does not do, all are stopped, disarmed and stay so; it is told."""
    async with running("a", "b") as bench:
        bench.far_ends[1].answer = lambda request: reply if isinstance(request, kind) else None
        await bench.hold(FINGER, seconds=0.2)
        assert [len(far_end.requests(Stop)) for far_end in bench.far_ends] == [1, 1]
        assert bench.controller.phase is Phase.DISARMED
        assert len(bench.reports.refused) == 1
        assert bench.reports.applied == [] or kind is Ping
        asked = len(bench.far_ends[0].asked)
        await bench.hold(FINGER, OTHER, seconds=0.2)
        assert len(bench.far_ends[0].asked) == asked


@in_virtual_time
async def test_refusal_of_one_guard_silences_all() -> None:
    """What one amplifier's guard refuses, none plays: both are told to be silent."""
    async with running("a", "b") as bench:
        await bench.hold(FINGER, seconds=0.1)
        bench.table.excitation = {"SW": Tone(110.0, 20e-6), "NE": Tone(110.0, 101e-6)}
        await bench.hold(FINGER, OTHER, seconds=0.1)
        for far_end in bench.far_ends:
            assert len(far_end.requests(Stage)) == 1
            assert [each.is_silent for each in far_end.sets()] == [True, True]
        assert bench.reports.refused[0].startswith("b: level of channel 1")
        assert bench.controller.phase is Phase.ARMED


@in_virtual_time
async def test_stop_is_latched_until_clear() -> None:
    """After a stop nothing arms before it was acknowledged, and touches are not felt."""
    async with running() as bench:
        await bench.controller.stop()
        with pytest.raises(CommandRefused, match="stopped"):
            await bench.controller.arm()
        assert bench.controller.phase is Phase.DISARMED
        await bench.controller.clear()
        await bench.controller.arm()
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        assert not bench.far_end.sets()[-1].is_silent


@in_virtual_time
async def test_stop_prevents_the_commit_of_a_staged_set() -> None:
    """A set that was staged when the stop came is never committed, and no error is made of it."""
    async with running("a", "b") as bench:
        bench.far_ends[0].delay = 0.01
        commits = len(bench.far_ends[1].requests(Commit))
        bench.touch(FINGER)
        await asyncio.sleep(0.005)
        await bench.controller.stop()
        await asyncio.sleep(0.1)
        assert len(bench.far_ends[1].requests(Commit)) == commits
        assert bench.reports.refused == []


@pytest.mark.parametrize("silencing", ["disarm", "stop", "close"])
@in_virtual_time
async def test_silencing_wins_over_arming(silencing: str) -> None:
    """Whoever silences while another arms is the one who wins, and the other is told."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    for far_end in bench.far_ends:
        far_end.delay = 0.005
    arming = asyncio.create_task(bench.controller.arm())
    await asyncio.sleep(0.001)
    await getattr(bench.controller, silencing)()
    with pytest.raises(CommandRefused, match="arm again"):
        await arming
    assert bench.controller.phase is (Phase.CLOSED if silencing == "close" else Phase.DISARMED)
    if silencing != "close":
        states = {far_end.state for far_end in bench.far_ends}
        assert AmplifierState.OPERATION_ENABLED not in states


@in_virtual_time
async def test_arm_disarms_all_when_one_refuses() -> None:
    """Amplifiers that were armed and cannot be armed anew are disarmed, and nothing is played."""
    async with running("a", "b") as bench:
        bench.far_ends[0].state = AmplifierState.SWITCH_ON_DISABLED  # the other one refuses
        with pytest.raises(CommandRefused):
            await bench.controller.arm()
        assert bench.controller.phase is Phase.DISARMED
        assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.SWITCH_ON_DISABLED}


@in_virtual_time
async def test_failed_disarm_stops_all() -> None:
    """If one amplifier does not disarm, all are stopped, and the error is raised."""
    async with running("a", "b") as bench:
        bench.far_ends[1].answer = lambda request: (
            Nak(NakCode.BUSY) if isinstance(request, Disarm) else None
        )
        with pytest.raises(CommandRefused, match="busy"):
            await bench.controller.disarm()
        assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.QUICK_STOP_ACTIVE}


@in_virtual_time
async def test_stop_completes_when_the_loop_is_cancelled() -> None:
    """A loop that is cancelled while it stops the amplifiers ends when they are stopped."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.001)
    for far_end in bench.far_ends:
        far_end.delay = 0.01
    bench.far_ends[0].answer = lambda request: (
        Nak(NakCode.WRONG_STATE) if isinstance(request, Ping) else None
    )
    await asyncio.sleep(0.065)  # the next heartbeat goes out after 50 ms
    assert [len(far_end.requests(Stop)) for far_end in bench.far_ends] == [1, 1]
    assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.OPERATION_ENABLED}
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.QUICK_STOP_ACTIVE}
    await bench.controller.close()


@in_virtual_time
async def test_contacts_are_followed_while_amplifiers_are_stopped() -> None:
    """A stop that is under way takes its time, and the touches that come meanwhile are followed."""
    bench = make_bench()
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    bench.touch(FINGER)
    await asyncio.sleep(0.001)
    bench.far_end.answer = lambda request: (
        Nak(NakCode.BAD_VALUE) if isinstance(request, Apply) else None
    )
    bench.far_end.delay = 0.02
    bench.touch((1, 0.7, 0.5))
    await asyncio.sleep(0.03)
    assert len(bench.far_end.requests(Stop)) == 1
    bench.touch()
    await asyncio.sleep(0.03)
    assert bench.far_end.state is AmplifierState.QUICK_STOP_ACTIVE
    assert bench.reports.contacts == [1, 1, 0]
    assert len(bench.reports.refused) == 1
    await bench.controller.close()
    await task


@pytest.mark.parametrize("kind", [Stage, Commit, GetStatus, Ping])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: type[Request]) -> None:
    """An exception that nobody foresaw, between stage and commit too, leaves nothing vibrating."""
    bench = make_bench("a", "b")
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.01)

    def fail(request: Request) -> Reply | None:
        if isinstance(request, kind):
            raise ZeroDivisionError("a bug")
        return None

    bench.far_ends[1].answer = fail
    await bench.hold(FINGER, seconds=0.1)
    with pytest.raises(ZeroDivisionError):
        await task
    assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.QUICK_STOP_ACTIVE}
    assert bench.controller.phase is Phase.DISARMED
    await bench.controller.close()


@in_virtual_time
async def test_close_ramps_reads_back_and_disarms() -> None:
    """Closing ramps to zero in 50 ms, reads zero back, disarms, closes and ends the loop."""
    bench = make_bench()
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    bench.touch(FINGER)
    await asyncio.sleep(0.01)
    before = len(bench.far_end.asked)
    start = asyncio.get_running_loop().time()
    await bench.controller.close()
    await task
    (zero_at, zero), (read_at, _), _ = bench.far_end.asked[before:]
    assert isinstance(zero, Apply)
    assert zero.command_set.is_silent
    assert zero.command_set.ramp == 0.05
    assert zero_at == start
    assert read_at >= start + 0.05
    assert [type(request) for _, request in bench.far_end.asked[before:]] == [
        Apply,
        GetStatus,
        Disarm,
    ]
    assert not bench.far_end.is_open
    await bench.controller.close()


@in_virtual_time
async def test_second_close_waits_for_the_first(caplog: pytest.LogCaptureFixture) -> None:
    """Who closes while another still reads zero back waits for that, and all ends in order."""
    async with running() as bench:
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        asked = len(bench.far_end.asked)
        await asyncio.gather(bench.controller.close(), bench.controller.close())
        kinds = [type(request) for _, request in bench.far_end.asked[asked:]]
        assert kinds == [Apply, GetStatus, Disarm]
        assert not bench.far_end.is_open
    assert caplog.text == ""


@in_virtual_time
async def test_close_stops_when_a_level_remains(caplog: pytest.LogCaptureFixture) -> None:
    """An amplifier that goes on reporting a level is stopped, and that is logged."""
    async with running() as bench:
        bench.far_end.answer = lambda request: (
            Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 1, True, 25.0, 0.2, (0.3, 0.0))
            if isinstance(request, GetStatus)
            else None
        )
    assert isinstance(bench.far_end.asked[-1][1], Stop)
    assert not bench.far_end.is_open
    assert [record.levelname for record in caplog.records] == ["ERROR"]


@in_virtual_time
async def test_close_waits_for_a_delayed_zero(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """One whose levels are two looks old is looked at a third time, and all ends in order."""
    old = [0.3, 0.1]

    def lag(request: Request) -> Reply | None:
        if not (old and isinstance(request, GetStatus)):
            return None
        levels = (old.pop(0), 0.0)
        return Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 1, True, 25.0, 0.2, levels)

    async with running() as bench:
        bench.far_end.answer = lag
        asked = len(bench.far_end.asked)
    kinds = [type(request) for _, request in bench.far_end.asked[asked:]]
    assert kinds == [Apply, GetStatus, GetStatus, GetStatus, Disarm]
    assert caplog.text == ""


@in_virtual_time
async def test_controller_refuses_amplifiers_that_do_not_fit_the_rig() -> None:
    """Amplifiers the rig does not name, and channels an amplifier has not, are refused at once."""
    bench = make_bench(channels=1)
    other = {"other": Amplifier(bench.far_end)}
    with pytest.raises(InputError, match=r"main.*other"):
        Controller(bench.rig, bench.table, amplifiers=other)
    with pytest.raises(InputError, match=r"ERA NE .*main, got 1; .*rig file"):
        await bench.controller.open()
    assert not bench.far_end.is_open


@pytest.mark.parametrize("order", ["stop", "disarm"])
@in_virtual_time
async def test_arm_is_refused_while_silencing(order: str) -> None:
    """An Arm at the same moment is refused, not sent: which came first would be a matter of luck.

    Once the amplifiers are silenced and cleared they can be armed.
    """
    bench = make_bench("a", "b")
    await bench.controller.open()
    for far_end in bench.far_ends:
        far_end.delay = 0.02
    silencing = asyncio.create_task(getattr(bench.controller, order)())
    await asyncio.sleep(0)
    with pytest.raises(CommandRefused, match="arm again"):
        await bench.controller.arm()
    await silencing
    assert bench.controller.phase is Phase.DISARMED
    assert [far_end.requests(Arm) for far_end in bench.far_ends] == [[], []]
    await bench.controller.clear()
    await bench.controller.arm()
    assert bench.controller.phase is Phase.ARMED
    await bench.controller.close()


@in_virtual_time
async def test_incomplete_set_is_silenced_before_the_next() -> None:
    """A lift ends the wait for commits, and a finger comes before zero goes out: zero goes first.

    Some amplifiers may play the set that was given up and others not, which is no pattern at all.
    """
    bench = make_bench("a", "b")
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.01)
    for far_end in bench.far_ends:
        far_end.delay = 0.02
    bench.touch(FINGER)
    await asyncio.sleep(0.025)  # staged after 20 ms, and the commits wait for their answers
    assert [len(far_end.requests(Commit)) for far_end in bench.far_ends] == [1, 1]
    bench.touch()
    await asyncio.sleep(0.004)
    bench.touch(OTHER)
    await bench.hold(OTHER, seconds=0.2)
    for far_end in bench.far_ends:
        first, *sets = far_end.requests(Stage, Commit, Apply)
        assert first.command_set.is_silent  # as after every Arm
        assert [type(one) for one in sets] == [Stage, Commit, Apply, Stage, Commit]
        assert sets[2].command_set.is_silent
    await bench.controller.close()
    await task


@in_virtual_time
async def test_stop_completes_when_its_caller_is_cancelled_twice() -> None:
    """Cancelled twice while the amplifiers take 20 ms: they are stopped all the same."""
    async with running("a", "b") as bench:
        for far_end in bench.far_ends:
            far_end.delay = 0.02
        stopping = asyncio.create_task(bench.controller.stop())
        for _ in range(2):
            await asyncio.sleep(0.005)
            stopping.cancel()
        with pytest.raises(asyncio.CancelledError):
            await stopping
        assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.QUICK_STOP_ACTIVE}


@in_virtual_time
async def test_concurrent_stops_share_one_stop() -> None:
    """A thousand stops within 5 ms are two to amplifiers that take 10 ms each: one after the last
    of them, and after a clear in between; the amplifiers stay stopped."""
    async with running("a", "b") as bench:
        for far_end in bench.far_ends:
            far_end.delay = 0.01
        stops = []
        for _ in range(1000):
            stops.append(asyncio.create_task(bench.controller.stop()))
            await asyncio.sleep(5e-6)
        clearing = asyncio.create_task(bench.controller.clear())
        await asyncio.sleep(0)
        wished = asyncio.get_running_loop().time()
        await bench.controller.stop()
        await asyncio.gather(*stops)
        assert all(far_end.times(Stop)[-1] > wished for far_end in bench.far_ends)
        await asyncio.gather(clearing, return_exceptions=True)
        assert [len(far_end.requests(Stop)) for far_end in bench.far_ends] == [2, 2]
        assert {far_end.state for far_end in bench.far_ends} == {AmplifierState.QUICK_STOP_ACTIVE}
        await bench.controller.stop()
        assert [len(far_end.requests(Stop)) for far_end in bench.far_ends] == [3, 3]


@pytest.mark.parametrize("silencing", ["stop", "disarm"])
@in_virtual_time
async def test_silencing_prevents_commits_on_slower_wires(
    silencing: str,
) -> None:
    """Where the commit of a fast wire waits for that of a slow one, a stop or disarm that comes
    meanwhile is the last that both hear."""
    async with running("a", "b") as bench:
        bench.far_ends[0].commit_takes = 0.005
        for far_end in bench.far_ends:
            far_end.delay = 0.001
        bench.touch(FINGER)
        await asyncio.sleep(0.003)
        assert [len(far_end.requests(Commit)) for far_end in bench.far_ends] == [1, 0]
        await getattr(bench.controller, silencing)()
        await asyncio.sleep(0.1)
        assert bench.far_ends[1].requests(Commit) == []
        assert bench.reports.refused == []
