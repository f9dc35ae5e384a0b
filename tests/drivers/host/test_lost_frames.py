"""Sets of which frames are lost: all play whole and once, or it is said that they do not."""

import asyncio
import random
from collections.abc import Sequence
from contextlib import suppress

import pytest

from drivers.errors import DriverError, LinkTimeout
from drivers.host.group import Group
from drivers.playing import Layer
from drivers.protocol.definition import MESSAGES
from drivers.protocol.sets import Envelope, LayerSet
from drivers.wires.serial_frames import REPLY, FrameReader, encode_frame, pack_words
from virtual_lines import (
    KINDS,
    Alter,
    MemoryLine,
    group_of,
    grouped,
    layer,
    run_virtual,
    tone,
    unaltered,
)

LOST = 0.1  # of the frames, either way
LINES = {
    "one": (("a",),),
    "one line of two": (("a", "b"),),
    "two lines": (("a",), ("b",)),
}
SET = MESSAGES["Set"].number


def of_parts(count: int, level: float = 0.05) -> list[Layer]:
    """Layers whose set has about so many parts: a layer of two onsets of 24 knots has 111 words."""
    tones = [tone(each, level, onset=Envelope(20, ((100, 0),) * 24)) for each in (0, 1)]
    return [layer(number, *tones) for number in range(count)]


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
        with suppress(DriverError):
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


CASES = [(kind, lines, 40) for kind in KINDS for lines in LINES]
LONG = [pytest.param(*each[:2], 6700, marks=pytest.mark.long) for each in CASES]


@pytest.mark.parametrize(("kind", "lines", "count"), [*CASES, *LONG])
def test_sets_play_whole_and_once_though_frames_are_lost(kind: str, lines: str, count: int) -> None:
    """One frame of ten either way, of sets of 1 to 8 parts; the long form: 20 000 on each wire."""
    rng = random.Random(count)
    assert run_virtual(_play(kind, lines, rng, count), rng=rng) == []


def _without(*numbers: int) -> Alter:
    """Loses the Set requests with these numbers, counted from 0."""
    sent = -1

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal sent
        sent += name == "Set"
        return [] if name == "Set" and sent in numbers else unaltered(name, data)

    return alter


@pytest.mark.parametrize("wire", ["serial", "can"])
@grouped(("a",))
async def test_missing_part_is_sent_again_with_those_behind_it(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Of four parts the second is lost: they are 0 1 2 3, then 1 2 3."""
    (end,) = ends
    end.sent.clear()
    end.inward = _without(1)
    await group.apply({"a": of_parts(4)})
    assert [each for _, each in end.sent] == [f"1:{SET}"] * 7
    assert end.retries == 1
    await asyncio.sleep(0.06)
    assert end.levels("a")[0] > 0.1


@pytest.mark.parametrize("wire", ["serial", "can"])
@grouped(("a",))
async def test_last_part_alone_is_repeated_without_a_reply(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Its reply is lost twice: the set plays since the first, and is confirmed by the third."""
    (end,) = ends
    end.sent.clear()
    lost = iter([True, True])
    end.outward = lambda name, data: [] if next(lost, False) else unaltered(name, data)
    await group.apply({"a": of_parts(4)})
    assert [each for _, each in end.sent] == [f"1:{SET}"] * 6


@pytest.mark.parametrize("wire", ["serial", "can", "tcp"])
@grouped(("a",))
async def test_part_that_never_arrives_is_given_up(group: Group, ends: list[MemoryLine]) -> None:
    """An amplifier that says so for ever is sent it three times, and counts as degraded."""
    (end,) = ends
    far = end.far["a"]
    said = {"token": 0, "exact": 0, "staged": 0, "played": 0, "missing": 0}
    far._take = lambda part, now: {**said, "token": part["token"]}  # type: ignore[method-assign]
    async with asyncio.timeout(1.0):
        with pytest.raises(LinkTimeout):
            await group.apply({"a": of_parts(3)})
    assert group.members.degraded == ("a",)


@grouped(("a",), wire="serial")
async def test_reply_to_a_part_but_the_last_is_none_of_its_set(
    group: Group, ends: list[MemoryLine]
) -> None:
    """An amplifier says of each of eight parts that the set plays: all are sent, and it does."""
    (end,) = ends
    taken = {"token": group.sets.token + 1, "exact": 1, "staged": 0, "played": 1, "missing": 0}
    payload = pack_words(MESSAGES["Set"].reply.pack(taken))

    def replied(name: str, data: bytes) -> list[tuple[float, bytes]]:
        (frame,) = FrameReader().feed(data)
        if name == "Set":
            reply = frame._replace(kind=SET | REPLY, payload=payload)
            end.later(0.0001, end.line.received, encode_frame(reply))
        return unaltered(name, data)

    end.sent.clear()
    end.inward = replied
    await group.apply({"a": of_parts(8)})
    assert [each for _, each in end.sent] == [f"1:{SET}"] * 8
    await asyncio.sleep(0.06)
    assert end.levels("a")[0] > 0.1


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
