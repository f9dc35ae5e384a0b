"""Heartbeats, repeated requests and statuses of a group on lines that are late or lose frames.

The host knows until when each amplifier may play. No late reply makes a sound amplifier contradict
its requests, and a faulty one is found.
"""

import asyncio
import random

import pytest

from drivers.errors import CommandRefused, LinkDegraded, LinkTimeout
from drivers.host.members import outcomes
from drivers.host.requests import Priority
from drivers.protocol.definition import FEATURES
from kit.clock import unaltered
from registry import threads
from tests.drivers.host.group_on_lines import (
    HALF,
    SILENT,
    Rig,
    begin,
    block_writes,
    connect,
    delay_randomly,
    in_turn,
    late,
    losing,
    lost,
    of_parts,
    on_wires,
    refuse,
    report,
)


@on_wires()
async def test_degraded_amplifier_is_neither_fed_nor_played(wire: str) -> None:
    """After three requests without a reply, only a status makes it usable again."""
    rig = await connect("a", wire=wire)
    host = rig.hosts["a"]
    rig.line.outward = lost
    with pytest.raises(LinkTimeout):
        await host.ping()

    with pytest.raises(LinkDegraded):
        await host.ping()
    with pytest.raises(LinkDegraded):
        await rig.play(0.5)

    rig.line.outward = late(0.0002)
    await host.read_status()
    await host.ping()


@on_wires("tcp")
async def test_amplifier_is_degraded_while_its_port_takes_nothing(wire: str) -> None:
    """Nothing new is played, but the line is not lost, and a reply ends it."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)

    block_writes(rig.line, 1, 2, 3)
    with pytest.raises(LinkTimeout, match="write blocked"):
        await rig.group.beat()
    assert rig.group.members.degraded == ("a",)

    block_writes(rig.line)
    await rig.hosts["a"].read_status()
    assert rig.group.members.degraded == ()

    block_writes(rig.line, 2)
    with pytest.raises(LinkTimeout, match="write blocked"):
        await rig.hosts["a"].read_status()
    assert rig.group.members.degraded == ("a",)
    assert rig.group.is_open
    assert await rig.stop() == {"a": True}


@on_wires()
async def test_only_the_group_feeds_the_watchdog(wire: str) -> None:
    """Heartbeats keep the amplifier playing; without them it is silent after 0.255 s."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    await rig.beat(20)
    assert rig.levels == {"a": HALF}

    await asyncio.sleep(0.256)

    assert rig.levels == {"a": SILENT}
    with pytest.raises(CommandRefused):
        await rig.group.beat()


@on_wires("serial")
async def test_mute_amplifier_does_not_delay_the_heartbeats_of_others(wire: str) -> None:
    """The other amplifier is fed within 10 ms, although replies are awaited for 30 ms."""
    rig = await connect("ab", wire=wire)

    def alter(_: str, data: bytes) -> list[tuple[float, bytes]]:
        address, _ = rig.line.kind.request_of(data)
        return [] if address == rig.hosts["a"].address else [(0.0, data)]

    rig.line.inward = alter
    with pytest.raises(LinkDegraded):
        await rig.group.beat()
    await asyncio.sleep(0.11)  # until the reading of its status is given up

    for _ in range(2):
        async with asyncio.timeout(0.01):
            await rig.group.beat()
        await asyncio.sleep(0.001)


@on_wires("serial")
async def test_heartbeat_waits_for_one_request_that_has_waited(wire: str) -> None:
    """Eight statuses of 20 ms each are queued for 50 ms: only one of them goes first."""
    rig = await connect("ab", wire=wire)
    rig.line.outward = late(0.02)
    readings = [await begin(rig.hosts["b"].read_status()) for _ in range(8)]
    await asyncio.sleep(0.065)

    async with asyncio.timeout(0.065):
        await rig.hosts["a"].ping()

    await asyncio.gather(*readings)


