"""Clocks of several amplifiers over real lines, and amplifiers and lines that lie about anything.

In virtual time with the whole host. Replies are altered by the name of the first word in them; they
are refused or counted, and stops remain truthful.
"""

import asyncio
import contextlib
import math
import random
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

from drivers.errors import DriverError, LinkDegraded, Preempted
from drivers.host.group import Group
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import CLOCK_UNKNOWN, FEATURES, HELLO, HIGH_TIME, MESSAGES, SPAN
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_line import SerialWire
from kit.clock import (
    KINDS,
    MemoryLine,
    group_of,
    in_virtual_time,
    unaltered,
)
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.far_ends import serial_amplifiers
from sim.transport.simulated_line import LINE_KINDS, LineDelays

PACKED = len(pack_frames([CanFrame(0, b"")]))
STATUS = {
    **{"state": ("state", 255), "latch": ("latch", 0), "watchdog_left": ("watchdog_left", 65535)},
    **{"temperature": ("temperature", 32767), "channels": ("channels", 200 << 8 | 8)},
    **{"no channels": ("channels", 8), "levels": ("levels", 65535), "fault": ("fault", 2)},
    **{"layers": ("layers", 2 << 8 | 7), "interlock": ("flags", 0b11)},
    "latch jumps": ("latch", 77),
}
"""Word and value of what each status says."""
CAPABILITIES = {
    **{"channels": ("channels", 255), "no channels": ("channels", 0), "layers": ("layers", 0)},
    **{"voices": ("voices", 0), "set_words": ("set_words", 0), "knots": ("knots", 255)},
    **{"frequency_step": ("frequency_step", 0), "level_step": ("level_step", 0)},
    **{"phase_step": ("phase_step", 0), "ramp_max": ("ramp_max", 65535)},
    **{"watchdog_max": ("watchdog_max", 65535), "level_max": ("level_max", 65535)},
    **{"frequency_min is above": ("frequency_min", 65535), "level 0": ("level_step", 10001)},
    **{"watchdog_min": ("watchdog_min", 2001), "envelope_step_max": ("envelope_step_max", 5)},
    **{"limits": ("limits", 30000), "no level": ("level_max", 0)},
}


def alter(patch: pytest.MonkeyPatch, name: str, field: str, value: int) -> None:
    """Have all replies of a record say a value in a word.

    field: in it; of a variable number of words the first one.
    """
    record = MESSAGES[name].reply
    pack, at = record.pack, record.places.get(field, record.words)
    patch.setattr(
        record,
        "pack",
        lambda values: [value if n == at else word for n, word in enumerate(pack(values))],
    )


def loud(level: float = 0.5, number: int = 0) -> AmplifierLayer:
    """A layer of 100 Hz on the first channel, along 1 ms."""
    return AmplifierLayer(number, (AmplifierTone(0, 100.0, level),), 0.001)


async def armed(wire: str) -> tuple[Group, MemoryLine]:
    """A group of one amplifier, armed."""
    end = MemoryLine(wire, "a")
    group = await group_of(end, draw=random.Random(3).randint)
    return group, end


async def stops_truthfully(group: Group, end: MemoryLine) -> None:
    """Stop: silent where that is confirmed, else from the moment on that is said."""
    stopped = (await group.stop())["a"]
    if not stopped.is_confirmed:
        assert stopped.cause
        await asyncio.sleep(max(stopped.may_play_until - end.loop.time(), 0.0))
    assert end.levels("a") == [0.0, 0.0]


