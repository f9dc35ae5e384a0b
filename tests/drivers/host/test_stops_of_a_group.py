"""Stops, silences and disarms of a group silence every amplifier that still hears its line.

A stop is confirmed only by what the amplifier itself reports. Frames are lost, late or altered, and
other requests are under way.
"""

import asyncio
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Preempted,
)
from drivers.protocol.definition import STATES
from drivers.wires.wire import BrokenReply
from registry import threads
from tests.drivers.host.group_on_lines import (
    HALF,
    SILENT,
    begin,
    connect,
    intercept,
    late,
    layer,
    losing,
    lost,
    on_wires,
    report,
)


@on_wires()
async def test_stop_overtakes_queued_readings_and_the_commit_of_a_set(wire: str) -> None:
    """Ten readings are queued and a set is on the line: the stop is sent within 9 ms."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    rig.line.outward = late(0.004)
    readings = [await begin(rig.hosts["a"].read_status()) for _ in range(10)]
    playing = await begin(rig.play(0.9))
    await asyncio.sleep(0.001)
    rig.watch()

    assert await rig.stop() == {"a": True}

    assert rig.sent_after("a Stop") <= 0.009
    with pytest.raises(Preempted):
        await playing
    await asyncio.gather(*readings)
    assert rig.levels == {"a": SILENT}


@on_wires()
async def test_stop_silences_a_mute_amplifier_without_confirmation(wire: str) -> None:
    """An amplifier whose replies are lost hears the stop, and is silent 10 ms later."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    rig.line.outward = lost
    with pytest.raises(LinkError):
        await rig.group.beat()
    assert rig.levels == {"a": HALF}

    stopping = await begin(rig.stop())
    await asyncio.sleep(0.01)

    assert rig.levels == {"a": SILENT}
    assert await stopping == {"a": False}


