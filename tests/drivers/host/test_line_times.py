"""Times of a line: how long its bits take, what is late, and what a delay of this process costs."""

import asyncio
from collections.abc import Callable

import pytest

from drivers.errors import DriverError, LinkTimeout
from drivers.host.dialogue import SILENCING
from drivers.host.group import Group
from drivers.playing import Layer
from drivers.protocol.sets import Envelope
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from virtual_lines import KINDS, MemoryLine, group_of, grouped, in_virtual_time, layer, tone

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


LINES = {
    **{f"rtu at {baud}": rtu(baud) for baud in (9600, 19_200, 38_400, 57_600, 115_200)},
    **{f"serial at {baud}": serial(baud) for baud in (9600, 19_200, 115_200)},
}


async def armed(name: str, *amplifiers: str) -> tuple[Group, MemoryLine, Paced]:
    """An armed group on one line with the times of its characters."""
    kind, make, bits, gap = LINES[name]
    end = MemoryLine(kind, *amplifiers, wire=make())
    paced = Paced(end, int(name.split()[-1]), bits, gap)
    return await group_of(end, watchdog=2.0), end, paced


@pytest.mark.parametrize("name", LINES)
@in_virtual_time
async def test_replies_that_begin_as_late_as_they_may_are_awaited(name: str) -> None:
    """9.9 ms after each request, on Modbus after write and read: nothing is repeated."""
    group, end, _ = await armed(name, "a")
    onset = Envelope(20, ((100, 0),) * 8)
    await group.apply({"a": [layer(0, tone(onset=onset), tone(1))]})
    await group.beat()
    assert end.retries == 0


@pytest.mark.parametrize("name", [name for name in LINES if "115" not in name])
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


@grouped(("a",), wire="tcp")
async def test_port_that_takes_nothing_leaves_an_amplifier_degraded(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing new is played, its line is not lost, and it counts again once it replies."""
    (end,) = ends

    def block(data: bytes) -> None:
        raise LinkTimeout("write blocked; check the network")

    await group.apply({"a": [layer(0, tone())]})
    with monkeypatch.context() as blocked:
        blocked.setattr(end, "write", block)
        with pytest.raises(LinkTimeout, match="write blocked"):
            await group.beat()
        assert group.members.degraded == ("a",)
    write, count = end.write, 0

    def block_the_read(data: bytes) -> None:
        nonlocal count
        count += 1
        if count == 2:
            block(data)
        write(data)

    await group.amplifiers["a"].read_status()
    assert not group.members.degraded
    with monkeypatch.context() as blocked:
        blocked.setattr(end, "write", block_the_read)
        with pytest.raises(LinkTimeout, match="write blocked"):
            await group.amplifiers["a"].read_status()
        assert group.members.degraded == ("a",)
        assert end.line.loss is None
    assert (await group.stop())["a"].is_confirmed


@pytest.mark.parametrize("wire", KINDS)
@grouped(("a", "b"))
async def test_commit_of_a_set_that_is_given_up_is_not_sent(
    group: Group, ends: list[MemoryLine]
) -> None:
    """It waits behind a reading of the line that two amplifiers share."""
    (end,) = ends
    await group.apply({each: [layer(0, tone())] for each in "ab"})
    applying = asyncio.ensure_future(
        group.apply({each: [Layer(0, (tone(level=0.3),), 0.001)] for each in "ab"})
    )
    end.outward = lambda name, data: [(0.02 if name == "GetStatus" else 0.0002, data)]
    for _ in range(1000):
        await asyncio.sleep(0.0001)
        if end.sent[-1][1] == "2:5":
            break
    reading = asyncio.ensure_future(group.amplifiers["a"].read_status())
    await asyncio.sleep(0.005)
    end.sent.clear()
    group.abort_exchange()
    with pytest.raises(DriverError):
        await applying
    await reading
    await asyncio.sleep(0.01)
    assert end.sent == []
    assert (end.levels("a"), end.levels("b")) == ([0.5, 0.0], [0.5, 0.0])
