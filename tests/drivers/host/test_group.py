"""Lines, amplifiers and their group on every kind of wire of protocol 3, in virtual time.

What a person would feel is read from the simulated amplifiers themselves.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence

import pytest

from drivers.contents import Tone
from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    LinkTimeout,
    Preempted,
)
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.jobs import Priority
from drivers.host.wire import Broken
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import MESSAGES, STATES
from virtual_loop import in_virtual_time
from words_line import (
    MemoryLine,
    group_of,
    grouped,
    layer,
    losing,
    tone,
    unaltered,
    with_group,
)

LINES = {"alone": (("a",),), "each its own": (("a",), ("b",)), "shared": (("a", "b"),)}


@pytest.mark.parametrize("lines", LINES)
def test_layers_play_together_and_leave_each_other_alone(wire: str, lines: str) -> None:
    """A second layer adds 0.2; the first falls silent while the second plays on, on all at once."""

    async def test(group: Group, ends: list[MemoryLine]) -> None:
        names = [*group.amplifiers]
        await group.apply({name: [layer(0, tone())] for name in names})
        second = layer(1, Tone(0, 150.0, 0.2), Tone(1, 150.0, 0.1))
        await group.apply({name: [second] for name in names})
        await asyncio.sleep(0.002)
        for end in ends:
            assert all(end.levels(name) == [0.7, 0.1] for name in end.hosts)
        origins = [
            {round(voice.origin, 4) for voice in far.playback.voices_of(1)}
            for end in ends
            for far in end.far.values()
        ]
        assert all(each == origins[0] and len(each) == 1 for each in origins)
        await group.apply({name: [layer(0)] for name in names})
        await asyncio.sleep(0.002)
        assert all(end.levels(name) == [0.2, 0.1] for end in ends for name in end.hosts)
        assert all(end.retries == 0 for end in ends)
        assert all(end.line.wire.counters.unexpected_frames == 0 for end in ends)

    with_group(test, wire, *LINES[lines])


@grouped(("a",), ("b",))
async def test_refused_on_one_means_committed_on_none(group: Group, ends: list[MemoryLine]) -> None:
    """The ledger of the second refuses a channel it does not have; the first plays on."""
    await group.apply({name: [layer(0, tone())] for name in "ab"})
    with pytest.raises(CommandRefused) as raised:
        await group.apply({"a": [layer(0, tone(level=0.9))], "b": [layer(0, tone(2))]})
    assert (raised.value.channel, group.is_armed) == (2, True)
    await asyncio.sleep(0.002)
    assert [ends[0].levels("a"), ends[1].levels("b")] == [[0.5, 0.0]] * 2
    await group.apply({name: [layer(0, tone(level=0.3))] for name in "ab"})


@grouped(("a",))
async def test_degraded_amplifier_gets_nothing_that_plays_or_feeds(
    group: Group, ends: list[MemoryLine]
) -> None:
    """After three requests without reply; a status ends it."""
    (host,) = group.amplifiers.values()
    ends[0].outward = lambda name, data: []
    with pytest.raises(LinkTimeout):
        await host.ping()
    for request in (host.ping, lambda: host.stage(1, [layer(0, tone())])):
        with pytest.raises(LinkDegraded):
            await request()
    ends[0].outward = unaltered
    await host.read_status()
    await host.ping()


@grouped(("a", "b"))
async def test_silence_does_not_wait_for_one_that_is_mute(
    group: Group, ends: list[MemoryLine]
) -> None:
    """The other amplifier of its line has its request at once."""
    end = ends[0]
    end.outward = lambda name, data: [] if end.sent[-1][1][0] == "1" else unaltered(name, data)
    with pytest.raises(LinkTimeout):
        await group.amplifiers["a"].ping()
    began = end.loop.time()
    silencing = asyncio.ensure_future(group.silence(0.005))
    await asyncio.sleep(0.005)
    assert next(each for at, each in end.sent if at >= began) == "2:7"
    with pytest.raises(LinkError):
        await silencing


@grouped(("a",))
async def test_stop_overtakes_what_is_queued(group: Group, ends: list[MemoryLine]) -> None:
    """With a set on the line and ten readings queued: silent within 20 ms, none is committed."""
    (host,) = group.amplifiers.values()
    await group.apply({"a": [layer(0, tone())]})
    ends[0].outward = lambda name, data: [(0.004, data)]
    reads = [asyncio.ensure_future(host.read_status()) for _ in range(10)]
    applying = asyncio.ensure_future(group.apply({"a": [layer(0, tone(level=0.9))]}))
    await asyncio.sleep(0.001)
    began = ends[0].loop.time()
    stopped = await group.stop()
    assert stopped["a"].is_confirmed
    sent = next(at for at, each in ends[0].sent if each == "1:8" and at >= began)
    assert sent - began <= 0.009
    with pytest.raises(Preempted):
        await applying
    await asyncio.gather(*reads)
    assert ends[0].levels("a") == [0.0, 0.0]


@grouped(("a",))
async def test_stop_does_not_wait_for_a_reply_that_is_lost(
    group: Group, ends: list[MemoryLine], wire: str
) -> None:
    """It is sent within 9 ms of the request, which is given up.

    On RTU within 8 ms of when the response to a write of 11 characters would have ended.
    """
    latest = 0.009 + (19 * 11 / 115_200 + 2 * 0.00175 if wire == "rtu" else 0.0)
    (host,) = group.amplifiers.values()
    ends[0].outward = lambda name, data: []
    reading = asyncio.ensure_future(host.read_status())
    await asyncio.sleep(0.001)
    began = ends[0].loop.time()
    stopping = asyncio.ensure_future(group.stop())
    await asyncio.sleep(0.02)
    sent = next(at for at, each in ends[0].sent if each == "1:8" and at >= began)
    assert sent - began <= latest
    ends[0].outward = lambda name, data: [(0.0002, data)]
    assert (await stopping)["a"].is_confirmed
    await reading


@grouped(("a",))
async def test_mute_amplifier_is_stopped_over_its_open_line(
    group: Group, ends: list[MemoryLine]
) -> None:
    """It hears the host, which hears nothing: silent 10 ms after the stop, unconfirmed."""
    await group.apply({"a": [layer(0, tone())]})
    ends[0].outward = lambda name, data: []
    with pytest.raises(LinkError):
        await group.beat()
    assert ends[0].levels("a") == [0.5, 0.0]
    stopping = asyncio.ensure_future(group.stop())
    await asyncio.sleep(0.01)
    assert ends[0].levels("a") == [0.0, 0.0]
    assert not (await stopping)["a"].is_confirmed


LIES: dict[str, Callable[[Values], Values]] = {
    "levels that stay": lambda status: {**status, "levels": [1, 0]},
    "no levels": lambda status: {**status, "channels": 0, "levels": []},
    "an old latch": lambda status: {**status, "latch": 0},
    "still armed": lambda status: {**status, "state": STATES["OPERATION_ENABLED"]},
    "only disarmed": lambda status: {**status, "state": STATES["SWITCH_ON_DISABLED"]},
}


@pytest.mark.parametrize("lie", LIES)
@grouped(("a",))
async def test_stop_is_confirmed_by_nothing_less_than_a_new_latch_and_all_levels(
    group: Group, ends: list[MemoryLine], lie: str
) -> None:
    """Whatever of it is missing: not confirmed, within 0.5 s, with the time that it may play."""
    await group.apply({"a": [layer(0, tone())]})
    far = ends[0].far["a"]
    status = far.status
    far.status = lambda now: LIES[lie](status(now))
    began = ends[0].loop.time()
    stopped = (await group.stop())["a"]
    assert not stopped.is_confirmed
    assert stopped.cause
    assert ends[0].loop.time() - began < 0.5
    assert stopped.may_play_until > began


@grouped(("a",))
async def test_stop_is_repeated_after_a_reply_that_is_none(
    group: Group, ends: list[MemoryLine], wire: str
) -> None:
    """The first reply to it cannot be read; the second confirms it."""
    host_side = ends[0].line.wire
    received, broken = host_side.received, iter([[Broken("cut")]])
    host_side.received = lambda data: next(broken, None) or received(data)
    assert (await group.stop())["a"].is_confirmed
    assert [each for _, each in ends[0].sent][-2:] == ["1:8", "1:8"]


@grouped(("a",))
async def test_watchdog_is_fed_by_the_group_alone(group: Group, ends: list[MemoryLine]) -> None:
    """Beats keep it playing; without them it is silent after 0.255 s."""
    await group.apply({"a": [layer(0, tone())]})
    for _ in range(20):
        await asyncio.sleep(0.05)
        await group.beat()
    assert ends[0].levels("a") == [0.5, 0.0]
    await asyncio.sleep(0.256)
    assert ends[0].levels("a") == [0.0, 0.0]
    with pytest.raises(CommandRefused):
        await group.beat()


@grouped(("a",))
async def test_watchdog_is_seen_to_run_down_five_times_a_second(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Before one of four heartbeats, or less on a slow wire: their own reply shows a full one."""
    status, ping = (MESSAGES[name].number for name in ("GetStatus", "Ping"))
    before = len(ends[0].sent)
    for _ in range(20):
        await group.beat()
        await asyncio.sleep(0.05)
    kinds = Counter(each.partition(":")[2] for _, each in ends[0].sent[before:])
    assert kinds.keys() == {f"{status}", f"{ping}"}
    assert kinds[f"{ping}"] == 20
    assert 2 <= kinds[f"{status}"] <= 5


