"""Lines, amplifiers and their group on every kind of wire of protocol 4, in virtual time.

What a person would feel is read from the simulated amplifiers themselves. Times of a line: how long
its bits take, what is late, what a delay of this process costs, sets of which a tenth of all frames
is lost. Commits and stops over several lines, whatever happens to frames on the way; and no path of
the source leads from the controller to a wire past the ledger.
"""

import ast
import asyncio
import contextlib
import logging
import math
import os
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

import drivers
from drivers.errors import DriverError, LinkTimeout
from drivers.host.group import Group
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import MESSAGES
from drivers.protocol.sets import Envelope
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from group_stops import LINES as STOPPED_LINES
from group_stops import PER_CHAIN, PROGRAMMES, Tally
from group_stops import play as play_stops
from kit.chain import set_running
from kit.clock import (
    KINDS,
    MemoryLine,
    delayed,
    group_of,
    grouped,
    in_virtual_time,
    layer,
    of_parts,
    tone,
    unaltered,
)
from kit.courses import Acted
from late_taps import AMPLIFIERS
from late_taps import WIRES as LATE_WIRES
from late_taps import play as play_late_taps
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal


class Paced:
    """A line whose frames take as long as their characters, one after the other.

    character, gap [s]: of each, and before each frame; collisions: frames of the host that were
    sent while a reply was on its way.
    """

    def __init__(self, end: MemoryLine, character: float, gap: float) -> None:
        self._end, self._character, self._gap = end, character, gap
        self._free = self._reply_until = 0.0
        self.reaction = 0.0099  # s; a reply may begin 10 ms after its request (protocol page)
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


TIMED_LINES = [
    *(f"rtu at {baud}" for baud in (9600, 19_200, 38_400, 57_600, 115_200)),
    *(f"serial at {baud}" for baud in (9600, 19_200, 115_200)),
]


async def armed(name: str, *amplifiers: str) -> tuple[Group, MemoryLine, Paced]:
    """An armed group on one line with the times of its characters, of 11 bits on RTU or of 10."""
    kind, baud = name.split()[0], int(name.split()[-1])
    if kind == "serial":
        end = MemoryLine(kind, *amplifiers, wire=SerialWire(baud, sequence=0))
        paced = Paced(end, 10 / baud, 0.0)
    else:
        end = MemoryLine(kind, *amplifiers, wire=ModbusWire(baud, is_rtu=True, number=0))
        # The silence of Modbus over serial line V1.02, 2.5.1.1.
        paced = Paced(end, 11 / baud, max(3.5 * 11 / baud, 0.00175))
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


LINES = {
    "one": (("a",),),
    "one line of two": (("a", "b"),),
    "two lines": (("a",), ("b",)),
}


@pytest.mark.parametrize(
    ("kind", "lines", "count"),
    [
        pytest.param(
            *(kind, lines, count),
            marks=pytest.mark.long if count > 40 or lines == "one line of two" else [],
        )
        for count in (40, 6700)
        for kind in KINDS
        for lines in LINES
    ],
)
@in_virtual_time
async def test_sets_play_whole_and_once_though_frames_are_lost(
    kind: str, lines: str, count: int
) -> None:
    """One frame of ten either way, of sets of 1 to 8 parts; the long form: 20 000 on each wire.

    No set plays twice, in part, or not although it is said to.
    """
    rng, committed = random.Random(count), defaultdict[tuple[str, int], list[Any]](list)
    ends = [MemoryLine(kind, *names) for names in LINES[lines]]
    group = await group_of(*ends, watchdog=2.0, draw=rng.randint)
    far = {name: each for end in ends for name, each in end.far.items()}

    def note(name: str, commit: Callable[..., None], layers: Any, token: int, at: float) -> None:
        committed[name, token].append(layers)
        commit(layers, token, at)

    def losing(name: str, data: bytes) -> list[tuple[float, bytes]]:
        return [] if rng.random() < 0.1 else unaltered(name, data)

    for name, each in far.items():
        each.playback.commit = partial(note, name, each.playback.commit)
    played_sets = 0
    for _ in range(count):
        layers, result = of_parts(rng.randint(1, 8), rng.uniform(0.02, 0.06)), None
        for end in ends:
            end.inward = end.outward = losing
        with contextlib.suppress(DriverError):
            result = await group.apply(dict.fromkeys(far, layers))
        for end in ends:
            end.inward = end.outward = unaltered
        await asyncio.sleep(0.05)
        assert [end.levels(name) for end in ends for name in end.far]  # lets happen what is due
        for name in far:
            plays = committed[name, group.sets.token]
            assert {len(words) for words in plays} <= {len(layers)}
            assert result is None or plays == [result.layers[name]]
        played_sets += result is not None
        await group.statuses()
        if not group.is_armed:
            await group.clear()
            await group.arm()
        await group.silence(0.001)
        await asyncio.sleep(0.15)  # what was late has faded
    assert max(map(len, committed.values())) == 1
    assert played_sets >= 0.6 * count  # of the rest it is said, as of 8 parts on Modbus RTU


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
            assert host.contradictions.count == 0
        end.inward = end.outward = unaltered
        await group.silence(0.0)
        await asyncio.sleep(0.1)
    assert shown == {False, True}


