"""What a group does where something fails that should not: nobody feels more than is said."""

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from drivers.errors import CommandRefused, DriverError, Preempted
from drivers.host.amplifier import read_measured
from drivers.host.group import Group
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Envelope
from sim.amplifier.simulated_amplifier import Amplifier as FarEnd
from virtual_lines import MemoryLine, grouped, layer, losing, tone


def altered(
    far: FarEnd, change: Callable[[str, Values, float, Callable[..., Values]], Values]
) -> None:
    """Have a far end reply by a function of the request, its time, and what it does itself."""
    handle = far.handle
    far.handle = lambda name, values, now, **options: change(  # type: ignore[method-assign]
        name, values, now, partial(handle, **options)
    )


@grouped(("a",), ("b",), wire="serial")
async def test_reply_that_cannot_be_noted_keeps_nobody_waiting(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exchange fails, all are stopped; a stop whose reply cannot be noted ends in time."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError("planted")

    await group.apply({name: [layer(0, tone())] for name in "ab"})
    monkeypatch.setattr(group.amplifiers["b"].ledger, "resolve", fail)
    with pytest.raises(ZeroDivisionError):
        async with asyncio.timeout(1.0):
            await group.apply({name: [layer(0, tone(level=0.4))] for name in "ab"})
    assert not group.is_armed
    await asyncio.sleep(0.01)
    assert (ends[0].levels("a"), ends[1].levels("b")) == ([0.0, 0.0], [0.0, 0.0])
    monkeypatch.setattr(group.amplifiers["b"].ledger, "silenced", fail)
    async with asyncio.timeout(1.0):
        await group.stop()


@grouped(("a", "b"), wire="serial")
async def test_stop_is_sent_to_each_where_the_broadcast_fails(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever fails in the broadcast, which comes first."""
    await group.apply({name: [layer(0, tone())] for name in "ab"})
    submit = ends[0].line.submit

    def fail(member: object, *values: object, **other: object) -> object:
        if member is None:
            raise ZeroDivisionError("planted")
        return submit(member, *values, **other)  # type: ignore[arg-type]

    monkeypatch.setattr(ends[0].line, "submit", fail)
    stopped = await group.stop()
    assert all(each.is_confirmed for each in stopped.values())
    assert (ends[0].levels("a"), ends[0].levels("b")) == ([0.0, 0.0], [0.0, 0.0])


@grouped(("a",), wire="serial")
async def test_arm_that_was_busy_after_a_lost_reply_does_not_stay_armed(
    group: Group, ends: list[MemoryLine]
) -> None:
    """The first attempt has armed it, the repeated ones are refused: it is disarmed."""
    await group.disarm()
    ends[0].far["a"].session = 1  # that of the test never changes, and is not taken twice
    asked = 0

    def busy(name: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
        nonlocal asked
        if name == "Arm":
            asked += 1
            if asked > 1:
                raise Refusal("busy", "BUSY")
        return handle(name, values, now)

    ends[0].outward = losing("Arm", count=2)  # its event, and the reply
    altered(ends[0].far["a"], busy)
    with pytest.raises(CommandRefused):
        await group.arm()
    assert asked > 1
    assert ends[0].far["a"].state != "OPERATION_ENABLED"


@grouped(("a",), ("b",), wire="serial")
async def test_amplifier_that_is_not_armed_after_arm_is_not_said_to_be(
    group: Group, ends: list[MemoryLine]
) -> None:
    """It tells a fault in its reply: none stays armed, not even the one that was."""
    await group.disarm()
    for end in ends:
        for far in end.far.values():
            far.session = 1  # that of the test never changes, and is not taken twice
    far = ends[1].far["b"]

    def trip(name: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
        reply = handle(name, values, now)
        if name != "Arm":
            return reply
        far.trip("OVER_VOLTAGE", now)
        return far.status(now)

    altered(far, trip)
    with pytest.raises(CommandRefused, match="OVER_VOLTAGE"):
        await group.arm()
    assert not group.is_armed
    assert ends[0].far["a"].state != "OPERATION_ENABLED"


@grouped(("a",), wire="serial")
async def test_ramp_of_a_disarm_may_play_on_after_the_watchdog(
    group: Group, ends: list[MemoryLine]
) -> None:
    """One of 1 s is heard once, no reply comes: it is not lost while it fades."""
    (end,) = ends
    await group.apply({"a": [layer(0, tone())]})
    end.outward = lambda name, data: []
    disarming = asyncio.ensure_future(group.disarm(1.0))
    for _ in range(100):
        await asyncio.sleep(0.001)
        if end.far["a"].state != "OPERATION_ENABLED":
            break
    end.inward = lambda name, data: []
    while end.levels("a")[0]:
        assert not group.members.lost_by
        await asyncio.sleep(0.005)
    with pytest.raises(DriverError):
        await disarming


@pytest.mark.parametrize("wire", ["serial", "can", "tcp"])
@grouped(("a",))
async def test_reading_that_gives_way_to_a_set_is_no_silence(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Its reply takes 8 ms, the set has several parts: all are played, then it is read."""
    (end,) = ends
    end.outward = lambda name, data: [(0.008 if name == "GetMeasured" else 0.0002, data)]
    reading = asyncio.ensure_future(read_measured(group.amplifiers["a"]))
    await asyncio.sleep(0.001)
    onset = Envelope(20, ((100, 0),) * 12)
    await group.apply({"a": [layer(number, tone(level=0.05, onset=onset)) for number in range(4)]})
    assert not group.members.degraded
    await reading


@pytest.mark.parametrize("wire", ["serial", "can", "rtu"])
@grouped(("a",))
async def test_heartbeats_and_stops_go_between_the_parts_of_a_set(
    group: Group, ends: list[MemoryLine]
) -> None:
    """What comes while parts are on the line is sent next; after a stop no other part is."""
    (end,) = ends
    end.outward = lambda _, data: [(0.002, data)]
    tones = [tone(each, 0.05, onset=Envelope(20, ((100, 0),) * 12)) for each in (0, 1)]
    layers = {"a": [layer(number, *tones) for number in range(8)]}
    kinds = [f"1:{MESSAGES[name].number}" for name in ("Set", "Ping", "Stop")]
    part, heartbeat, stop = kinds

    def sent() -> list[str]:
        return [each for _, each in end.sent]

    playing = asyncio.ensure_future(group.apply(layers))
    await asyncio.sleep(0.001)
    assert sent()[-1] == part
    end.sent.clear()
    await group.amplifiers["a"].ping()
    await playing
    assert sent()[:2] == [heartbeat, part]
    assert sent()[-1] == part
    playing = asyncio.ensure_future(group.apply(layers))
    await asyncio.sleep(0.001)
    end.sent.clear()
    await group.stop()
    with pytest.raises(Preempted):
        await playing
    assert sent()[0] == stop
    assert part not in sent()
    assert end.far["a"].state == "QUICK_STOP_ACTIVE"


@grouped(("a",), wire="serial")
async def test_request_to_a_busy_amplifier_goes_again_whenever_its_timer_comes(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the clock of some systems a timer comes up to 16 ms early: here 4 ms."""
    (end,) = ends
    call_at, refusals = end.loop.call_at, [Refusal("busy", "BUSY")]

    def early(when: float, *args: Any, **more: Any) -> asyncio.TimerHandle:
        return call_at(when - 0.004 if when - end.loop.time() > 0.0045 else when, *args, **more)

    def busy(name: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
        if name == "Ping" and refusals:
            raise refusals.pop()
        return handle(name, values, now)

    monkeypatch.setattr(end.loop, "call_at", early)
    altered(end.far["a"], busy)
    await asyncio.wait_for(group.beat(), 0.1)
    assert not refusals


@pytest.mark.parametrize("what", ["cables", "replies"])
@grouped(("a",), ("b",))
async def test_lines_that_are_exchanged_while_armed_are_silenced(
    group: Group, ends: list[MemoryLine], what: str
) -> None:
    """Each amplifier refuses the other's session, and a line takes no reply to the other's request.

    Both are at address 1, alike and silent, so that no status contradicts what was sent.
    """
    first, second = ends
    if what == "cables":
        first._end, second._end = (
            one.kind.far_end({1: far}, one._send)
            for one, far in ((first, second.far["b"]), (second, first.far["a"]))
        )
    else:
        await second.hosts["b"].read_status()  # numbers of requests begin anywhere on each line
        first.line, second.line = second.line, first.line
    async with asyncio.timeout(2.0):
        while group.is_armed:
            with contextlib.suppress(DriverError):
                await group.beat()
            await asyncio.sleep(0.05)
    await asyncio.sleep(0.3)
    for end in ends:
        for far in end.far.values():
            far.tick(end.loop.time())
            assert far.state != "OPERATION_ENABLED"


@grouped(("a", "b"), ("c",), wire="serial")
async def test_session_is_one_on_each_line(group: Group, ends: list[MemoryLine]) -> None:
    """A broadcast commit carries it to all amplifiers of its line, and plays on no other's."""
    await group.apply({name: [layer(0, tone())] for name in "abc"})
    await asyncio.sleep(0.01)
    assert [ends[0].levels("a"), ends[0].levels("b"), ends[1].levels("c")] == [[0.5, 0.0]] * 3
    a, b, c = (far.session for end in ends for far in end.far.values())
    assert a == b != c