@grouped(("a",))
async def test_contradictions_twice_in_a_row_are_a_fault(
    group: Group, ends: list[MemoryLine]
) -> None:
    """A derated channel: half of the level once is passed over, twice stops."""
    await group.apply({"a": [layer(0, tone())]})
    await asyncio.sleep(0.01)
    ends[0].far["a"].set_temperature(71.0, ends[0].loop.time())
    await asyncio.sleep(0.03)
    await group.beat()
    await asyncio.sleep(0.05)
    with pytest.raises(CommandRefused):
        await group.beat()
    assert not group.is_armed


@in_virtual_time
async def test_host_that_drives_already_is_seen_and_left_alone(wire: str) -> None:
    """Its heartbeats raise the watchdog unasked; without them the amplifier is taken over."""
    end = MemoryLine(wire, "a")
    far = end.far["a"]
    far.handle("Arm", {"session": 5, "watchdog": 2000}, end.loop.time())

    async def feed() -> None:
        while True:
            await asyncio.sleep(0.07)
            far.handle("Ping", {"session": 5}, end.loop.time())

    other = asyncio.ensure_future(feed())
    with pytest.raises(LinkError):
        await end.hosts["a"].open()
    assert far.state == "OPERATION_ENABLED"
    other.cancel()
    await end.hosts["a"].open()
    assert far.state != "OPERATION_ENABLED"


