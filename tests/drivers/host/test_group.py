"""Groups on lines with the times of their bits, with lost frames, and with late ones.

Stops and late taps are played by the programs of `make stop-test` and `make late-test`. Finally,
no path of the source leads from the controller to a wire past the ledger.
"""

import ast
import asyncio
import contextlib
import logging
import os
import random
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest

import drivers
from drivers.errors import DriverError, LinkTimeout
from drivers.playing import AmplifierLayer
from drivers.protocol.sets import Envelope, LayerSet
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from group_stops import LINES as STOPPED_LINES
from group_stops import PER_CHAIN, PROGRAMMES, Tally
from group_stops import play as play_stops
from kit.clock import KINDS, MemoryLine, group_of, in_virtual_time, unaltered
from late_taps import play as play_late_taps
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from tests.drivers.host.group_on_lines import (
    SILENT,
    Rig,
    begin,
    connect,
    delay_randomly,
    layer,
    lost,
    of_parts,
    on_wires,
    tone,
)


class PacedLine:
    """Delays the frames of a line by their characters, one frame after the other."""

    def __init__(self, line: MemoryLine, character: float, gap: float) -> None:
        self.line = line
        self.character = character
        """Duration of a character [s]."""
        self.gap = gap
        """Silence before each frame [s]."""
        self.reaction = 0.0099
        """When a reply begins after its request [s]; 10 ms are allowed (protocol page)."""
        self.collisions = 0
        """Frames of the host that were sent while a reply was on its way."""
        self._free_at = 0.0
        self._reply_until = 0.0
        line.inward = self._inward
        line.outward = self._outward

    def _inward(self, _: str, data: bytes) -> list[tuple[float, bytes]]:
        now = self.line.loop.time()
        if now < self._reply_until:
            self.collisions += 1
        self._pass(now, data)
        return [(self._free_at - now, data)]

    def _outward(self, _: str, data: bytes) -> list[tuple[float, bytes]]:
        now = self.line.loop.time()
        self._pass(now + self.reaction, data)
        self._reply_until = self._free_at
        return [(self._free_at - now, data)]

    def _pass(self, start: float, data: bytes) -> None:
        start = max(start, self._free_at)
        self._free_at = start + self.gap + len(data) * self.character


async def connect_paced(wire: str, baud: int, *names: str) -> tuple[Rig, PacedLine]:
    """Return an armed group on one line whose characters have 11 bits on RTU, else 10."""
    if wire == "serial":
        line = MemoryLine(wire, *names, wire=SerialWire(baud, sequence=0))
        paced = PacedLine(line, 10 / baud, gap=0.0)
    else:
        line = MemoryLine(wire, *names, wire=ModbusWire(baud, is_rtu=True, number=0))
        silence = max(3.5 * 11 / baud, 0.00175)  # Modbus over serial line V1.02, 2.5.1.1
        paced = PacedLine(line, 11 / baud, silence)
    return Rig([line], await group_of(line, watchdog=2.0)), paced


@pytest.mark.parametrize(
    ("wire", "baud"),
    [
        ("rtu", 9600),
        ("rtu", 19_200),
        ("rtu", 57_600),
        ("rtu", 115_200),
        ("serial", 9600),
        ("serial", 115_200),
    ],
)
@in_virtual_time
async def test_latest_allowed_replies_are_awaited(wire: str, baud: int) -> None:
    """Replies start 9.9 ms after each request, on Modbus after write and read: no repetition."""
    rig, _ = await connect_paced(wire, baud, "a")
    onset = Envelope(20, ((100, 0),) * 8)

    await rig.apply(layer(0, tone(0.5, onset=onset), tone(0.5, channel=1)))
    await rig.group.beat()

    assert rig.retries == 0


@pytest.mark.parametrize("baud", [9600, 57_600])
@in_virtual_time
async def test_stop_after_a_broadcast_does_not_collide_with_a_reply(baud: int) -> None:
    """On RTU a stop keeps 8 ms off the reply to the status that follows a commit."""
    rig, paced = await connect_paced("rtu", baud, "a", "b")
    paced.reaction = 0.0079
    playing = await begin(rig.play(0.5))
    while rig.requests()[-2:-1] != ["all Commit"]:  # noqa: ASYNC110
        await asyncio.sleep(0.0005)

    assert await rig.stop() == {"a": True, "b": True}

    with pytest.raises(DriverError):
        await playing
    assert paced.collisions == 0