@pytest.mark.parametrize("lie", CAPABILITIES)
@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_capabilities_that_cannot_be_are_refused(
    wire: str, lie: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is not opened, and nothing but questions was sent; one message says why."""
    alter(monkeypatch, "GetCaps", *CAPABILITIES[lie])
    end = MemoryLine(wire, "a")
    with pytest.raises(DriverError, match=r"must|too short|limits"):
        await end.hosts["a"].open()
    assert {each for _, each in end.sent} <= {"1:1", "1:2"}


@pytest.mark.parametrize("lie", STATUS)
@pytest.mark.parametrize("wire", KINDS)
@in_virtual_time
async def test_status_that_cannot_be_ends_in_silence(
    wire: str, lie: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two beats at most; a stop that cannot be read is not confirmed."""
    group, end = await armed(wire)
    await group.apply({"a": [loud()]})
    await asyncio.sleep(0.01)
    alter(monkeypatch, "GetStatus", *STATUS[lie])
    if lie != "latch":
        with contextlib.suppress(DriverError):
            await group.beat()
        await asyncio.sleep(0.03)
        with pytest.raises(DriverError):
            await group.beat()
        assert not group.is_armed
    stopped = (await group.stop())["a"]
    # All levels are there, and a latch that is newer.
    assert stopped.is_confirmed is (lie in ("layers", "fault", "interlock"))
    await stops_truthfully(group, end)


Lie = Callable[[str, list[bytes], random.Random], list[tuple[float, bytes]]]
"""What comes of a reply, by the kind of wire, all replies so far and a source of chance."""


def damaged(data: bytes) -> bytes:
    """A reply with one wrong bit."""
    return data[:-2] + bytes((data[-2] ^ 64, data[-1]))


def cut_off(data: bytes) -> bytes:
    """Two thirds of a reply, in whole frames on CAN."""
    return data[: len(data) * 2 // 3 // PACKED * PACKED]


def random_bytes(kind: str, chance: random.Random) -> bytes:
    """Bytes, or frames on CAN, of other devices."""
    if kind != "can":
        return chance.randbytes(40)
    return pack_frames([CanFrame(chance.randrange(0x300, 0x500), chance.randbytes(8))] * 20)


def events(kind: str) -> bytes:
    """Events of the amplifier, where the wire has some, each whole."""
    words = (5).to_bytes(2, "little") + bytes(2) + (255).to_bytes(2, "little") + bytes(2)
    frames = [bytes((0, 0, 30, 4)) + words[:4], bytes((0, 1)) + words[4:] + bytes(2)]
    return {
        "can": pack_frames([CanFrame(0x181, each) for each in frames] * 50),
        "serial": serial_amplifiers.encode_frame(serial_amplifiers.Frame(30, 1, 0, words, 3)) * 50,
    }.get(kind, b"")


WIRE_LIES: dict[str, Lie] = {
    "late by 40 ms": lambda kind, replies, _: [(0.04, replies[-1])],
    # Or frame by frame on CAN, 20 us apart.
    "byte by byte": lambda kind, replies, _: [
        (0.0002 + 2e-5 * n, replies[-1][at : at + step])
        for step in [PACKED if kind == "can" else 1]
        for n, at in enumerate(range(0, len(replies[-1]), step))
    ],
    "with copies of old replies": lambda kind, replies, _: [
        (0.0002, b"".join(replies[-20:-1])),
        (0.0003, replies[-1]),
    ],
    "doubled": lambda kind, replies, _: [(0.0002, replies[-1]), (0.0003, replies[-1])],
    "every second damaged": lambda kind, replies, _: [
        (0.0002, damaged(replies[-1]) if len(replies) % 2 else replies[-1])
    ],
    "every second cut": lambda kind, replies, _: [
        (0.0002, cut_off(replies[-1]) if len(replies) % 2 else replies[-1])
    ],
    "after random bytes": lambda kind, replies, chance: [
        (0.0001, random_bytes(kind, chance)),
        (0.0002, replies[-1]),
    ],
    "after 4000 bytes without an end": lambda kind, replies, _: [
        (0.0001, b"" if kind == "can" else b"\x01" * 4000),
        (0.0002, replies[-1]),
    ],
    "after events": lambda kind, replies, _: [(0.0001, events(kind)), (0.0002, replies[-1])],
    "half open": lambda kind, replies, _: [],
}


@pytest.mark.parametrize(
    ("kind", "lie"),
    [
        (kind, lie)
        for kind in KINDS
        for lie in WIRE_LIES
        if (kind, lie) != ("tcp", "every second damaged")  # TCP itself detects damage
    ],
)
@in_virtual_time
async def test_line_that_lies_has_no_effect_but_counts(kind: str, lie: str) -> None:
    """Sets and beats succeed or stop it; the stop says the truth; afterwards all is as before."""
    group, end = await armed(kind)
    await group.apply({"a": [loud()]})
    replies, chance = list[bytes](), random.Random(4)

    def outward(_: str, data: bytes) -> list[tuple[float, bytes]]:
        replies.append(data)
        return WIRE_LIES[lie](kind, replies, chance)

    end.outward = outward
    has_failed = False
    try:
        for level in (0.4, 0.3, 0.2):
            await group.apply({"a": [loud(level)]})
            await asyncio.sleep(0.02)
            assert end.levels("a") == [level, 0.0]
            await group.beat()
    except LinkDegraded:  # armed, but nothing new is played until it replies
        pass
    except DriverError:
        has_failed = True
    assert group.is_armed is not has_failed
    await stops_truthfully(group, end)
    end.outward = unaltered
    await asyncio.sleep(0.3)
    await group.open()
    await group.clear()
    await group.arm()
    await group.apply({"a": [loud()]})
    assert (await group.stop())["a"].is_confirmed
    counters = end.line.wire.counters
    has_noise = lie not in ("byte by byte", "half open", "every second cut")
    if has_noise and not (kind in ("tcp", "rtu") and lie == "after events"):
        odd = counters.invalid_frames + counters.unexpected_frames + counters.events
        assert odd > 0 or (kind == "can" and lie.startswith("after"))


CHANCE = random.Random(1)
CLOCKS: dict[str, tuple[Callable[[int], int] | None, float, float]] = {
    "0.4 s behind, not steered": (None, -0.4, 0.0),
    "jumps back by 0.3 s": (None, 0.0, -0.3),
    "jumps on by 19.6 s": (None, 0.0, 19.6),
    "stands still": (lambda shown: 0, 0.0, 0.0),
    "runs backwards": (lambda shown: -shown, 0.0, 0.0),
    "random": (lambda shown: CHANCE.randrange(SPAN), 0.0, 0.0),
    "runs half as fast again": (lambda shown: 3 * shown // 2, 0.0, 0.0),
}
"""What it makes of a good reading; by how much it is ahead at first, and jumps after 0.5 s [s]."""


@pytest.mark.parametrize(
    ("lines", "lie"),
    [
        pytest.param(
            *(lines, lie),
            id=f"{'-'.join(lines)}-{lie}",
            marks=pytest.mark.long if lines == ("a", "b") and "half" not in lie else [],
        )
        for lines in (("a", "b"), ("ab",), ("a",))
        for lie in CLOCKS
        if lines != ("a",) or "not steered" not in lie
    ],
)
@in_virtual_time
async def test_clock_that_lies_costs_promise_and_stops_nothing(
    lie: str, lines: tuple[str, ...]
) -> None:
    """It is said within 3 s, its error is no longer known, and sets go on.

    One that stands still or runs backwards is too slow as well, as long as nothing plays. Also of
    an amplifier without others, on whose clock all its frequencies count: its error is none.
    """
    shows, ahead, jump = CLOCKS[lie]
    ends = [MemoryLine("serial", *names) for names in lines]
    far = ends[0].far["a"]
    far.clock = AmplifierClock(Crystal(3e-5, 0.0, ahead))
    if shows:
        reading = far.clock.reading
        far.clock.reading = lambda time: shows(reading(time)) % SPAN  # type: ignore[method-assign]
        far.clock.reaches = lambda high, time: math.inf  # type: ignore[method-assign]
    if "not steered" in lie:
        far.capabilities["clock_error"] = CLOCK_UNKNOWN
    group = await group_of(*ends, draw=random.Random(3).randint)
    for beat in range(60):
        if beat == 10:
            far.clock.shift(round(jump / HIGH_TIME))
        if beat % 5 == 0:
            await group.apply(
                {each: [loud(0.1 + beat / 1000, beat % 3)] for each in group.amplifiers}
            )
        await asyncio.sleep(0.05)
        await group.beat()
    too_slow = {"clock_rate"} if lie in ("stands still", "runs backwards") else set()
    (said,) = set(group.amplifiers["a"].reported_at) - {"clock_unsettled"} - too_slow
    assert said == ("clock_not_steered" if "not steered" in lie else "clock_jumped")
    assert group.clock_errors["a"] > 0.1 or lines == ("a",)
    await stops_truthfully(group, ends[0])


MARK = 1 << FEATURES["mark"]


def delay(end: MemoryLine, delays: LineDelays, lost: float, rng: random.Random) -> None:
    """Have bytes take their time, what a kind of line adds, and now and then get lost."""

    def inward(name: str, data: bytes) -> list[tuple[float, bytes]]:
        now = end.loop.time()
        after = delays.leave(now, len(data)) - now + end.line.wire.takes
        return [] if rng.random() < lost else [(after, data)]

    def outward(name: str, data: bytes) -> list[tuple[float, bytes]]:
        now = end.loop.time()
        after = delays.arrive(now + 1e-5 * len(data), len(data)) - now
        return [] if rng.random() < lost else [(after, data)]

    end.inward, end.outward = inward, outward


async def held(
    kind: str,
    seed: int,
    *lines: Sequence[str],
    features: int = MARK,
    lost: float = 0.0,
    warm_ups: Sequence[float] = (1e-6,),
) -> tuple[Group, list[AmplifierClock]]:
    """Return a group that is armed, on lines of a kind, with crystals of 50 ppm that warm up.

    warm_ups [1/s]: of its amplifiers in turn.
    """
    rng = random.Random(seed)
    ends = [MemoryLine("serial", *names) for names in lines]
    clocks: list[AmplifierClock] = []
    for number, end in enumerate(ends):
        delay(end, LINE_KINDS[kind].delays((seed, number)), lost, rng)
        for far in end.far.values():
            far.capabilities["features"] &= ~MARK | features
            crystal = Crystal(
                rng.uniform(-50e-6, 50e-6),
                warm_ups[len(clocks) % len(warm_ups)],
                rng.uniform(0.0, 20.0),
            )
            far.clock = AmplifierClock(crystal, since=end.loop.time())
            clocks.append(far.clock)
    return await group_of(*ends), clocks


def rms(values: Collection[float]) -> float:
    """Root of the mean square."""
    return math.hypot(*values) / math.sqrt(len(values))


def leads(clocks: Sequence[AmplifierClock]) -> list[float]:
    """Leads of clocks before the host's [s]."""
    now = asyncio.get_running_loop().time()
    return [math.remainder(each.seconds(now) - now, 20) for each in clocks]


async def skew(group: Group, clocks: Sequence[AmplifierClock], duration: float) -> float:
    """Beat for some time; returns the rms of the leads in its second half [s]."""
    shown, count = list[float](), round(duration / 0.05)
    for number in range(count):
        await asyncio.sleep(0.05)
        with suppress(LinkDegraded):  # of 5 % lost frames three in a row, now and then
            await group.beat()
        if number >= count // 2:
            ahead = leads(clocks)
            shown += [each - sum(ahead) / len(ahead) for each in ahead]
    return rms(shown)


@pytest.mark.parametrize("lost", [0.0, 0.05])
@in_virtual_time
async def test_clocks_on_separate_lines_agree_to_microseconds(lost: float) -> None:
    """USB of high speed, +-50 ppm, 1 ppm/s of warm-up: below 10 us from 1 s on, and so it says."""
    group, clocks = await held("usb-high-speed", 5, "a", "b", "c", lost=lost)
    await skew(group, clocks, 1.0)
    for duration in (1.0, 6.0):
        assert await skew(group, clocks, duration) < 10e-6
    said = group.clock_errors.values()
    assert 2e-6 < rms(said) < 10e-6
    # Behind by what the quickest way out takes, its bits taken off: these are 0.15 ms.
    assert -60e-6 < min(leads(clocks)) < max(leads(clocks)) < 15e-6


@pytest.mark.parametrize(
    ("kind", "bound"),
    [("usb-full-speed", 300e-6)],
)
@pytest.mark.parametrize("lines", [("a", "b", "c", "d"), ("abcd",)], ids="-".join)
@in_virtual_time
async def test_clocks_are_held_when_a_group_is_armed(
    lines: Sequence[str], kind: str, bound: float
) -> None:
    """With the first heartbeat, after which a finger may be there: what is true, and what is said.

    A shift is exact to half of 305 us; that and 0.2 s of readings at all phases of a frame are
    within what lets amplifiers play together.
    """
    off, said = list[float](), list[float]()
    for seed in range(4):
        group, clocks = await held(kind, seed, *lines)
        await group.beat()
        said.append(rms(group.clock_errors.values()))
        off.append(await skew(group, clocks, 0.1))
    assert max(said) < bound
    assert rms(off) < rms(said)


@pytest.mark.parametrize(
    ("kind", "seed", "bound"),
    [pytest.param("usb-full-speed", 2, 17e-6, marks=pytest.mark.long), ("ftdi", 0, 105e-6)],
)
@in_virtual_time
async def test_frames_of_full_speed_are_read_at_all_phases(
    kind: str, seed: int, bound: float
) -> None:
    """In step with frames of 1 ms readings would show one phase of them: 290 us rms on each line.

    Where replies take 16 ms there is one reading a heartbeat. By hand: the lowest of five at any
    phase is late by 170 us, with a standard deviation of 140; at the end of a parabola through 16
    of them that is 140 x 3 / sqrt(16) = 105.
    """
    group, clocks = await held(kind, seed, "a", "b", "c")
    await skew(group, clocks, 6.0)
    assert await skew(group, clocks, 4.0) < bound


def record_requests(group: Group, patch: pytest.MonkeyPatch) -> list[str]:
    """Return a list to which the names of all requests on the lines of a group are added."""
    names: list[str] = []

    def record(
        request: Callable[..., bytes], address: int, name: str, *words: Any, **options: Any
    ) -> bytes:
        names.append(name)
        return request(address, name, *words, **options)

    for line in group.members.lines:
        patch.setattr(line.wire, "request", partial(record, line.wire.request))
    return names


@in_virtual_time
async def test_poor_clocks_are_read_every_10_ms_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests at rest on fast lines that vary by 0.1 ms: a reading costs the host processor time.

    In 2 s: 40 heartbeats to each of two amplifiers, four readings between two heartbeats, and a
    status before every fourth heartbeat.
    """
    rng = random.Random(1)

    def jitter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        return [(rng.expovariate(1e4), data)]

    ends = [MemoryLine("serial", "a"), MemoryLine("serial", "b")]
    for end in ends:
        end.inward = end.outward = jitter
    group = await group_of(*ends)
    names = record_requests(group, monkeypatch)
    for _ in range(40):
        await group.beat()
        await asyncio.sleep(0.05)
    assert names.count("Ping") == 2 * 40
    assert 2 * 10 <= names.count("GetStatus") <= 2 * (4 * 40 + 10)


@pytest.mark.parametrize("lines", [("abc",), ("a", "b")], ids="-".join)
@in_virtual_time
async def test_sets_beside_readings_of_clocks_are_played(
    monkeypatch: pytest.MonkeyPatch, lines: tuple[str, ...]
) -> None:
    """40 sets at any time between the readings of USB of full speed, of which each takes 2 ms.

    On one line a reading may show a set before its own status does; on several no reading goes
    between a set and its commit, which would wait for the reply.
    """
    group, _ = await held("usb-full-speed", 1, *lines, features=0)
    rng = random.Random(1)
    sent = record_requests(group, monkeypatch)
    for number in range(40):
        await asyncio.sleep(0.03)
        await group.beat()
        await asyncio.sleep(rng.uniform(0.005, 0.02))
        sent.clear()
        await group.apply({each: [loud(0.1 + number / 100)] for each in group.amplifiers})
        between = sent[sent.index("Set") : sent.index("Commit")]
        assert len(lines) == 1 or "GetStatus" not in between
    assert {each.committed for each in group.amplifiers.values()} == {group.sets.token}


@pytest.mark.parametrize(("lost", "bound"), [(0.0, 2e-6), (0.02, 10e-6)], ids=["all", "lossy"])
@in_virtual_time
async def test_one_mark_tells_the_clocks_of_a_shared_line(lost: float, bound: float) -> None:
    """Behind USB of full speed 2 s after arming: better by far than what each reading shows.

    Where a Mark is not heard, or the reply that shows it is lost, the present clock is shown, up to
    50 ms later: it counts for nothing. A Ping that is lost leaves a clock off by what all are led
    in 50 ms, mostly at 100 ppm or more: 5 us, led back within 0.5 s.
    """
    group, clocks = await held("usb-full-speed", 1, "abc", lost=lost)
    await skew(group, clocks, 2.0)
    assert await skew(group, clocks, 2.0) < bound
    assert max(group.clock_errors.values()) < 2 * bound
    assert not any(each.reported_at for each in group.amplifiers.values())


@in_virtual_time
async def test_clocks_of_one_line_are_off_by_no_more_than_is_said() -> None:
    """Behind USB of high speed from 3.5 s on: what Marks share is in none of their differences.

    Three crystals warm up each in its way, by 1, 0 and -1 ppm/s: below 1 us, as CAN has it.
    """
    off, said = list[float](), list[float]()
    for seed in range(4):
        group, clocks = await held("usb-high-speed", seed, "abc", warm_ups=(1e-6, 0.0, -1e-6))
        await skew(group, clocks, 3.5)
        said.append(max(group.clock_errors.values()))
        off.append(await skew(group, clocks, 1.0))
    assert max(off) < 1e-6
    assert rms(off) < rms(said)
    assert max(said) < 5e-6


@pytest.mark.parametrize("plays", [False, True], ids=["silent", "playing"])
@in_virtual_time
async def test_no_clock_of_a_line_follows_one_that_jumped(plays: bool) -> None:
    """10 ms of the one to which others are held: they stay within a frame, and are not accused."""
    group, clocks = await held("usb-high-speed", 1, "abc")
    await skew(group, clocks, 4.0)
    if plays:
        await group.apply({each: [loud()] for each in "abc"})
    (jumped,) = (
        number for number, each in enumerate("abc") if not group.amplifiers[each].clock.is_compared
    )
    clocks[jumped].shift(33)  # of 305 us
    for _ in range(10):
        await skew(group, clocks, 0.6)
        others = [each for number, each in enumerate(leads(clocks)) if number != jumped]
        assert max(map(abs, others)) < 125e-6
    reported = [each for each in "abc" if group.amplifiers[each].reported_at]
    assert reported == ["abc"[jumped]]


@in_virtual_time
async def test_no_clock_of_a_line_follows_one_that_is_not_steered() -> None:
    """The first ignores its rate and drifts 40 us a second: it alone is reported, and leaves."""
    group, clocks = await held("usb-high-speed", 0, "abc")
    clocks[0].steer = lambda rate, time: None  # type: ignore[method-assign]
    await skew(group, clocks, 12.0)
    first, *others = leads(clocks)
    assert abs(first) > 400e-6
    assert max(map(abs, others)) < 125e-6
    assert [each for each in "abc" if group.amplifiers[each].reported_at] == ["a"]


@pytest.mark.parametrize("baud", [38_400, 921_600])
@pytest.mark.parametrize("is_stopped", [False, True], ids=["armed", "stopped"])
@in_virtual_time
async def test_readings_before_arming_end_in_time(is_stopped: bool, baud: int) -> None:
    """16 on a line, of which all take 0.28 s at 38 400 baud: after 0.2 s, or at once by a stop.

    But for one reading, and 1 ms until the next.
    """
    end = MemoryLine("serial", *"abcdefghijklmnop", wire=SerialWire(baud, sequence=0))
    end.inward = lambda _, data: [(end.line.wire.takes + 1e-4, data)]
    end.outward = lambda _, data: [(len(data) * 10 / baud + 1e-4, data)]
    group, time = await group_of(end, is_armed=False), end.loop.time
    before, exchange = time(), group.amplifiers["a"].exchange_time("GetStatus")
    arming = asyncio.ensure_future(group.arm())
    if is_stopped:
        await asyncio.sleep(0.05)
        await group.stop()
        before = time()
        with pytest.raises(Preempted):
            await arming
        assert time() - before < 2 * exchange + 1e-3
    else:
        await arming
        hello = min(at for at, name in end.sent if at > before and name.endswith(f":{HELLO}"))
        assert hello - before < 0.2 + 2 * exchange + 1e-3
