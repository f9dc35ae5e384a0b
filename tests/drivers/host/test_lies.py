"""Amplifiers and lines that lie, on every kind of wire: refused or counted; stops are truthful.

Words of replies are altered after they were packed, by the name of the first value in them.
"""

import asyncio
import contextlib
import math
import random
from collections.abc import Callable, Iterator

import pytest

from drivers.errors import DriverError, LinkDegraded
from drivers.host.group import Group
from drivers.playing import Layer, Tone
from drivers.protocol.definition import CLOCK_UNKNOWN, HIGH_TIME, MESSAGES, SPAN
from drivers.protocol.records import Refusal, Values
from drivers.wires.can_frames import CanFrame, pack_frames
from sim.amplifier.readings import AmplifierClock, Crystal
from sim.far_ends import serial_amplifiers
from virtual_lines import (
    KINDS,
    Alter,
    MemoryLine,
    group_of,
    in_virtual_time,
    run_virtual,
    unaltered,
)

PACKED = len(pack_frames([CanFrame(0, b"")]))
LOUD = Layer(0, (Tone(0, 100.0, 0.5),), 0.001)
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


@pytest.fixture
def altered(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, int], None]:
    """A function that has all replies of a record say a value in a word.

    field: in it; of a variable number of words the first one.
    """

    def alter(name: str, field: str, value: int) -> None:
        record = MESSAGES[name].reply
        pack, at = record.pack, record.places.get(field, record.words)

        def lying(values: Values) -> list[int]:
            words = pack(values)
            words[at] = value
            return words

        monkeypatch.setattr(record, "pack", lying)

    return alter


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
def test_capabilities_that_cannot_be_are_refused(
    wire: str, lie: str, altered: Callable[[str, str, int], None]
) -> None:
    """It is not opened, and nothing but questions was sent; one message says why."""
    altered("GetCaps", *CAPABILITIES[lie])

    async def run() -> None:
        end = MemoryLine(wire, "a")
        with pytest.raises(DriverError, match=r"must|too short|limits"):
            await end.hosts["a"].open()
        assert {each for _, each in end.sent} <= {"1:1", "1:2"}

    run_virtual(run())


@in_virtual_time
async def test_watchdog_that_stands_still_is_found_amid_sets(
    altered: Callable[[str, str, int], None],
) -> None:
    """Ten sets a second feed it, each with a heartbeat that comes too early to tell."""
    group, _ = await armed("serial")
    altered("GetStatus", "watchdog_left", round(1000 * group.amplifiers["a"].feeding.watchdog))

    async def play() -> None:
        for _ in range(10):
            await group.apply({"a": [LOUD]})
            for _ in range(2):
                await group.beat()
                await asyncio.sleep(0.05)

    with pytest.raises(DriverError, match="watchdog"):
        await play()


@pytest.mark.parametrize("lie", STATUS)
@in_virtual_time
async def test_status_that_cannot_be_ends_in_silence(
    wire: str, lie: str, altered: Callable[[str, str, int], None]
) -> None:
    """Two beats at most; a stop that cannot be read is not confirmed."""
    group, end = await armed(wire)
    await group.apply({"a": [LOUD]})
    await asyncio.sleep(0.01)
    altered("GetStatus", *STATUS[lie])
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


