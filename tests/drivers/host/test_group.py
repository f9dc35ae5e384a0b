"""Lines, amplifiers and their group on every kind of wire of protocol 4, in virtual time.

What a person would feel is read from the simulated amplifiers themselves. Also times of a line: how
long its bits take, what is late, what a delay of this process costs, and sets of which a tenth of
all frames is lost.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Sequence

import pytest

from drivers.errors import DriverError, LinkError, LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.line import Priority
from drivers.playing import AmplifierLayer
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope, LayerSet
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from virtual_lines import (
    KINDS,
    MemoryLine,
    delayed,
    group_of,
    grouped,
    in_virtual_time,
    layer,
    of_parts,
    run_virtual,
    tone,
    unaltered,
)


@grouped(*map(tuple, "abcdefgh"), wire="serial")
async def test_lines_come_in_the_order_of_the_amplifiers(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Not by where they are in memory: runs of one random seed send the same bytes."""
    assert [*group.members.lines] == [end.line for end in ends]


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


LOST = 0.1  # of the frames, either way


LINES = {
    "one": (("a",),),
    "one line of two": (("a", "b"),),
    "two lines": (("a",), ("b",)),
}


async def _play(kind: str, lines: str, rng: random.Random, count: int) -> list[str]:
    """Play so many sets while frames are lost; returns what was wrong."""
    ends = [MemoryLine(kind, *names) for names in LINES[lines]]
    group = await group_of(*ends, watchdog=2.0, draw=rng.randint)
    far = {name: each for end in ends for name, each in end.far.items()}
    found, committed = list[str](), dict[tuple[str, int], Sequence[LayerSet]]()

    def noted(name: str) -> None:
        commit = far[name].playback.commit

        def note(layers: Sequence[LayerSet], token: int, time: float) -> None:
            if (name, token) in committed:
                found.append(f"{name} plays {token} twice")
            committed[name, token] = layers
            commit(layers, token, time)

        far[name].playback.commit = note  # type: ignore[method-assign]

    def losing(name: str, data: bytes) -> list[tuple[float, bytes]]:
        return [] if rng.random() < LOST else unaltered(name, data)

    for name in far:
        noted(name)
    played_sets = 0
    for _ in range(count):
        layers = of_parts(rng.randint(1, 8), rng.uniform(0.02, 0.06))
        for end in ends:
            end.inward = end.outward = losing
        result = None
        with contextlib.suppress(DriverError):
            result = await group.apply(dict.fromkeys(far, layers))
        for end in ends:
            end.inward = end.outward = unaltered
        await asyncio.sleep(0.05)
        for each in far.values():
            each.tick(ends[0].loop.time())
        token = group.sets.token
        for name in far:
            words = committed.get((name, token))
            if words is not None and len(words) != len(layers):
                found.append(f"{name} plays {token} in part")
            if result is not None and words != result.layers[name]:
                found.append(f"{name} does not play {token}, though it is said")
        played_sets += result is not None
        await _recovered(group)
    if played_sets < 0.6 * count:  # of the rest it is said, as of 8 parts on Modbus RTU
        found.append(f"{played_sets} of {count} sets play")
    return found


async def _recovered(group: Group) -> None:
    """Read all amplifiers, and arm them again where they were stopped."""
    await group.statuses()
    if not group.is_armed:
        await group.clear()
        await group.arm()
    await group.silence(0.001)
    await asyncio.sleep(0.15)  # what was late has faded


CASES = [
    pytest.param(
        *(kind, lines, count),
        marks=pytest.mark.long if count > 40 or lines == "one line of two" else [],
    )
    for count in (40, 6700)
    for kind in KINDS
    for lines in LINES
]


@pytest.mark.parametrize(("kind", "lines", "count"), CASES)
def test_sets_play_whole_and_once_though_frames_are_lost(kind: str, lines: str, count: int) -> None:
    """One frame of ten either way, of sets of 1 to 8 parts; the long form: 20 000 on each wire."""
    rng = random.Random(count)
    assert run_virtual(_play(kind, lines, rng, count), rng=rng) == []


@grouped(("a", "b"), wire="rtu")
async def test_one_reply_is_due_at_a_time_where_two_share_a_line(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Each frame but a broadcast has a response, which comes before the next frame is sent."""
    (end,) = ends
    received, due, most = end.line.received, 0, 0

    def sent(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal due, most
        due += data[0] > 0
        most = max(most, due)
        return unaltered(name, data)

    def taken(data: bytes) -> None:
        nonlocal due
        due -= 1
        received(data)

    end.inward = sent
    end.line.received = taken  # type: ignore[method-assign]
    await group.apply(dict.fromkeys("ab", of_parts(3)))
    await group.beat()
    assert (due, most) == (0, 1)


PULSE = tone(level=0.0, onset=Envelope(100, ((3000, 0), (3000, 0))))  # over after 30 ms


ENDING: dict[str, tuple[Sequence[AmplifierLayer], AmplifierLayer | None]] = {
    "a pulse": ([layer(0, PULSE)], None),
    "its time": ([layer(0, tone(ending=Envelope(50, ((8000, 0),))), valid_for=0.04)], None),
    "what waited": (
        [layer(0, PULSE), layer(1, tone(1, 0.1))],
        layer(0, tone(level=0.4), after=True, valid_for=0.02),
    ),
    "a renewal": ([layer(0, tone(), valid_for=0.04)], layer(0, renew=True, valid_for=1.0)),
}
"""Layers that end within 40 ms, and one that follows; a renewal that comes about then."""


@pytest.mark.parametrize("ends_by", ENDING)
@in_virtual_time
async def test_what_ends_amid_an_exchange_may_be_shown_or_not(ends_by: str) -> None:
    """Up to 14 ms out, and back: a status may show the layer and its level, whenever it is read."""
    rng, end, shown = random.Random(5), MemoryLine("serial", "a"), set[bool]()
    group = await group_of(end, watchdog=2.0)
    host, (layers, following) = group.amplifiers["a"], ENDING[ends_by]
    for _ in range(60):
        await group.apply({"a": layers})
        if ends_by == "a renewal":
            delayed(end, rng)
            await asyncio.sleep(rng.uniform(0.02, 0.045))
        if following:
            await group.apply({"a": [following]})
        delayed(end, rng)
        for _ in range(4):
            await asyncio.sleep(rng.uniform(0.0, 0.02))
            shown.add((await host.read_status())["tokens"][0] > 0)
            assert host._contradictions == 0
        end.inward = end.outward = unaltered
        await group.silence(0.0)
        await asyncio.sleep(0.1)
    assert shown == {False, True}


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