IDENTITIES: Values = {"versions": 0b110, "serial_number": "SIM-b"}


@pytest.mark.parametrize("name", IDENTITIES)
@in_virtual_time
async def test_another_amplifier_or_version_is_refused(wire: str, name: str) -> None:
    """An amplifier of version 2, and one of another serial number."""
    end = MemoryLine(wire, "a")
    end.far["a"].identity[name] = IDENTITIES[name]
    host = Amplifier(end.line, 1, end.hosts["a"].limits, name="a", serial_number="SIM-a")
    with pytest.raises(LinkError):
        await host.open()


@in_virtual_time
async def test_opening_disarms_what_an_earlier_host_left_armed(wire: str) -> None:
    """It plays on until then, with a watchdog of 2 s."""
    end = MemoryLine(wire, "a")
    (host,) = end.hosts.values()
    await host.open()
    await host.arm(9, 2.0)
    await host.stage(7, [layer(0, tone())], now=True)
    await asyncio.sleep(0.02)  # its ramp
    assert end.levels("a") == [0.5, 0.0]
    await host.open()
    assert end.levels("a") == [0.0, 0.0]
    assert end.far["a"].state == "SWITCH_ON_DISABLED"


@grouped(("a",), wire="serial")
async def test_late_reply_is_not_that_of_the_next_request(
    group: Group, ends: list[MemoryLine]
) -> None:
    """A reply after 70 ms comes while another request waits, whose own comes after 20 ms."""
    (host,) = group.amplifiers.values()
    delays = iter([0.07, 0.0002, 0.02])
    ends[0].outward = lambda name, data: [(next(delays, 0.0002), data)]
    await host.ping()
    await asyncio.sleep(0.03)
    began = asyncio.get_running_loop().time()
    await host.ping()
    assert asyncio.get_running_loop().time() - began >= 0.02
    assert ends[0].line.wire.counters.unexpected_frames == 1