@in_virtual_time
async def test_amplifier_may_play_until_requests_under_way_have_arrived() -> None:
    """A set of 200 bytes takes 0.2 s at 9600 baud, and feeds the watchdog when it arrives."""
    rig, _ = await connect_paced("serial", 9600, "a")
    await rig.play(0.5)
    rig.line.outward = lost
    onset = Envelope(20, ((100, 0),) * 30)
    long_tone = tone(0.1, channel=1, onset=onset)
    with pytest.raises(LinkTimeout):
        await rig.apply(layer(1, long_tone), layer(2, long_tone))
    may_play_until = rig.hosts["a"].feeding.may_play_until

    await asyncio.sleep(may_play_until - rig.line.loop.time() - 0.1)
    assert rig.levels["a"][0] > 0.3
    await asyncio.sleep(0.1)
    assert rig.levels == {"a": SILENT}


@on_wires("serial")
async def test_missing_reply_is_given_up_by_a_process_that_is_often_delayed(wire: str) -> None:
    """Delays of 30 ms every 31 ms: each attempt ends after four delays and a few looks."""
    rig = await connect("a", wire=wire)
    rig.line.outward = lost

    async def stall() -> None:
        while True:
            rig.line.loop.now += 0.03
            await asyncio.sleep(0.001)

    stalling = await begin(stall())
    rig.watch()

    with pytest.raises(LinkTimeout, match="no reply"):
        await rig.hosts["a"].read_status()

    assert rig.elapsed() < 3 * 8 * 0.031
    stalling.cancel()


class PlayedSets:
    """Notes the layers of each set that amplifiers play."""

    def __init__(self, amplifiers: dict[str, SimulatedAmplifier]) -> None:
        self.layers = defaultdict[tuple[str, int], list[Sequence[LayerSet]]](list)
        """By amplifier and token, once for each time that the set plays."""
        for name, amplifier in amplifiers.items():
            self._observe(name, amplifier)

    def _observe(self, name: str, amplifier: SimulatedAmplifier) -> None:
        commit = amplifier.playback.commit

        def commit_and_note(layers: Sequence[LayerSet], token: int, moment: float) -> None:
            self.layers[name, token].append(layers)
            commit(layers, token, moment)

        amplifier.playback.commit = commit_and_note  # type: ignore[method-assign]


LOSSY_CASES = []
for _wire in KINDS:
    for _lines in ("a", "ab", "a b"):
        _marks = [pytest.mark.long] if _lines == "ab" else []
        LOSSY_CASES.append(pytest.param(_wire, _lines, 40, marks=_marks))
        LOSSY_CASES.append(pytest.param(_wire, _lines, 6700, marks=pytest.mark.long))


@pytest.mark.parametrize(("wire", "lines", "count"), LOSSY_CASES)
@in_virtual_time
async def test_sets_play_whole_and_once_although_frames_are_lost(
    wire: str, lines: str, count: int
) -> None:
    """A tenth of all frames of sets of 1 to 8 parts is lost.

    No set plays twice or in part, or is reported but does not play.
    """
    chance = random.Random(count)
    rig = await connect(*lines.split(), wire=wire, watchdog=2.0)
    played = PlayedSets(rig.far)

    def lose_some(name: str, data: bytes) -> list[tuple[float, bytes]]:
        return [] if chance.random() < 0.1 else unaltered(name, data)

    reported_sets = 0
    for _ in range(count):
        layers = of_parts(chance.randint(1, 8), chance.uniform(0.02, 0.06))
        report = None
        for line in rig.lines:
            line.inward = line.outward = lose_some
        with contextlib.suppress(DriverError):
            report = await rig.apply(*layers)
            reported_sets += 1
        for line in rig.lines:
            line.inward = line.outward = unaltered
        await asyncio.sleep(0.05)
        assert rig.levels  # lets happen what is due
        for name in rig.far:
            copies = played.layers[name, rig.group.sets.token]
            assert len(copies) <= 1, name
            assert [len(copy) for copy in copies] in ([], [len(layers)]), name
            if report:
                assert copies == [report.layers[name]], name
        await rig.group.statuses()
        if not rig.group.is_armed:
            await rig.group.clear()
            await rig.group.arm()
        await rig.group.silence(0.001)
        await asyncio.sleep(0.15)  # late layers have faded
    assert reported_sets >= 0.6 * count  # fewer for 8 parts on Modbus RTU