@on_wires()
async def test_request_that_waited_50_ms_precedes_newer_heartbeats(wire: str) -> None:
    """Another heartbeat is queued whenever one is answered; the reading still goes out."""
    rig = await connect("ab", wire=wire)
    rig.line.outward = late(0.004)

    async def feed() -> None:
        while True:
            await rig.hosts["a"].ping()

    feeding = [await begin(feed()) for _ in range(3)]
    await asyncio.sleep(0.01)
    rig.watch()

    async with asyncio.timeout(0.1):
        await rig.hosts["b"].read_status()

    assert rig.elapsed() >= 0.05
    for task in feeding:
        task.cancel()


@on_wires("serial")
async def test_heartbeat_waits_for_a_status_on_a_late_line(wire: str) -> None:
    """Otherwise an amplifier that replies again would never be heard."""
    rig = await connect("ab", wire=wire)
    rig.line.outward = late(0.02)
    await rig.hosts["b"].ping()
    reading = await begin(rig.hosts["a"].read_status(Priority.READING))
    heartbeat = await begin(rig.hosts["b"].ping())

    await reading

    assert not heartbeat.done()
    await heartbeat


@on_wires("serial")
async def test_late_reply_is_not_taken_for_the_next_request(wire: str) -> None:
    """A reply after 70 ms arrives while another request awaits its own, due after 20 ms."""
    rig = await connect("a", wire=wire)
    rig.line.outward = in_turn(0.07, 0.0002, 0.02, 0.0002)
    await rig.hosts["a"].ping()
    await asyncio.sleep(0.03)
    rig.watch()

    await rig.hosts["a"].ping()

    assert 0.02 <= rig.elapsed() <= 0.1
    assert rig.line.line.wire.counters.unexpected_frames == 1


@pytest.mark.parametrize(("baud", "attempts"), [(0, 3), (9600, 2)], ids=["fast", "slow"])
@on_wires("serial")
async def test_request_is_repeated_less_often_on_a_slow_line(
    wire: str, baud: int, attempts: int
) -> None:
    """A status of 41 bytes takes 43 ms at 9600 baud, more than the 30 ms of fast lines."""
    rig = await connect("a", wire=wire, baud=baud, watchdog=2.0, is_armed=False)
    rig.line.outward = lost
    rig.watch()

    with pytest.raises(LinkTimeout):
        await rig.hosts["a"].read_status()

    assert rig.requests() == ["a GetStatus"] * attempts
    counts = rig.hosts["a"].counts
    assert (counts.timeouts, counts.retries) == (attempts, attempts - 1)


@on_wires("serial")
async def test_statistics_count_frames_by_line_and_retries_by_amplifier(wire: str) -> None:
    """One of two amplifiers has a retry; both have 8 frames, of which one reply was lost."""
    rig = await connect("ab", wire=wire, is_armed=False)
    rig.line.outward = losing("GetStatus")

    await rig.hosts["a"].read_status()

    retried = rig.hosts["a"].statistics
    neighbor = rig.hosts["b"].statistics
    assert (retried.retries, retried.timeouts) == (1, 1)
    assert (neighbor.retries, neighbor.timeouts) == (0, 0)
    assert (retried.frames_out, retried.frames_in) == (8, 7)
    assert neighbor.frames_out == 8
    assert retried.last_round_trip == pytest.approx(0.0004, abs=1e-7)


@on_wires("serial")
async def test_busy_amplifier_is_asked_again_when_the_timer_is_early(wire: str) -> None:
    """On some systems a timer fires up to 16 ms early, here 4 ms."""
    rig = await connect("a", wire=wire)
    loop = rig.line.loop
    call_at = loop.call_at

    def early(when: float, *arguments: object, **options: object) -> asyncio.TimerHandle:
        is_distant = when - loop.time() > 0.0045
        return call_at(when - 0.004 if is_distant else when, *arguments, **options)

    loop.call_at = early
    refuse(rig.far["a"], "Ping", "BUSY", times=1)
    rig.watch()

    async with asyncio.timeout(0.1):
        await rig.group.beat()

    assert rig.requests().count("a Ping") == 2


