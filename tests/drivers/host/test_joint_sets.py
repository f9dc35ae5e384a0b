"""Commits and stops of a group over several lines, whatever happens to frames on the way.

A commit plays at one moment or not at all, also with tokens that fall far behind; frames that all
come late make no amplifier faulty; a stop reports what the amplifiers play; and no path of the
source leads from the controller to a wire past the ledger.
"""

import ast
import asyncio
import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from itertools import combinations
from pathlib import Path

import pytest

import drivers
from chain import set_running
from courses import Acted
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import MESSAGES
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Wire
from group_stops import LINES as STOPPED_LINES
from group_stops import PER_CHAIN, PROGRAMMES, Tally
from group_stops import play as play_stops
from late_taps import AMPLIFIERS, play
from late_taps import WIRES as LATE_WIRES
from sim.amplifier.readings import AmplifierClock, Crystal
from virtual_lines import MemoryLine, group_of, in_virtual_time

LAYER = AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.001)
# By hand, of what is written: bytes of ten bits; of eleven after 3.5 characters; CAN frames of at
# most 111 bits and 24 stuffed, of which each is packed with a head.
LINES: dict[str, tuple[str, Callable[[], Wire], Callable[[bytes], float]]] = {
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
SLACK = 0.0002  # s; what is under way for longer than its bits


def timed_line(name: str, amplifier: str) -> MemoryLine:
    """A line on which bytes take as long as their bits, and 0.2 ms."""
    kind, wire, takes = LINES[name]
    end = MemoryLine(kind, amplifier, wire=wire())
    end.inward = end.outward = lambda _, data: [(takes(data) + SLACK, data)]
    return end


async def started(*ends: MemoryLine) -> list[list[float]]:
    """When the tones of all amplifiers of lines began, as known 20 ms later."""
    await asyncio.sleep(0.02)
    starts = list[list[float]]()
    for end in ends:
        starts.append([])
        for far in end.far.values():
            far.tick(end.loop.time())
            starts[-1] += [voice.began for voice in far.playback.all_voices[0]]
    return starts


@pytest.mark.parametrize("names", [*combinations(LINES, 2)], ids="-".join)
@in_virtual_time
async def test_sets_start_together_on_lines_of_any_speed_that_are_busy(
    names: tuple[str, str],
) -> None:
    """Just armed: within a step of the shift. 3 s later: within 1 us, as their amplifiers state.

    With crystals of +40 and -40 ppm, and a status under way whose reply takes 9 ms. No clock is
    read before the commit, which would wait for it.
    """
    ends = [timed_line(name, each) for name, each in zip(names, "ab", strict=True)]
    now = ends[0].loop.time
    for end, error in zip(ends, (40e-6, -40e-6), strict=True):
        for far in end.far.values():
            far.clock = AmplifierClock(Crystal(error), since=now())
    group = await group_of(*ends, watchdog=1.0)
    outward = ends[1].outward

    async def keep_busy() -> None:
        await asyncio.sleep(0.0005)
        await group.amplifiers["b"].read_status()

    async def apart() -> float:
        """By how much the starts of a set are apart [s]."""
        ends[1].outward = lambda name, data: (
            [(0.009, data)] if name == "GetStatus" else outward(name, data)
        )
        busy = asyncio.ensure_future(keep_busy())
        ends[0].sent.clear()
        await group.apply({name: [LAYER] for name in group.amplifiers})
        await busy
        ends[1].outward = outward
        sent = [each for _, each in ends[0].sent]
        assert sent.index(COMMIT) < (sent.index(STATUS) if STATUS in sent else math.inf)
        ((first,), (second,)) = await started(*ends)
        await group.silence(0.0)
        return abs(first - second)

    assert await apart() < 305e-6
    until = now() + 3.0
    while now() < until:
        await asyncio.sleep(0.05)
        await group.beat()
    assert await apart() < 1e-6


def loud(number: int, level: float) -> AmplifierLayer:
    """A layer of 100 Hz on the first channel."""
    return AmplifierLayer(number, (AmplifierTone(0, 100.0, level),), 0.001)


_ROWS = [(wire, amplifiers, 1) for wire in LATE_WIRES for amplifiers in AMPLIFIERS]
_FOUND = [("modbus", 3, 12), ("modbus", 3, 64)]
"""Three on a line that were not fed in time; one that replied again and was not heard."""

_SHORT = [("modbus", 1, 1), ("serial", 3, 1), ("can", 1, 1), _FOUND[0]]


@pytest.mark.parametrize(
    ("wire", "amplifiers", "seed"),
    [
        pytest.param(*row, marks=[] if row in _SHORT else pytest.mark.long)
        for row in [*_ROWS, *_FOUND]
    ],
)
def test_late_frames_are_no_fault(wire: str, amplifiers: int, seed: int) -> None:
    """Up to 16 ms either way: nothing is wrong, and each click that was not played is counted.

    But for some that come while all is disarmed. On one amplifier, in one exchange, all may be.
    """
    counts = play(wire, amplifiers, seed)
    taps, played, too_late = map(counts.pop, ("taps", "played", "too late"))
    assert not counts - Counter(["clicks"] * taps)
    assert too_late > 0 or amplifiers == 1
    assert played + too_late >= 0.9 * taps


@in_virtual_time
async def test_watchdog_that_stands_still_is_found_where_replies_are_late() -> None:
    """On a line that amplifiers share, where one commit feeds all of them before each in turn."""
    async with set_running("a", "b", of=Acted, wire="modbus-rtu") as chain:
        chain.witness.disturb()  # a status goes before what feeds
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
    assert {file.name for file in wires} == {"can_bus.py", "serial_frames.py", "serial_line.py"}
    above = [file for file in users - wires if "protocol" not in file.parts]
    assert above == [HOST / "amplifier.py"]


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
        for node in nodes(HOST / "amplifier.py")
        if isinstance(node, ast.Assign) and ".ledger.admit(" in ast.unparse(node.value)
    ]
    assert admitted == [packed]
