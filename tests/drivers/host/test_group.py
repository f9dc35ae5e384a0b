"""Lines, amplifiers and their group on every kind of wire of protocol 4, in virtual time.

What a person would feel is read from the simulated amplifiers themselves. Also times of a line: how
long its bits take, what is late, and what a delay of this process costs.
"""

import asyncio
from collections.abc import Callable

import pytest

from drivers.errors import DriverError, LinkError, LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.ledger import SILENCING
from drivers.host.line import Priority
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from virtual_lines import (
    MemoryLine,
    group_of,
    grouped,
    in_virtual_time,
    layer,
    tone,
)


@grouped(*map(tuple, "abcdefgh"), wire="serial")
async def test_lines_come_in_the_order_of_the_amplifiers(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Not by where they are in memory: runs of one random seed send the same bytes."""
    assert [*group.members.lines] == [end.line for end in ends]


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


REACTION = 0.0099  # s; a reply may begin 10 ms after its request (decision 0088)


class Paced:
    """A line whose frames take as long as their characters, one after the other.

    bits: of a character; gap [s]: before each frame; collisions: frames of the host that were sent
    while a reply was on its way.
    """

    def __init__(self, end: MemoryLine, baud: int, bits: int, gap: float) -> None:
        self._end, self._character, self._gap = end, bits / baud, gap
        self._free = self._reply_until = 0.0
        self.reaction = REACTION
        self.collisions = 0
        end.inward, end.outward = self._inward, self._outward

    def _inward(self, name: str, data: bytes) -> list[tuple[float, bytes]]:
        now = self._end.loop.time()
        self.collisions += now < self._reply_until
        return self._sent(now, data)

    def _outward(self, name: str, data: bytes) -> list[tuple[float, bytes]]:
        now = self._end.loop.time()
        delay, data = self._sent(now + self.reaction, data)[0]
        self._reply_until = self._free
        return [(delay + self.reaction, data)]

    def _sent(self, now: float, data: bytes) -> list[tuple[float, bytes]]:
        self._free = max(now, self._free) + self._gap + len(data) * self._character
        return [(self._free - now, data)]


def rtu(baud: int) -> tuple[str, Callable[[], Wire], int, float]:
    """A kind of line, its wire, bits of a character and silence [s] before each frame."""
    silence = max(3.5 * 11 / baud, 0.00175)  # Modbus over serial line V1.02, 2.5.1.1
    return "rtu", lambda: ModbusWire(baud, is_rtu=True, number=0), 11, silence


def serial(baud: int) -> tuple[str, Callable[[], Wire], int, float]:
    """The same of the project's own frames."""
    return "serial", lambda: SerialWire(baud, sequence=0), 10, 0.0


TIMED_LINES = {
    **{f"rtu at {baud}": rtu(baud) for baud in (9600, 19_200, 38_400, 57_600, 115_200)},
    **{f"serial at {baud}": serial(baud) for baud in (9600, 19_200, 115_200)},
}


async def armed(name: str, *amplifiers: str) -> tuple[Group, MemoryLine, Paced]:
    """An armed group on one line with the times of its characters."""
    kind, make, bits, gap = TIMED_LINES[name]
    end = MemoryLine(kind, *amplifiers, wire=make())
    paced = Paced(end, int(name.split()[-1]), bits, gap)
    return await group_of(end, watchdog=2.0), end, paced


@pytest.mark.parametrize("name", TIMED_LINES)
@in_virtual_time
async def test_replies_that_begin_as_late_as_they_may_are_awaited(name: str) -> None:
    """9.9 ms after each request, on Modbus after write and read: nothing is repeated."""
    group, end, _ = await armed(name, "a")
    onset = Envelope(20, ((100, 0),) * 8)
    await group.apply({"a": [layer(0, tone(onset=onset), tone(1))]})
    await group.beat()
    assert end.retries == 0


@pytest.mark.parametrize("name", [name for name in TIMED_LINES if "115" not in name])
@in_virtual_time
async def test_time_of_a_broadcast_is_no_time_of_the_next_reply(name: str) -> None:
    """The status behind the commit of two is awaited longer, and a stop keeps off its reply."""
    group, end, paced = await armed(name, "a", "b")
    for level in (0.5, 0.4):
        await group.apply({each: [layer(0, tone(level=level))] for each in "ab"})
    assert end.retries == 0
    assert (end.levels("a"), end.levels("b")) == ([0.4, 0.0], [0.4, 0.0])
    if not name.startswith("rtu"):  # the others have a wire for each direction
        return
    paced.collisions, paced.reaction = 0, 0.0079  # a stop waits for 8 ms
    applying = asyncio.ensure_future(group.apply({each: [layer(0, tone())] for each in "ab"}))
    for _ in range(1000):
        await asyncio.sleep(0.0005)
        if end.sent[-2][1] == "0:6":
            break
    stopped = await group.stop()
    assert all(each.is_confirmed for each in stopped.values())
    with pytest.raises(DriverError):
        await applying
    assert paced.collisions == 0


@in_virtual_time
async def test_amplifier_may_play_until_what_is_under_way_has_arrived() -> None:
    """A set of 200 bytes takes 0.2 s at 9600 baud, and feeds the watchdog when it has arrived."""
    group, end, _ = await armed("serial at 9600", "a")
    await group.apply({"a": [layer(0, tone())]})
    end.outward = lambda name, data: []
    onset = Envelope(20, ((100, 0),) * 30)
    tones = [tone(channel=1, level=0.1, onset=onset)] * 2
    with pytest.raises(LinkTimeout):
        await group.apply({"a": [layer(number, each) for number, each in enumerate(tones, 1)]})
    await asyncio.sleep(group.amplifiers["a"].feeding.may_play_until - end.loop.time() - 0.1)
    assert end.levels("a")[0] > 0.3
    await asyncio.sleep(0.1)
    assert end.levels("a") == [0.0, 0.0]


@grouped(("a",), wire="can")
async def test_frames_that_a_can_adapter_has_kept_feed_once_more(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Of three pings the second arrives; the last when the watchdog has nearly passed."""
    (end,) = ends
    await group.apply({"a": [layer(0, tone())]})
    await group.beat()
    end.sent.clear()
    frames: list[bytes] = []

    def keep_the_last(name: str, data: bytes) -> list[tuple[float, bytes]]:
        frames.append(data)
        return [(0.0002, data)] if len(frames) == 2 else []

    end.inward = keep_the_last
    end.outward = lambda name, data: []
    with pytest.raises(LinkTimeout):
        await group.beat()
    _, (fed, _), (last, _) = end.sent
    await asyncio.sleep(fed + 0.24 - end.loop.time())
    end.later(0.0, end._arrived, "Ping", b"".join(frames[2:]))
    await asyncio.sleep(0.24)
    assert end.levels("a") == [0.5, 0.0]
    until = group.amplifiers["a"].feeding.may_play_until
    assert until <= last + 0.001 + 2 * 0.25 + SILENCING
    await asyncio.sleep(until - end.loop.time())
    assert end.levels("a") == [0.0, 0.0]


@pytest.mark.parametrize("wire", ["serial", "tcp", "can"])
@pytest.mark.parametrize("missed", [(0.001, 0.028), (0.012, 0.015), (0.001, 0.5)])
@grouped(("a",))
async def test_time_that_this_process_misses_is_no_time_of_the_amplifier(
    group: Group, ends: list[MemoryLine], missed: tuple[float, float]
) -> None:
    """From a moment [s] after a request on for a time: a reply of 8 ms then is no timeout."""
    (end,) = ends
    after, lasts = missed
    end.outward = lambda name, data: [(0.008 if after < 0.008 else 0.016, data)]

    def stand_still() -> None:
        """The amplifier runs in the same process, so that it does not reply meanwhile."""
        timers = [each for each in end.loop._scheduled if not each.cancelled()]  # type: ignore[attr-defined]
        for each in timers:
            if each._callback in (end._arrived, end.line.received):
                end.loop.call_at(each.when() + lasts, each._callback, *each._args)
                each.cancel()
        end.loop.now += lasts  # type: ignore[attr-defined]

    end.loop.call_later(after, stand_still)
    await group.amplifiers["a"].read_status()
    assert end.retries == 0


@grouped(("a",), wire="serial")
async def test_reply_that_never_comes_to_a_process_that_is_often_delayed_is_given_up(
    group: Group, ends: list[MemoryLine]
) -> None:
    """By 30 ms each 31 ms: after four delays, and a look or two at the port, for each attempt."""
    (end,) = ends
    end.outward = lambda name, data: []

    async def stall() -> None:
        while True:
            end.loop.now += 0.03  # type: ignore[attr-defined]
            await asyncio.sleep(0.001)

    stalling = asyncio.ensure_future(stall())
    began = end.loop.time()
    with pytest.raises(LinkTimeout, match="no reply"):
        async with asyncio.timeout(2.0):
            await group.amplifiers["a"].read_status()
    assert end.loop.time() - began < 3 * 8 * 0.031
    stalling.cancel()