@pytest.mark.parametrize(
    "values",
    [
        {"levels": [1, 0]},
        {"channels": 0, "levels": []},
        {"latch": 0},
        {"state": STATES["OPERATION_ENABLED"]},
        {"state": STATES["SWITCH_ON_DISABLED"]},
    ],
    ids=["playing", "no levels", "old latch", "armed", "disarmed"],
)
@on_wires()
async def test_stop_is_confirmed_by_a_new_latch_and_zero_levels_only(
    wire: str, values: dict[str, Any]
) -> None:
    """Within 0.5 s the stop is unconfirmed, and states until when the amplifier may play."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    report(rig.far["a"], **values)
    rig.watch()

    async with asyncio.timeout(0.5):
        outcome = (await rig.group.stop())["a"]

    assert not outcome.is_confirmed
    assert outcome.may_play_until > rig.since


@on_wires("serial")
async def test_stop_reaches_the_last_amplifier_after_four_mute_ones(wire: str) -> None:
    """Four get the broadcast alone: all are silent within 10 ms, and the fifth confirms it."""
    rig = await connect("abcde", wire=wire)
    await rig.play(0.5)
    deaf = {rig.hosts[name].address for name in "abcd"}

    def alter(_: str, data: bytes) -> list[tuple[float, bytes]]:
        address, _ = rig.line.kind.request_of(data)
        return [] if address in deaf else [(0.0, data)]

    rig.line.inward = alter
    stopping = await begin(rig.stop())
    await asyncio.sleep(0.01)

    assert rig.levels == dict.fromkeys("abcde", SILENT)
    assert await stopping == {"a": False, "b": False, "c": False, "d": False, "e": True}


@on_wires("serial")
async def test_stop_reaches_each_amplifier_when_the_broadcast_fails(wire: str) -> None:
    """An exception in the broadcast leaves the stops of the single amplifiers in place."""
    rig = await connect("ab", wire=wire)
    await rig.play(0.5)
    rig.group.members.broadcast_stop = Mock(side_effect=ZeroDivisionError("planted"))

    assert await rig.stop() == {"a": True, "b": True}
    assert rig.levels == {"a": SILENT, "b": SILENT}


@on_wires("serial")
async def test_stop_reports_a_lost_line_immediately(wire: str) -> None:
    """The stop awaits no reply on a line that was cut, and stops the amplifier on the other."""
    rig = await connect("a", "b", wire=wire)
    rig.hosts["a"].line.lose("cut")

    async with asyncio.timeout(0.1):
        outcomes = await rig.group.stop()

    causes = {name: outcome.cause for name, outcome in outcomes.items()}
    assert causes == {"a": "cut", "b": ""}
    assert outcomes["b"].is_confirmed


@on_wires()
async def test_stop_does_not_wait_for_a_lost_reply(wire: str) -> None:
    """The reading under way is given up; on RTU its response could still come for 14 ms."""
    rig = await connect("a", wire=wire)
    rig.line.outward = lost
    reading = await begin(rig.hosts["a"].read_status())
    await asyncio.sleep(0.001)
    rig.watch()

    stopping = await begin(rig.stop())
    await asyncio.sleep(0.02)

    limit = 0.0143 if wire == "rtu" else 0.009
    assert rig.sent_after("a Stop") <= limit
    rig.line.outward = late(0.0002)
    assert await stopping == {"a": True}
    await reading


@on_wires("rtu")
async def test_stop_does_not_collide_with_a_late_reply(wire: str) -> None:
    """A status of 8 + 39 characters of 11 bits and two silences starts 4 ms late, in all 12 ms."""
    rig = await connect("a", wire=wire, is_armed=False)
    end_of_reply = 0.011988

    def alter(_: str, data: bytes) -> list[tuple[float, bytes]]:
        return [(end_of_reply if len(data) > 8 else 0.0, data)]

    rig.line.outward = alter
    rig.watch()
    reading = await begin(rig.hosts["a"].read_status())
    await asyncio.sleep(0.001)

    await rig.hosts["a"].stop()

    await reading
    assert rig.sent_after("a Stop") >= end_of_reply
    assert rig.retries == 0
    assert rig.line.line.wire.counters.unexpected_frames == 0


@on_wires()
async def test_stop_is_repeated_when_its_reply_cannot_be_read(wire: str) -> None:
    """The first reply is broken; the second one confirms the stop."""
    rig = await connect("a", wire=wire)
    host_wire = rig.line.line.wire
    received = host_wire.received
    broken_replies = [[BrokenReply("cut")]]
    host_wire.received = lambda data: broken_replies.pop() if broken_replies else received(data)
    rig.watch()

    assert await rig.stop() == {"a": True}
    assert rig.requests()[:2] == ["a Stop", "a Stop"]


@on_wires("serial", "rtu", "tcp")
async def test_stop_is_confirmed_after_the_amplifier_restarted(wire: str) -> None:
    """Its latches count from 1 again: after three stops, the first one after a restart is 1."""
    rig = await connect("a", wire=wire)
    for _ in range(3):
        await rig.stop()
    await rig.group.clear()
    await rig.group.arm()
    await rig.play(0.5)
    rig.far["a"].restart(threads.now())

    async with asyncio.timeout(0.2):
        assert await rig.stop() == {"a": True}
    assert rig.far["a"].state == "QUICK_STOP_ACTIVE"

    await rig.group.clear()
    await rig.group.arm()
    await rig.play(0.5)


@on_wires()
async def test_stop_commits_no_set_while_a_line_is_busy(wire: str) -> None:
    """A commit waits 90 ms for a busy line: the stop goes out immediately on the free one.

    The loop turns fewer than 20 times in 40 ms, so nothing polls the busy line.
    """
    rig = await connect("a", "b", wire=wire)
    rig.line.outward = late(0.0002, Set=0.025, GetStatus=0.025, Stop=0.025)
    rig.watch()
    playing = await begin(rig.play(0.5))
    reading = await begin(rig.hosts["a"].read_status())
    selector = rig.line.loop._selector
    selector.select = Mock(side_effect=selector.select)
    await asyncio.sleep(0.04)
    assert "b Commit" not in rig.requests(line=1)
    assert 1 <= selector.select.call_count < 20
    rig.watch()

    assert await rig.stop() == {"a": True, "b": True}

    assert rig.sent_after("b Stop", line=1) == 0.0
    with pytest.raises(DriverError):
        await playing
    await reading
    assert rig.voices("a") == ()
    assert rig.hosts["a"].ledger.playback.all_voices[0] == ()
    assert rig.levels == {"a": SILENT, "b": SILENT}


@on_wires("serial")
async def test_exception_while_noting_a_reply_stops_all_in_time(wire: str) -> None:
    """The exchange fails and all are stopped; a stop whose reply cannot be noted ends as well."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    ledger = rig.hosts["b"].ledger
    ledger.resolve = Mock(side_effect=ZeroDivisionError("planted"))

    async with asyncio.timeout(1.0):
        with pytest.raises(ZeroDivisionError):
            await rig.play(0.4)
    await asyncio.sleep(0.01)
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert not rig.group.is_armed

    ledger.silenced = Mock(side_effect=ZeroDivisionError("planted"))
    async with asyncio.timeout(1.0):
        await rig.group.stop()


@on_wires("serial")
async def test_failing_listener_loses_no_reply(wire: str) -> None:
    """The event and the reply of the stop that caused it arrive in one read."""
    rig = await connect("a", wire=wire)
    rig.hosts["a"].listeners.append(Mock(side_effect=ZeroDivisionError("planted")))

    assert await rig.stop() == {"a": True}


@pytest.mark.parametrize("ending", ["stop", "disarm"])
@on_wires("serial")
async def test_nothing_is_sent_after_a_stop_or_disarm(wire: str, ending: str) -> None:
    """A heartbeat and a set are refused before they reach the line."""
    rig = await connect("a", wire=wire)
    await getattr(rig.group, ending)()
    rig.watch()

    with pytest.raises(CommandRefused):
        await rig.group.beat()
    with pytest.raises(CommandRefused):
        await rig.play(0.5)

    assert rig.requests() == []


