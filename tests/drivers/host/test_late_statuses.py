"""Statuses that are late, of what ends meanwhile: no sound amplifier contradicts its requests."""

import asyncio
import random

import pytest

from drivers.errors import CommandRefused, LinkDegraded
from drivers.host.group import Group
from drivers.protocol.sets import Envelope
from virtual_lines import (
    MemoryLine,
    group_of,
    grouped,
    in_virtual_time,
    layer,
    losing,
    tone,
    unaltered,
)

LATEST = 0.014  # s, each way
PULSE = tone(level=0.0, onset=Envelope(100, ((3000, 0), (3000, 0))))  # over after 30 ms


def delayed(end: MemoryLine, rng: random.Random) -> None:
    """Have what passes a line come late, as on a busy machine."""
    end.inward = end.outward = lambda name, data: [(rng.uniform(0.0, LATEST), data)]


async def read(group: Group) -> None:
    """Read two statuses of the amplifier, which show a contradiction each."""
    for _ in range(2):
        await asyncio.sleep(0.02)
        await group.amplifiers["a"].read_status()


@pytest.mark.parametrize("ends_by", ["a pulse", "its time", "what waited"])
@in_virtual_time
async def test_what_ends_amid_an_exchange_may_be_shown_or_not(ends_by: str) -> None:
    """Up to 14 ms out, and back: a status may show the layer and its level, whenever it is read."""
    rng, end = random.Random(5), MemoryLine("serial", "a")
    group = await group_of(end, watchdog=2.0)
    host = group.amplifiers["a"]
    layers = {
        "a pulse": [layer(0, PULSE)],
        "its time": [layer(0, tone(ending=Envelope(50, ((8000, 0),))), valid_for=0.04)],
        "what waited": [layer(0, PULSE), layer(1, tone(1, 0.1))],
    }[ends_by]
    shown = set[int]()
    for _ in range(60):
        await group.apply({"a": layers})
        if ends_by == "what waited":
            await group.apply({"a": [layer(0, tone(level=0.4), after=True, valid_for=0.02)]})
        delayed(end, rng)
        for _ in range(4):
            await asyncio.sleep(rng.uniform(0.0, 0.02))
            shown.add((await host.read_status())["tokens"][0] > 0)
            assert host._contradictions == 0
        end.inward = end.outward = unaltered
        await asyncio.sleep(0.1)
    assert shown == {False, True}


@in_virtual_time
async def test_renewal_that_comes_as_its_layer_ends_may_be_too_late() -> None:
    """A layer of 40 ms is renewed about then, up to 14 ms late: it plays on, or it does not."""
    rng, end = random.Random(7), MemoryLine("serial", "a")
    group = await group_of(end, watchdog=2.0)
    host, shown = group.amplifiers["a"], set[int]()
    for _ in range(40):
        await group.apply({"a": [layer(0, tone(), valid_for=0.04)]})
        delayed(end, rng)
        await asyncio.sleep(rng.uniform(0.02, 0.045))
        await group.apply({"a": [layer(0, renew=True, valid_for=1.0)]})
        for _ in range(3):
            await asyncio.sleep(0.015)
            shown.add((await host.read_status())["tokens"][0] > 0)
            assert host._contradictions == 0
        end.inward = end.outward = unaltered
        await group.silence(0.0)
    assert shown == {False, True}


@grouped(("a",), wire="serial")
async def test_silence_without_a_reply_may_have_been_heard(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Three times: all that plays is over, as statuses say afterwards; a wrong token contradicts.

    Once a silence is confirmed another layer that is not played contradicts as ever.
    """
    (end,), host = ends, group.amplifiers["a"]
    await group.apply({"a": [layer(0, tone())]})
    end.outward = losing("Silence", count=3)
    with pytest.raises(LinkDegraded):
        await group.silence(0.005)
    for _ in range(3):
        await asyncio.sleep(0.02)
        assert (await host.read_status())["tokens"][0] == 0
        await host.ping()
    assert host._contradictions == 0
    await group.silence(0.005)
    await group.apply({"a": [layer(0, tone())]})
    await asyncio.sleep(0.02)
    end.far["a"].playback.silence(end.loop.time(), 0.0)
    with pytest.raises(CommandRefused, match="token of layer 0"):
        await read(group)


@pytest.mark.parametrize("what", ["token", "level"])
@in_virtual_time
async def test_layer_that_is_dropped_is_found_where_statuses_are_late(what: str) -> None:
    """Silent, or at half its level: by two statuses, however late."""
    end = MemoryLine("serial", "a")
    group = await group_of(end)
    await group.apply({"a": [layer(0, tone())]})
    delayed(end, random.Random(6))
    await asyncio.sleep(0.05)
    playback, now = end.far["a"].playback, end.loop.time()
    if what == "token":
        playback.silence(now, 0.0)
    else:
        playback.scale(now, 0.5, 0.0)
    with pytest.raises(CommandRefused, match=f"{what} of"):
        await read(group)