@pytest.mark.parametrize("times", [1, 2])
@in_virtual_time
async def test_set_taken_under_another_token_is_sent_again(
    wire: str, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once; two such replies in a row stop it."""
    group, end = await armed(wire)
    record, lies = MESSAGES["Set"].reply, [1] * times
    pack = record.pack

    def lying(values: Values) -> list[int]:
        return pack({**values, "token": values["token"] ^ lies.pop() if lies else values["token"]})

    monkeypatch.setattr(record, "pack", lying)
    is_refused = pytest.raises(DriverError, match="token")
    with contextlib.nullcontext() if times == 1 else is_refused:
        await group.apply({"a": [LOUD]})
    assert group.is_armed is (times == 1)
    await asyncio.sleep(0.02)
    assert end.levels("a") == [0.5 if times == 1 else 0.0, 0.0]


@pytest.mark.parametrize("text", ["vendor\n", "a\x1b[2J"])
@in_virtual_time
async def test_name_with_control_characters_is_refused(wire: str, text: str) -> None:
    """It could rewrite a terminal."""
    end = MemoryLine(wire, "a")
    end.far["a"].identity["vendor"] = text
    with pytest.raises(DriverError, match="control characters"):
        await end.hosts["a"].open()


def refused(name: str, values: Values) -> Values | None:
    """A refusal."""
    raise Refusal("not now", "WRONG_STATE")


def late(kind: str) -> Alter:
    """Everything comes 40 ms late."""
    return lambda name, data: [(0.04, data)]


def byte_by_byte(kind: str) -> Alter:
    """Byte by byte, or frame by frame on CAN, 20 us apart."""
    size = PACKED if kind == "can" else 1

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        cuts = range(0, len(data), size)
        return [(0.0002 + 2e-5 * n, data[at : at + size]) for n, at in enumerate(cuts)]

    return alter


def with_copies(kind: str) -> Alter:
    """Growing copies of all replies before."""
    before: list[bytes] = []

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        before.append(data)
        return [(0.0002, b"".join(before[-20:-1])), (0.0003, data)]

    return alter


def every_second(damage: Callable[[bytes], bytes]) -> Callable[[str], Alter]:
    """Every second reply is damaged."""

    def make(kind: str) -> Alter:
        count = 0

        def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
            nonlocal count
            count += 1
            return [(0.0002, damage(data) if count % 2 else data)]

        return alter

    return make


def with_noise(noise: Callable[[str, random.Random], bytes]) -> Callable[[str], Alter]:
    """Noise before every reply."""

    def make(kind: str) -> Alter:
        chance = random.Random(4)
        return lambda name, data: [(0.0001, noise(kind, chance)), (0.0002, data)]

    return make


def random_bytes(kind: str, chance: random.Random) -> bytes:
    """Bytes, or frames on CAN, of other devices."""
    if kind != "can":
        return chance.randbytes(40)
    return pack_frames([CanFrame(chance.randrange(0x300, 0x500), chance.randbytes(8))] * 20)


def events(kind: str, chance: random.Random) -> bytes:
    """Events of the amplifier, where the wire has some, each whole."""
    words = (5).to_bytes(2, "little") + bytes(2) + (255).to_bytes(2, "little") + bytes(2)
    if kind == "can":
        frames = [bytes((0, 0, 30, 4)) + words[:4], bytes((0, 1)) + words[4:] + bytes(2)]
        return pack_frames([CanFrame(0x181, each) for each in frames] * 50)
    if kind == "serial":
        return serial_amplifiers.encode_frame(serial_amplifiers.Frame(30, 1, 0, words, 3)) * 50
    return b""


WIRE_LIES: dict[str, Callable[[str], Alter]] = {
    "late by 40 ms": late,
    "byte by byte": byte_by_byte,
    "with copies of old replies": with_copies,
    "doubled": lambda kind: lambda name, data: [(0.0002, data), (0.0003, data)],
    "every second damaged": every_second(lambda data: data[:-2] + bytes((data[-2] ^ 64, data[-1]))),
    "every second cut": every_second(lambda data: data[: len(data) * 2 // 3 // PACKED * PACKED]),
    "after random bytes": with_noise(random_bytes),
    "after 4000 bytes without an end": with_noise(
        lambda kind, chance: b"" if kind == "can" else b"\x01" * 4000
    ),
    "after events": with_noise(events),
    "half open": lambda kind: lambda name, data: [],
}


def lies_of(kind: str) -> Iterator[str]:
    """Lies that a kind of wire can tell: TCP itself detects damage."""
    for name in WIRE_LIES:
        if not (kind == "tcp" and name == "every second damaged"):
            yield name


@pytest.mark.parametrize(("kind", "lie"), [(kind, lie) for kind in KINDS for lie in lies_of(kind)])
@in_virtual_time
async def test_line_that_lies_has_no_effect_but_counts(kind: str, lie: str) -> None:
    """Sets and beats succeed or stop it; the stop says the truth; afterwards all is as before."""
    group, end = await armed(kind)
    await group.apply({"a": [LOUD]})
    end.outward = WIRE_LIES[lie](kind)
    has_failed = False
    try:
        for level in (0.4, 0.3, 0.2):
            await group.apply({"a": [Layer(0, (Tone(0, 100.0, level),), 0.001)]})
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
    await group.apply({"a": [LOUD]})
    assert (await group.stop())["a"].is_confirmed
    counters = end.line.wire.counters
    has_noise = lie not in ("byte by byte", "half open", "every second cut")
    if has_noise and not (kind in ("tcp", "rtu") and lie == "after events"):
        odd = counters.invalid_frames + counters.unexpected_frames + counters.events
        assert odd > 0 or (kind == "can" and lie.startswith("after"))


class Still(AmplifierClock):
    """Shows what it showed first, and never reaches a moment."""

    def reading(self, time: float) -> int:
        return super().reading(self._since)

    def reaches(self, high: int, time: float) -> float:
        return math.inf


class Backwards(Still):
    """Runs backwards."""

    def reading(self, time: float) -> int:
        return -AmplifierClock.reading(self, time) % SPAN


class Fast(Still):
    """Runs 1.5 times as fast."""

    def reading(self, time: float) -> int:
        return 3 * AmplifierClock.reading(self, time) // 2 % SPAN


class Random(Still):
    """Shows any number."""

    chance = random.Random(1)

    def reading(self, time: float) -> int:
        return self.chance.randrange(SPAN)


CLOCKS: dict[str, tuple[type[AmplifierClock], float, float]] = {
    "0.4 s behind, not steered": (AmplifierClock, -0.4, 0.0),
    "jumps back by 0.3 s": (AmplifierClock, 0.0, -0.3),
    "jumps on by 19.6 s": (AmplifierClock, 0.0, 19.6),
    "stands still": (Still, 0.0, 0.0),
    "runs backwards": (Backwards, 0.0, 0.0),
    "random": (Random, 0.0, 0.0),
    "runs half as fast again": (Fast, 0.0, 0.0),
}
"""A clock, by how much it is ahead at first, and jumps after 0.5 s [s]."""


@pytest.mark.parametrize("lie", CLOCKS)
@pytest.mark.parametrize("lines", [("a", "b"), ("ab",)], ids="-".join)
@in_virtual_time
async def test_clock_that_lies_costs_promise_and_stops_nothing(
    lie: str, lines: tuple[str, ...]
) -> None:
    """It is said, its error is no longer known, and sets go on for 5 s.

    One that stands still or runs backwards is too slow as well, as long as nothing plays.
    """
    kind, ahead, jump = CLOCKS[lie]
    ends = [MemoryLine("serial", *names) for names in lines]
    far = ends[0].far["a"]
    far.clock = kind(Crystal(3e-5, 0.0, ahead))
    if "not steered" in lie:
        far.capabilities["clock_error"] = CLOCK_UNKNOWN
    group = await group_of(*ends, draw=random.Random(3).randint)
    for beat in range(100):
        if beat == 10:
            far.clock.shift(round(jump / HIGH_TIME))
        if beat % 5 == 0:
            level = 0.1 + beat / 1000
            tones = (Tone(0, 100.0, level),)
            await group.apply({name: [Layer(beat % 3, tones, 0.001)] for name in group.amplifiers})
        await asyncio.sleep(0.05)
        await group.beat()
    too_slow = {"clock_rate"} if kind in (Still, Backwards) else set()
    (said,) = set(group.amplifiers["a"].reported_at) - {"clock_unsettled"} - too_slow
    assert said == ("clock_not_steered" if "not steered" in lie else "clock_jumped")
    assert group.clock_errors["a"] > 0.1
    await stops_truthfully(group, ends[0])


@pytest.mark.parametrize("lie", [each for each in CLOCKS if "not steered" not in each])
@in_virtual_time
async def test_clock_that_lies_alone_is_said(lie: str) -> None:
    """Of an amplifier without others, on whose clock all its frequencies count, within 3 s."""
    kind, ahead, jump = CLOCKS[lie]
    end = MemoryLine("serial", "a")
    far = end.far["a"]
    far.clock = kind(Crystal(3e-5, 0.0, ahead))
    group = await group_of(end)
    for beat in range(60):
        if beat == 10:
            far.clock.shift(round(jump / HIGH_TIME))
        await asyncio.sleep(0.05)
        await group.beat()
    assert set(group.amplifiers["a"].reported_at) == {"clock_jumped"}
    await stops_truthfully(group, end)


@in_virtual_time
async def test_set_starts_at_once_where_a_clock_cannot_be_steered() -> None:
    """One that is 0.4 s behind would wait 0.1 s for a moment that has passed on the host's."""
    ends = [MemoryLine("serial", name) for name in "ab"]
    far = ends[0].far["a"]
    far.capabilities["clock_error"], far.clock = CLOCK_UNKNOWN, AmplifierClock(Crystal(ahead=-0.4))
    group = await group_of(*ends)
    await group.apply({name: [LOUD] for name in group.amplifiers})
    await asyncio.sleep(0.01)
    assert ends[0].levels("a") == ends[1].levels("b") == [0.5, 0.0]