@on_wires("rtu")
async def test_shared_line_awaits_one_reply_at_a_time(wire: str) -> None:
    """Each frame but a broadcast has a response, which arrives before the next frame is sent."""
    rig = await connect("ab", wire=wire)
    received = rig.line.line.received
    awaited = 0
    most_awaited = 0

    def count_request(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal awaited, most_awaited
        is_broadcast = data[0] == 0
        awaited += not is_broadcast
        most_awaited = max(most_awaited, awaited)
        return unaltered(name, data)

    def count_reply(data: bytes) -> None:
        nonlocal awaited
        awaited -= 1
        received(data)

    rig.line.inward = count_request
    rig.line.line.received = count_reply  # type: ignore[method-assign]

    await rig.apply(*of_parts(3))
    await rig.group.beat()

    assert awaited == 0
    assert most_awaited == 1


PULSE = tone(0.0, onset=Envelope(100, ((3000, 0), (3000, 0))))
"""Over after 30 ms."""
ENDING_TONE = tone(0.5, ending=Envelope(50, ((8000, 0),)))
WAITING = layer(0, tone(0.4), after=True, valid_for=0.02)
RENEWAL = layer(0, renew=True, valid_for=1.0)
ENDING_LAYERS: dict[str, list[AmplifierLayer]] = {
    "pulse": [layer(0, PULSE)],
    "valid_for": [layer(0, ENDING_TONE, valid_for=0.04)],
    "waiting": [layer(0, PULSE), layer(1, tone(0.1, channel=1))],
    "renewal": [layer(0, tone(0.5), valid_for=0.04)],
}
"""Layers that end within 40 ms, some of which another layer follows."""


@pytest.mark.parametrize("case", ENDING_LAYERS)
@in_virtual_time
async def test_layer_that_ends_during_an_exchange_may_be_shown_or_not(case: str) -> None:
    """Up to 14 ms out and back: a status may show the layer and its level, whenever it is read."""
    chance = random.Random(5)
    rig = await connect("a", wire="serial", watchdog=2.0)
    host = rig.hosts["a"]
    shown = set()
    for _ in range(60):
        await rig.apply(*ENDING_LAYERS[case])
        if case == "renewal":
            delay_randomly(rig.line, chance)
            await asyncio.sleep(chance.uniform(0.02, 0.045))
            await rig.apply(RENEWAL)
        elif case == "waiting":
            await rig.apply(WAITING)
        delay_randomly(rig.line, chance)
        for _ in range(4):
            await asyncio.sleep(chance.uniform(0.0, 0.02))
            status = await host.read_status()
            shown.add(status["tokens"][0] > 0)
            assert host.contradictions.count == 0
        rig.line.inward = rig.line.outward = unaltered
        await rig.group.silence(0.0)
        await asyncio.sleep(0.1)
    assert shown == {False, True}


@on_wires("serial")
async def test_arming_again_uses_another_session(wire: str) -> None:
    """An amplifier refuses the session that it held last, which may be drawn again."""
    rig = await connect("a", wire=wire)
    session = rig.far["a"].session
    rig.group.draw = lambda *_: session - 1

    await rig.group.disarm()
    await rig.group.arm()

    assert rig.group.is_armed


@pytest.mark.parametrize("exchanged", ["cables", "replies"])
@on_wires()
async def test_exchanged_lines_are_silenced(wire: str, exchanged: str) -> None:
    """Each amplifier refuses the other's session; a line takes no reply to the other's request.

    Both are at address 1 and silent, so that no status contradicts the requests.
    """
    rig = await connect("a", "b", wire=wire)
    first, second = rig.lines
    if exchanged == "cables":
        first.far_end = first.kind.far_end({1: rig.far["b"]}, first.send)
        second.far_end = second.kind.far_end({1: rig.far["a"]}, second.send)
    else:
        await rig.hosts["b"].read_status()  # the numbers of requests differ from line to line
        first.line, second.line = second.line, first.line

    async with asyncio.timeout(2.0):
        while rig.group.is_armed:
            with contextlib.suppress(DriverError):
                await rig.group.beat()
            await asyncio.sleep(0.05)

    await asyncio.sleep(0.3)
    for name, amplifier in rig.far.items():
        amplifier.tick(first.loop.time())
        assert amplifier.state != "OPERATION_ENABLED", name


UNFED = ("modbus", 3, 12)
"""Three amplifiers on a line that were once not fed in time."""
UNHEARD = ("modbus", 3, 64)
"""An amplifier that replied again and was once not heard."""
SHORT_CASES = [("modbus", 1, 1), ("serial", 3, 1), ("can", 1, 1), UNFED]
LONG_CASES = [("modbus", 3, 1), ("serial", 1, 1), ("can", 3, 1), UNHEARD]


@pytest.mark.parametrize(
    ("wire", "amplifiers", "seed"),
    [*SHORT_CASES, *(pytest.param(*case, marks=pytest.mark.long) for case in LONG_CASES)],
)
def test_late_frames_are_no_fault(wire: str, amplifiers: int, seed: int) -> None:
    """Frames are up to 16 ms late either way: each click that does not play is counted.

    A few clicks come while all is disarmed. Only on several amplifiers some must be too late.
    """
    counts = play_late_taps(wire, amplifiers, seed)

    taps = counts.pop("taps")
    played = counts.pop("played")
    too_late = counts.pop("too late")
    assert counts - Counter(["clicks"] * taps) == Counter()
    assert too_late > 0 or amplifiers == 1
    assert played + too_late >= 0.9 * taps


STOPS = int(os.environ.get("STOPS", "84"))
FIRST = int(os.environ.get("FIRST", "0"))


@pytest.fixture
def silent_log() -> Iterator[None]:
    """Log no losses and planted exceptions, of which there are thousands."""
    logger = logging.getLogger("drivers")
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(logging.NOTSET)


@pytest.mark.parametrize(
    ("programme", "share", "confirmed_share"),
    [*zip(PROGRAMMES, (PER_CHAIN, 12, 12), (0.25, 0.25, 1 / 3), strict=True)],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # coroutines that were never awaited
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("silent_log")
def test_stop_is_true(programme: str, share: int, confirmed_share: float) -> None:
    """On every wire, an amplifier that is confirmed silent is silent, and stays so.

    Frames are faulty in every scene; an exception is raised at any line of the drivers that runs
    meanwhile; or a killed host has left an amplifier playing.
    """
    tally = Tally()
    for seed in range(FIRST, FIRST + STOPS // share):
        play_stops(programme, seed, tally)

    assert tally.problems == []
    assert tally.total("confirmed") > tally.total("stops") * confirmed_share
    if programme.startswith("frames"):
        for wire in STOPPED_LINES:
            assert tally.counts[wire, "may play"], wire
        assert tally.total("raised") == 0


@on_wires("serial")
async def test_broadcast_stop_has_the_longest_ramp_of_its_own_line(wire: str) -> None:
    """An amplifier on another line, whose longest ramp is 10 ms, does not shorten it."""
    lines = [MemoryLine(wire, "a"), MemoryLine(wire, "b", "c")]
    lines[0].far["a"].capabilities["ramp_max"] = 10
    rig = Rig(lines, await group_of(*lines))
    await rig.play(0.5)
    stopping = await begin(rig.group.stop(0.2))

    await asyncio.sleep(0.1)

    assert rig.levels["a"][0] == 0.0
    assert rig.levels["b"][0] > 0.0
    await stopping


DRIVERS = Path(drivers.__file__).parent
ADMISSION = DRIVERS / "host" / "set_admission.py"
SOURCES = sorted([*DRIVERS.rglob("*.py"), *(DRIVERS.parent / "controller").rglob("*.py")])


@cache
def nodes(file: Path) -> list[ast.AST]:
    """Return all nodes of a file."""
    return list(ast.walk(ast.parse(file.read_text("utf-8"))))


def calls(file: Path, prefix: str) -> list[ast.Call]:
    """Return the calls in a file of functions and methods whose names have a prefix."""
    matching: list[ast.Call] = []
    if prefix not in file.read_text("utf-8"):
        return matching
    for node in nodes(file):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", "") or getattr(node.func, "id", "")
            if name.startswith(prefix):
                matching.append(node)
    return matching


def test_only_wires_use_encoders() -> None:
    """Above wires and codecs, only the admission of sets calls `encode_...` or `pack_...`."""
    users = [file for file in SOURCES if calls(file, "encode_") or calls(file, "pack_")]

    names = [file.name for file in users if file.parent.name not in ("wires", "protocol")]

    assert names == [ADMISSION.name]


def test_only_admitted_sets_are_packed() -> None:
    """The host makes the words of sets in one place, from the layers that `admit` returned."""
    packed = []
    for file in SOURCES:
        packed += [ast.unparse(call.args[0]) for call in calls(file, "pack_layers")]
    admitted = []
    for node in nodes(ADMISSION):
        if isinstance(node, ast.Assign) and "ledger.admit(" in ast.unparse(node.value):
            admitted.append(ast.unparse(node.targets[0]))

    assert packed == admitted
    assert len(packed) == 1