@on_wires("tcp")
async def test_host_accounts_for_a_ping_that_the_network_delivers_late(wire: str) -> None:
    """The last of three attempts goes out at 60 ms and arrives at 260 ms, and feeds for 250 ms."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    rig.line.inward = late(0.2)
    rig.line.outward = lost
    rig.watch()

    heartbeat = await begin(rig.hosts["a"].ping())
    await asyncio.sleep(0.5)

    assert rig.levels == {"a": HALF}
    with pytest.raises(LinkTimeout):
        await heartbeat
    assert 0.515 <= rig.hosts["a"].feeding.may_play_until - rig.since <= 1.4
    await asyncio.sleep(0.02)
    assert rig.levels == {"a": SILENT}


@on_wires("can")
async def test_host_accounts_for_a_ping_that_a_can_adapter_kept(wire: str) -> None:
    """Of three pings the second arrives on time; the last, of 60 ms, is delivered at 0.27 s.

    The amplifier may play until two watchdogs of 0.25 s later, and is silent 15 ms after that.
    """
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    await rig.group.beat()
    pings: list[bytes] = []

    def keep(_: str, data: bytes) -> list[tuple[float, bytes]]:
        pings.append(data)
        return [(0.0002, data)] if len(pings) == 2 else []

    rig.line.inward = keep
    rig.line.outward = lost
    rig.watch()
    with pytest.raises(LinkTimeout):
        await rig.group.beat()
    await asyncio.sleep(0.27 - rig.elapsed())
    rig.line.arrives("Ping", pings[-1])

    await asyncio.sleep(0.24)

    assert rig.levels == {"a": HALF}
    may_play_for = rig.hosts["a"].feeding.may_play_until - rig.since
    assert 0.515 <= may_play_for <= 0.576
    await asyncio.sleep(0.576 - rig.elapsed())
    assert rig.levels == {"a": SILENT}


@on_wires()
async def test_commit_may_have_fed_every_amplifier_of_its_line(wire: str) -> None:
    """How long each may play counts from the commit, a broadcast except over TCP."""
    rig = await connect("ab", wire=wire)
    await asyncio.sleep(0.1)
    rig.watch()

    await rig.play(0.5)

    commit = "a Commit" if wire == "tcp" else "all Commit"
    committed_at = rig.since + rig.sent_after(commit)
    for name, host in rig.hosts.items():
        assert host.feeding.maybe_fed_at >= committed_at, name


@pytest.mark.parametrize("is_answered", [True, False], ids=["answered", "unanswered"])
@on_wires()
async def test_request_that_waits_on_a_busy_machine_contradicts_nothing(
    wire: str, is_answered: bool
) -> None:
    """A ping arrives 25 ms late; the two later statuses show a watchdog that has more left."""
    rig = await connect("a", wire=wire)
    host = rig.hosts["a"]
    rig.line.inward = late(0.025)
    if is_answered:
        await host.ping()
    else:
        rig.line.outward = lost
        with pytest.raises(LinkTimeout):
            await host.ping()
    rig.line.inward = rig.line.outward = unaltered

    await host.read_status()
    await asyncio.sleep(0.02)
    await host.read_status()


@on_wires()
async def test_contradicting_status_stops_when_it_is_repeated(wire: str) -> None:
    """Half of the level, on a derated channel, is passed over once; the second time is a fault."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    await asyncio.sleep(0.01)
    rig.far["a"].set_temperature(71.0, threads.now())
    await asyncio.sleep(0.03)
    await rig.group.beat()
    await asyncio.sleep(0.05)

    with pytest.raises(CommandRefused):
        await rig.group.beat()

    assert not rig.group.is_armed