@on_wires("serial")
async def test_fault_in_a_status_stops_all_before_a_set_is_sent(wire: str) -> None:
    """A set waits for the reading that reports a fault of b: it is not sent, and a is stopped."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    rig.far["b"].trip("OVER_VOLTAGE", threads.now())
    reading = await begin(rig.hosts["b"].read_status())
    rig.watch()

    with pytest.raises(CommandRefused, match="OVER_VOLTAGE"):
        await rig.play(0.4)

    await reading
    assert not {"b Set", "b Commit"} & set(rig.requests(line=1))
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert not rig.group.is_armed


@on_wires("serial")
async def test_clear_is_refused_until_the_stop_is_over(wire: str) -> None:
    """Clearing is refused while amplifiers are being stopped, and arming before clearing."""
    rig = await connect("a", wire=wire)
    stopping = await begin(rig.group.stop())

    with pytest.raises(Preempted):
        await rig.group.clear()
    await stopping
    with pytest.raises(CommandRefused, match="cleared"):
        await rig.group.arm()

    await rig.group.clear()


@on_wires("serial")
async def test_disarm_continues_when_its_caller_is_cancelled(wire: str) -> None:
    """Behind a request without a reply: the amplifier is silent and disarmed nevertheless."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    rig.line.outward = losing("GetStatus")
    reading = await begin(rig.hosts["a"].read_status())
    disarming = await begin(rig.group.disarm())
    await asyncio.sleep(0.001)

    disarming.cancel()

    await asyncio.gather(reading, disarming, return_exceptions=True)
    await asyncio.sleep(0.1)
    assert rig.levels == {"a": SILENT}
    assert rig.far["a"].state == "SWITCH_ON_DISABLED"


@on_wires("serial")
async def test_disarm_that_is_ignored_stops(wire: str) -> None:
    """The amplifier replies to Disarm without obeying: an error, and silence by the stop."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    intercept(rig.far["a"], "Disarm", lambda _: rig.far["a"].status(threads.now()))

    with pytest.raises(CommandRefused):
        await rig.group.disarm()

    assert rig.levels == {"a": SILENT}


@on_wires("serial")
async def test_long_disarm_ramp_may_outlast_the_watchdog(wire: str) -> None:
    """An amplifier that heard a ramp of 1 s once is not lost while it fades without replies."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    rig.line.outward = lost
    disarming = await begin(rig.group.disarm(1.0))
    await asyncio.sleep(0.005)
    assert rig.far["a"].state == "SWITCHED_ON"
    rig.line.inward = lost

    await asyncio.sleep(0.95)

    assert rig.levels["a"] != SILENT
    assert rig.group.members.lost_by == {}
    with pytest.raises(DriverError):
        await disarming
    assert rig.levels == {"a": SILENT}


@on_wires("serial")
async def test_silence_that_an_amplifier_missed_is_repeated_by_the_next(wire: str) -> None:
    """The other amplifier is silent immediately, this one after the next silence."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    rig.lines[1].inward = losing("Silence", count=3)

    with pytest.raises(LinkDegraded):
        await rig.group.silence(0.001)
    assert rig.levels == {"a": SILENT, "b": HALF}

    await rig.group.silence(0.001)
    await asyncio.sleep(0.002)
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert rig.group.is_armed


@on_wires("serial")
async def test_silent_layer_is_sent_after_its_amplifiers_delayed_the_line(wire: str) -> None:
    """No replies for 130 ms and 30 ms for each of three: beyond 0.1 s it is sent, not refused."""
    rig = await connect("abc", wire=wire)
    await rig.play(0.5)
    replies_from = rig.line.loop.time() + 0.13
    rig.line.outward = lambda _, data: [(0.0, data)] if threads.now() >= replies_from else []

    await rig.apply(layer(0))

    assert rig.group.is_armed
    await asyncio.sleep(0.05)
    assert rig.levels == dict.fromkeys("abc", SILENT)


@on_wires("serial")
async def test_silence_without_a_reply_may_have_been_heard(wire: str) -> None:
    """All layers may be over, as statuses report afterwards; after a confirmed one they may not."""
    rig = await connect("a", wire=wire)
    host = rig.hosts["a"]
    await rig.play(0.5)
    rig.line.outward = losing("Silence", count=3)
    with pytest.raises(LinkDegraded):
        await rig.group.silence(0.005)

    for _ in range(3):
        await asyncio.sleep(0.02)
        status = await host.read_status()
        assert status["tokens"][0] == 0
        assert host.contradictions.count == 0
        await host.ping()

    await rig.group.silence(0.005)
    await rig.play(0.5)
    await asyncio.sleep(0.02)
    rig.far["a"].playback.silence(threads.now(), 0.0)
    await asyncio.sleep(0.02)
    await host.read_status()
    await asyncio.sleep(0.02)
    with pytest.raises(CommandRefused, match="token of layer 0"):
        await host.read_status()
