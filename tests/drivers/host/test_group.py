"""Lines, amplifiers and their group on every kind of wire of protocol 4, in virtual time.

What a person would feel is read from the simulated amplifiers themselves.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Sequence

import pytest

from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkError,
)
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.line import Priority
from drivers.playing import Tone
from drivers.protocol.definition import MESSAGES, STATES
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.wires.wire import Broken
from virtual_lines import (
    MemoryLine,
    group_of,
    grouped,
    in_virtual_time,
    layer,
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
        await asyncio.sleep(0.01)
        for end in ends:
            assert all(end.levels(name) == [0.7, 0.1] for name in end.hosts)
        origins = [
            {round(voice.began, 4) for voice in far.playback.all_voices[1]}
            for end in ends
            for far in end.far.values()
        ]
        assert all(each == origins[0] and len(each) == 1 for each in origins)
        await group.apply({name: [layer(0)] for name in names})
        await asyncio.sleep(0.01)
        assert all(end.levels(name) == [0.2, 0.1] for end in ends for name in end.hosts)
        assert all(end.retries == 0 for end in ends)
        assert all(end.line.wire.counters.unexpected_frames == 0 for end in ends)

    with_group(test, wire, *LINES[lines])


@grouped(*map(tuple, "abcdefgh"), wire="serial")
async def test_lines_come_in_the_order_of_the_amplifiers(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Not by where they are in memory: runs of one random seed send the same bytes."""
    assert [*group.members.lines] == [end.line for end in ends]


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


@in_virtual_time
async def test_host_that_drives_already_is_seen_and_left_alone(wire: str) -> None:
    """Its heartbeats raise the watchdog unasked; without them the amplifier is taken over."""
    end = MemoryLine(wire, "a")
    far = end.far["a"]
    far.handle("Arm", {"session": 5, "watchdog": 2000, "shift": 0}, end.loop.time())

    async def feed() -> None:
        while True:
            await asyncio.sleep(0.07)
            far.handle("Ping", {"session": 5, "rate": 0}, end.loop.time())

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


@grouped(("a",), wire="serial")
async def test_set_that_plays_in_part_stops(group: Group, ends: list[MemoryLine]) -> None:
    """An amplifier that commits one of two layers says the token of the set all the same.

    The status of a heartbeat is the first that contradicts, that of the next one the last.
    """
    far = ends[0].far["a"].playback
    commit = far.commit

    def first_alone(layers: Sequence[LayerSet], token: int, time: float) -> None:
        commit(layers[:1], token, time)

    far.commit = first_alone  # type: ignore[method-assign]
    await group.apply({"a": [layer(0, tone()), layer(1, Tone(0, 150.0, 0.2))]})
    await group.beat()
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


@grouped(("a", "b"), wire="serial")
async def test_status_on_a_late_line_is_not_cut_short(group: Group, ends: list[MemoryLine]) -> None:
    """A heartbeat waits for it: one that may reply again would else never be heard."""
    first, second = group.amplifiers.values()
    ends[0].outward = lambda name, data: [(0.02, data)]
    await second.ping()
    reading, feeding = first.read_status(Priority.READING), second.ping()
    await reading
    assert not feeding.done()
    await feeding