@grouped(("a",), wire="serial")
async def test_arming_again_uses_another_session(group: Group, ends: list[MemoryLine]) -> None:
    """Even if the same number is drawn; an amplifier refuses the session that it held last."""
    await group.disarm()
    await group.arm()
    assert group.is_armed


@pytest.mark.parametrize("what", ["cables", "replies"])
@pytest.mark.parametrize("wire", KINDS)
@grouped(("a",), ("b",))
async def test_lines_that_are_exchanged_while_armed_are_silenced(
    group: Group, ends: list[MemoryLine], wire: str, what: str
) -> None:
    """Each amplifier refuses the other's session, and a line takes no reply to the other's request.

    Both are at address 1, alike and silent, so that no status contradicts what was sent.
    """
    first, second = ends
    if what == "cables":
        first.far_end, second.far_end = (
            one.kind.far_end({1: far}, one.send)
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


# By hand, of what is written: bytes of ten bits; of eleven after 3.5 characters; CAN frames of at
# most 111 bits and 24 stuffed, of which each is packed with a head.
SPEEDS: dict[str, tuple[str, Callable[[], Wire], Callable[[bytes], float]]] = {
    "slow serial": ("serial", lambda: SerialWire(19_200, sequence=0), lambda d: len(d) / 1920),
    "serial": ("serial", lambda: SerialWire(921_600, sequence=0), lambda d: len(d) / 92_160),
    "rtu": (
        "rtu",
        lambda: ModbusWire(19_200, is_rtu=True, number=0),
        lambda d: 11 * (len(d) + 3.5) / 19_200,
    ),
    "tcp": ("tcp", lambda: ModbusWire(0, is_rtu=False, number=0), lambda _: 0.0),
    "slow can": (
        "can",
        lambda: CanWire(20_000, sequence=0),
        lambda d: 135 * len(unpack_frames(d)) / 20_000,
    ),
}
STATUS, COMMIT = (f"1:{MESSAGES[name].number}" for name in ("GetStatus", "Commit"))


@pytest.mark.parametrize("names", [*combinations(SPEEDS, 2)], ids="-".join)
@in_virtual_time
async def test_sets_start_together_on_lines_of_any_speed_that_are_busy(
    names: tuple[str, str],
) -> None:
    """Just armed: within a step of the shift. 3 s later: within 1 us, as their amplifiers state.

    With crystals of +40 and -40 ppm, bytes that take 0.2 ms longer than their bits, and a status
    under way whose reply takes 9 ms. No clock is read before the commit, which would wait for it.
    """
    ends: list[MemoryLine] = []
    for name, each, error in zip(names, "ab", (40e-6, -40e-6), strict=True):
        kind, wire, takes = SPEEDS[name]
        end = MemoryLine(kind, each, wire=wire())
        end.inward = end.outward = lambda _, data, takes=takes: [(takes(data) + 0.0002, data)]
        end.far[each].clock = AmplifierClock(Crystal(error), since=end.loop.time())
        ends.append(end)
    group, outward = await group_of(*ends, watchdog=1.0), ends[1].outward

    async def apart() -> float:
        """By how much the starts of a set are apart [s]."""
        ends[1].outward = lambda name, data: (
            [(0.009, data)] if name == "GetStatus" else outward(name, data)
        )
        ends[0].sent.clear()
        applying = asyncio.ensure_future(
            group.apply({name: [layer(0, tone())] for name in group.amplifiers})
        )
        await asyncio.sleep(0.0005)
        await group.amplifiers["b"].read_status()
        await applying
        ends[1].outward = outward
        sent = [each for _, each in ends[0].sent]
        assert sent.index(COMMIT) < (sent.index(STATUS) if STATUS in sent else math.inf)
        await asyncio.sleep(0.02)
        assert all(end.levels() for end in ends)  # which lets happen what is due
        (first,), (second,) = (
            far.playback.all_voices[0] for end in ends for far in end.far.values()
        )
        await group.silence(0.0)
        return abs(first.began - second.began)

    assert await apart() < 305e-6
    for _ in range(60):
        await asyncio.sleep(0.05)
        await group.beat()
    assert await apart() < 1e-6


_FOUND = [("modbus", 3, 12), ("modbus", 3, 64)]
"""Three on a line that were not fed in time; one that replied again and was not heard."""


@pytest.mark.parametrize(
    ("wire", "amplifiers", "seed"),
    [
        pytest.param(
            *row,
            marks=[]
            if row in (("modbus", 1, 1), ("serial", 3, 1), ("can", 1, 1), _FOUND[0])
            else pytest.mark.long,
        )
        for row in [*((wire, count, 1) for wire in LATE_WIRES for count in AMPLIFIERS), *_FOUND]
    ],
)
def test_late_frames_are_no_fault(wire: str, amplifiers: int, seed: int) -> None:
    """Up to 16 ms either way: nothing is wrong, and each click that was not played is counted.

    But for some that come while all is disarmed. On one amplifier, in one exchange, all may be.
    """
    counts = play_late_taps(wire, amplifiers, seed)
    taps, played, too_late = map(counts.pop, ("taps", "played", "too late"))
    assert not counts - Counter(["clicks"] * taps)
    assert too_late > 0 or amplifiers == 1
    assert played + too_late >= 0.9 * taps


@in_virtual_time
async def test_watchdog_that_stands_still_is_found_where_replies_are_late() -> None:
    """On a line that amplifiers share, where one commit feeds all of them before each in turn."""
    async with set_running("a", "b", of=Acted, wire="modbus-rtu") as chain:
        chain.host_rules.disturb()  # a status goes before what feeds
        chain.delays(0.012)
        await chain.holds(1.0, "finger")
        assert chain.controller.group.is_armed
        chain.answer("GetStatus", watchdog_left=250)
        await chain.holds(3.0, "finger")
        assert not chain.controller.group.is_armed


STOPS, FIRST = (int(os.environ.get(name, value)) for name, value in (("STOPS", 84), ("FIRST", 0)))


@pytest.fixture
def unlogged() -> Iterator[None]:
    """Losses and planted exceptions are logged by the thousand."""
    logger = logging.getLogger("drivers")
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(logging.NOTSET)


@pytest.mark.parametrize(
    ("programme", "share", "least"),
    [*zip(PROGRAMMES, (PER_CHAIN, 12, 12), (0.25, 0.25, 1 / 3), strict=True)],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # coroutines that were never awaited
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("unlogged")
def test_stop_is_true(programme: str, share: int, least: float) -> None:
    """On every wire: what is confirmed silent is silent, and stays so.

    With faults of frames in every scene; with an exception at any line of the drivers that runs
    meanwhile; of an amplifier that a killed host has left playing.
    """
    tally = Tally()
    for seed in range(FIRST, FIRST + STOPS // share):
        play_stops(programme, seed, tally)
    assert tally.found == []
    assert tally.total("confirmed") > tally.total("stops") * least
    if programme.startswith("frames"):
        assert all(tally.counts[wire, "may play"] for wire in STOPPED_LINES)
        assert tally.total("raised") == 0


ROOT = Path(drivers.__file__).parents[1]
ON_THE_WAY = sorted(
    file for package in ("drivers", "controller") for file in (ROOT / package).rglob("*.py")
)

# Kinds of wire make the bytes of requests; ports of CAN adapters take and give packed frames.
WIRES = ROOT / "drivers" / "wires"

# One class makes requests of sets.
HOST = ROOT / "drivers" / "host"


@cache
def nodes(file: Path) -> list[ast.AST]:
    """All nodes of a file."""
    return list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def calls(file: Path, part: str) -> Iterator[tuple[str, ast.Call]]:
    """Calls in a file that has a part of a name, with the last part of their name."""
    for node in nodes(file) if part in file.read_text(encoding="utf-8") else ():
        if isinstance(node, ast.Call):
            called = node.func
            yield getattr(called, "attr", "") or getattr(called, "id", ""), node


@in_virtual_time
async def test_broadcast_stop_has_the_longest_ramp_of_its_own_line() -> None:
    """An amplifier with a short longest ramp on another line does not shorten it."""
    lines = [MemoryLine("serial", *names) for names in ("a", "bc")]
    lines[0].far["a"].capabilities["ramp_max"] = 10  # ms
    group = await group_of(*lines)
    await group.apply({name: [layer(0, tone(level=0.5))] for name in "abc"})
    stopping = asyncio.ensure_future(group.stop(0.2))
    await asyncio.sleep(0.1)
    assert lines[0].levels("a")[0] == 0.0
    assert lines[1].levels("b")[0] > 0.0
    stopped = await stopping
    assert all(outcome.is_confirmed for outcome in stopped.values())


def test_only_wires_use_encoders() -> None:
    """`encode_...` and `pack_...` are called by wires, codecs and the table, not from above."""
    users = {
        file
        for file in ON_THE_WAY
        for part in ("encode_", "pack_")
        for name, _ in calls(file, part)
        if name.startswith(part)
    }
    wires = {file for file in users if WIRES in file.parents}
    can_files = {"can_bus.py", "can_interfaces.py", "can_text.py"}
    assert {file.name for file in wires} == {*can_files, "serial_frames.py", "serial_line.py"}
    above = [file for file in users - wires if "protocol" not in file.parts]
    assert above == [HOST / "set_admission.py"]


def test_only_what_a_ledger_admits_is_packed() -> None:
    """The host makes the words of sets in one place, of what `admit` returned."""
    (packed,) = (
        ast.unparse(call.args[0])
        for file in ON_THE_WAY
        for name, call in calls(file, "pack_layers")
        if name == "pack_layers"
    )
    admitted = [
        ast.unparse(node.targets[0])
        for node in nodes(HOST / "set_admission.py")
        if isinstance(node, ast.Assign) and "ledger.admit(" in ast.unparse(node.value)
    ]
    assert admitted == [packed]