@pytest.mark.parametrize(("share", "text"), [(0.0, "token of"), (0.5, "level of")])
@on_wires("serial")
async def test_weakened_layer_is_found_when_statuses_are_late(
    wire: str, share: float, text: str
) -> None:
    """A layer that is dropped or plays at half its level, by two statuses up to 14 ms late."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    delay_randomly(rig.line, random.Random(6))
    await asyncio.sleep(0.05)
    playback = rig.far["a"].playback
    if share:
        playback.scale(threads.now(), share, 0.0)
    else:
        playback.silence(threads.now(), 0.0)

    await asyncio.sleep(0.02)
    with pytest.raises(CommandRefused, match=text):
        await read_twice(rig)


async def read_twice(rig: Rig) -> None:
    """Read two statuses of the first amplifier, 20 ms apart."""
    await rig.hosts["a"].read_status()
    await asyncio.sleep(0.02)
    await rig.hosts["a"].read_status()


@on_wires("serial")
async def test_stuck_watchdog_is_found_between_frequent_sets(wire: str) -> None:
    """Ten sets per second feed it, each with a heartbeat that comes too early to tell."""
    rig = await connect("a", wire=wire)
    report(rig.far["a"], watchdog_left=250)

    with pytest.raises(CommandRefused, match="watchdog"):
        await play_and_beat(rig, times=10)


async def play_and_beat(rig: Rig, times: int) -> None:
    """Play a set and beat twice, in 0.1 s each time."""
    for _ in range(times):
        await rig.play(0.5)
        await rig.group.beat()
        await rig.beat(1)
        await asyncio.sleep(0.05)


@on_wires("serial")
async def test_measured_levels_may_differ_by_their_error(wire: str) -> None:
    """An error of 0.002 and a tolerance of 0.0002: 0.5 is measured as 0.4978, but not as 0.4977."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.far["a"].capabilities["features"] |= 1 << FEATURES["levels_measured"]
    await rig.group.open()
    await rig.group.arm()
    await rig.play(0.5)
    host = rig.hosts["a"]

    for level, count in ((4978, 0), (4977, 1)):
        await asyncio.sleep(0.02)
        report(rig.far["a"], levels=[level, 0])
        await host.ping()
        assert host.contradictions.count == count, level


@on_wires("serial")
async def test_half_of_an_exchange_is_a_clock_error_when_products_differ(wire: str) -> None:
    """The way out may take all or none of 0.4 ms, less the time of the bits.

    A single amplifier has no clock error.
    """
    rig = await connect("a", "b", wire=wire, is_armed=False)
    rig.far["b"].identity["product"] = "another"
    await rig.group.open()
    await rig.group.arm()

    await rig.beat(60)

    uncertainty = (0.4e-3 - rig.hosts["a"].exchange_time("GetStatus")) / 2
    assert min(rig.group.clock_errors.values()) >= uncertainty
    single = await connect("c", wire=wire)
    assert single.group.clock_errors == {"c": 0.0}


@pytest.mark.parametrize("request_count", [1, 2])
async def test_cancelled_request_is_an_outcome_and_a_cancelled_caller_is_not(
    request_count: int,
) -> None:
    """A lost request cannot end what stops or disarms; who gives up waiting ends immediately."""
    loop = asyncio.get_running_loop()
    lost_requests: list[asyncio.Future[None]] = [loop.create_future() for _ in range(request_count)]
    for request in lost_requests:
        request.cancel()
    endless_requests: list[asyncio.Future[None]] = [
        loop.create_future() for _ in range(request_count)
    ]
    waiting = asyncio.ensure_future(outcomes(endless_requests))
    await asyncio.sleep(0)  # until it waits

    results = await outcomes(lost_requests)
    waiting.cancel()
    await asyncio.wait({waiting})

    assert [type(result) for result in results] == [asyncio.CancelledError] * request_count
    assert waiting.cancelled()


@on_wires("serial", "rtu", "can")
async def test_set_whose_caller_is_cancelled_does_not_play(wire: str) -> None:
    """Its parts that were not sent yet are dropped, so that the amplifier never has all of it."""
    rig = await connect("a", wire=wire, baud=115_200 if wire == "serial" else 0)
    playing = await begin(rig.apply(*of_parts(3)))
    await asyncio.sleep(0)

    playing.cancel()
    await asyncio.wait({playing})
    await asyncio.sleep(0.1)

    assert playing.cancelled()
    assert rig.levels == {"a": SILENT}