@pytest.mark.parametrize("alone", ["b", "abcd"])
@grouped(tuple("abcde"), wire="serial")
async def test_stop_reaches_those_beside_a_mute_amplifier(
    group: Group, ends: list[MemoryLine], alone: str
) -> None:
    """On one serial line: all that hear are silent within 10 ms, and the last is confirmed."""
    (end,) = ends
    await group.apply({name: [layer(0, tone())] for name in end.hosts})
    muted = {end.hosts[name].address for name in alone}
    end.inward = lambda name, data: [] if end.kind.request_of(data)[0] in muted else [(0, data)]  # type: ignore[index]
    stopping = asyncio.ensure_future(group.stop())
    await asyncio.sleep(0.01)
    assert all(end.levels(name) == [0.0, 0.0] for name in end.hosts)
    stopped = await stopping
    assert stopped["e"].is_confirmed
    assert not any(stopped[name].is_confirmed for name in alone)


@grouped(tuple("ab"), wire="serial")
async def test_mute_amplifier_keeps_no_heartbeat_waiting(
    group: Group, ends: list[MemoryLine]
) -> None:
    """On one serial line: the other one is fed within 10 ms, though replies are awaited for 30."""
    (end,) = ends
    muted = end.hosts["a"].address
    end.inward = lambda name, data: [] if end.kind.request_of(data)[0] == muted else [(0, data)]  # type: ignore[index]
    with pytest.raises(LinkDegraded):
        await group.beat()
    await asyncio.sleep(0.11)  # until the reading of its status was given up
    for _ in range(2):
        began = end.loop.time()
        await group.beat()
        assert end.loop.time() - began < 0.01
        await asyncio.sleep(0.001)


@grouped(("a", "b"))
async def test_ledger_knows_what_a_lost_broadcast_started(
    group: Group, ends: list[MemoryLine]
) -> None:
    """The repeated commit is noted: what is too loud beside it is refused."""
    ends[0].inward = losing("Commit")
    await group.apply({name: [layer(0, tone(level=0.6))] for name in "ab"})
    await asyncio.sleep(0.002)
    for name in "ab":
        assert group.amplifiers[name].ledger.playback.tokens == {0: 78}
        assert ends[0].levels(name) == [0.6, 0.0]
    with pytest.raises(CommandRefused):
        await group.apply({name: [layer(1, Tone(0, 150.0, 0.5))] for name in "ab"})
    await group.beat()


async def stopped_by_hand(group: Group) -> None:
    """A stop."""
    await group.stop()


@pytest.mark.parametrize("end_by", [stopped_by_hand, Group.disarm])
@grouped(("a",), wire="serial")
async def test_nothing_is_fed_or_played_once_it_is_not_armed(
    group: Group, ends: list[MemoryLine], end_by: Callable[[Group], Awaitable[None]]
) -> None:
    """A beat and a set after a stop or disarm send nothing, also where that was not confirmed."""
    await end_by(group)
    ends[0].sent.clear()
    for late in (group.beat(), group.apply({"a": [layer(0, tone())]})):
        with pytest.raises(CommandRefused):
            await late
    assert ends[0].sent == []


@grouped(("a",), wire="serial")
async def test_disarm_goes_on_where_its_caller_is_cancelled(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Behind a request that has no reply: silent and switched off all the same."""
    await group.apply({"a": [layer(0, tone())]})
    ends[0].outward = losing("GetStatus")
    reading = asyncio.ensure_future(group.amplifiers["a"].read_status())
    disarming = asyncio.ensure_future(group.disarm())
    await asyncio.sleep(0.001)
    disarming.cancel()
    await asyncio.wait([reading, disarming])
    await asyncio.sleep(0.1)
    assert ends[0].levels("a") == [0.0, 0.0]
    assert ends[0].far["a"].state == "SWITCH_ON_DISABLED"


@grouped(("a",), wire="serial")
async def test_disarm_that_is_ignored_stops(group: Group, ends: list[MemoryLine]) -> None:
    """A far end that keeps playing after Disarm: an error, and silent by the stop."""
    (far,) = ends[0].far.values()
    handle = far.handle

    def ignore(name: str, values: Values, now: float) -> Values:
        return handle("GetStatus", {}, now) if name == "Disarm" else handle(name, values, now)

    await group.apply({"a": [layer(0, tone())]})
    far.handle = ignore  # type: ignore[method-assign]
    with pytest.raises(CommandRefused):
        await group.disarm()
    assert ends[0].levels("a") == [0.0, 0.0]


@grouped(("a",), ("b",), wire="serial")
async def test_silence_that_one_does_not_hear_is_repeated(
    group: Group, ends: list[MemoryLine]
) -> None:
    """A finger was lifted: the other is silent at once, and this one by the next silence."""
    await group.apply({name: [layer(0, tone())] for name in "ab"})
    ends[1].inward = losing("Silence", count=3)
    with pytest.raises(LinkDegraded):
        await group.silence(0.001)
    assert (ends[0].levels("a"), ends[1].levels("b")) == ([0.0, 0.0], [0.5, 0.0])
    await group.silence(0.001)
    await asyncio.sleep(0.002)
    assert ends[1].levels("b") == [0.0, 0.0]
    assert group.is_armed


@grouped(("a",), ("b",), wire="serial")
async def test_set_that_would_be_committed_too_late_is_not(
    group: Group, ends: list[MemoryLine]
) -> None:
    """The ledger admitted it for a tenth of a second; its commit is lost until after that.

    The other amplifier played it: both are silenced, and stay armed for the next.
    """
    await group.apply({name: [layer(1, Tone(1, 150.0, 0.1))] for name in "ab"})
    ends[0].inward = losing("Commit", count=2)
    ends[1].inward = losing("Set", count=2)
    with pytest.raises(Preempted):
        await group.apply({name: [layer(0, tone())] for name in "ab"})
    await asyncio.sleep(0.005)
    assert [ends[0].levels("a"), ends[1].levels("b")] == [[0.0, 0.0]] * 2
    assert (group.is_armed, group.is_set_incomplete) == (True, False)
    await group.apply({name: [layer(0, tone())] for name in "ab"})
    await group.beat()


@grouped(("a", "b"), wire="rtu")
async def test_status_on_a_late_line_is_not_cut_short(group: Group, ends: list[MemoryLine]) -> None:
    """A heartbeat waits for it: one that may reply again would else never be heard."""
    first, second = group.amplifiers.values()
    ends[0].outward = lambda name, data: [(0.02, data)]
    await second.ping()
    reading, feeding = first.read_status(Priority.READING), second.ping()
    await reading
    assert not feeding.done()
    await feeding


@in_virtual_time
async def test_copy_of_an_old_status_is_no_reply(wire: str) -> None:
    """All replies from before it was armed come once more, amid readings and heartbeats."""
    end, kept = MemoryLine(wire, "a"), list[bytes]()
    group, (host,) = await group_of(end, is_armed=False), end.hosts.values()
    end.outward = lambda name, data: kept.append(data) or unaltered(name, data)
    await host.read_status()
    await group.arm()
    end.outward = lambda name, data: [(0.004, data)]
    for request in (host.read_status, host.ping, host.read_status, group.beat):
        replying = asyncio.ensure_future(request())
        await asyncio.sleep(0.001)
        for data in kept:
            end.line.received(data)
        await replying
        assert host.status is not None
        assert host.status["state"] == STATES["OPERATION_ENABLED"]
    assert group.is_armed


@grouped(("a",), wire="serial")
async def test_set_that_plays_in_part_stops(group: Group, ends: list[MemoryLine]) -> None:
    """An amplifier that commits one of two layers says the token of the set all the same.

    The status that its commit returns is the first that contradicts, the next heartbeat's the last.
    """
    far = ends[0].far["a"].playback
    commit = far.commit

    def first_alone(layers: Sequence[LayerSet], token: int, time: float) -> None:
        commit(layers[:1], token, time)

    far.commit = first_alone  # type: ignore[method-assign]
    await group.apply({"a": [layer(0, tone()), layer(1, Tone(0, 150.0, 0.2))]})
    await asyncio.sleep(0.05)
    with pytest.raises(CommandRefused):
        await group.beat()
    assert (ends[0].levels("a"), group.is_armed) == ([0.0, 0.0], False)


@grouped(("a",), wire="serial")
async def test_listener_that_fails_loses_no_reply(group: Group, ends: list[MemoryLine]) -> None:
    """An event and the reply of the stop that caused it come in one read."""

    def fail(values: Values) -> None:
        raise RuntimeError("listener")

    group.amplifiers["a"].listeners.append(fail)
    assert (await group.stop())["a"].is_confirmed


@grouped(("a",), ("b",), wire="serial")
async def test_stop_over_a_lost_line_says_so_at_once(group: Group, ends: list[MemoryLine]) -> None:
    """Not after the time in which a reply could have come; the other amplifier is stopped."""
    ends[0].line.lose("cut")
    began = ends[0].loop.time()
    stopped = await group.stop()
    assert ends[0].loop.time() - began < 0.1
    assert (stopped["a"].is_confirmed, stopped["a"].cause) == (False, "cut")
    assert stopped["b"].is_confirmed


@grouped(("a",), ("b",), wire="serial")
async def test_exchange_that_is_aborted_is_no_fault(group: Group, ends: list[MemoryLine]) -> None:
    """A set that has no reply yet is given up at once; silence comes next, and all stay armed."""
    for end in ends:
        end.outward = lambda name, data: [(0.02, data)]
    applying = asyncio.ensure_future(group.apply({name: [layer(0, tone())] for name in "ab"}))
    await asyncio.sleep(0.03)  # staged, and the commits have no reply yet
    began = ends[0].loop.time()
    group.abort_exchange()
    with pytest.raises(Preempted):
        await applying
    assert (group.is_set_incomplete, group.is_armed) == (True, True)
    await group.silence(0.001)
    sent = min(at for at, each in ends[0].sent if each == "1:7")
    assert sent - began <= 0.0081
    assert (ends[0].levels("a"), ends[1].levels("b")) == ([0.0, 0.0], [0.0, 0.0])
    assert not group.is_set_incomplete


@grouped(("a",))
async def test_nothing_is_armed_by_what_a_stop_of_the_same_moment_overtakes(
    group: Group, ends: list[MemoryLine], wire: str
) -> None:
    """The stop comes between the call and the first request of it: no Arm goes out."""
    await group.disarm()
    ends[0].sent.clear()
    arming, stops = asyncio.ensure_future(group.arm()), list[Awaitable[object]]()
    ends[0].loop.call_soon(lambda: stops.append(group.stop()))
    with pytest.raises(DriverError):
        await arming
    await stops[0]
    assert "1:3" not in {each for _, each in ends[0].sent}


@grouped(("a",), wire="serial")
async def test_clear_comes_after_stops_alone(group: Group, ends: list[MemoryLine]) -> None:
    """It is refused while amplifiers are being stopped, and arming before it is."""
    stopping = asyncio.ensure_future(group.stop())
    await asyncio.sleep(0)
    with pytest.raises(Preempted):
        await group.clear()
    await stopping
    with pytest.raises(CommandRefused, match="cleared"):
        await group.arm()
    await group.clear()


@grouped(("a", "b"))
async def test_broadcast_may_have_fed_every_amplifier(
    group: Group, ends: list[MemoryLine], wire: str
) -> None:
    """How long each may play counts from the commit of both."""
    await asyncio.sleep(0.1)
    before = ends[0].loop.time()
    await group.apply({name: [layer(0, tone())] for name in "ab"})
    commit = max(at for at, each in ends[0].sent if each == "0:6") if wire != "tcp" else before
    assert all(each.feeding.may >= commit for each in group.amplifiers.values())
