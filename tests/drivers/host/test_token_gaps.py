"""Amplifiers that a group leaves out of tens of thousands of sets."""

import pytest

from drivers.contents import Layer, Tone
from drivers.host.group import Group
from virtual_loop import in_virtual_time
from words_line import KINDS, MemoryLine


def loud(number: int, level: float) -> Layer:
    """A layer of 100 Hz on the first channel."""
    return Layer(number, (Tone(0, 100.0, level),), 0.001)


@pytest.mark.parametrize("layers", [[0], [1, 2], [], range(8)], ids=str)
@pytest.mark.parametrize("kind", KINDS)
@in_virtual_time
async def test_amplifier_that_was_left_out_for_long_takes_the_next_set(
    kind: str, layers: list[int]
) -> None:
    """65 536 tokens on: what it plays goes on to the sample, and its next set plays.

    Of each 4096 sets to the other amplifier one is sent; the rest only count.
    """
    ends = [MemoryLine(kind, "a"), MemoryLine(kind, "b")]
    hosts = {name: host for end in ends for name, host in end.hosts.items()}
    group = Group(hosts, draw=lambda low, high: 7)
    await group.open()
    await group.arm()
    await group.apply(
        {"a": [loud(0, 0.5)], "b": [loud(each, 0.1) for each in layers] or [Layer(0)]}
    )
    before = ends[1].far["b"].playback.voices_of(0)
    for count in range(1, 17):
        group._sets.token = 4096 * count % 65536 or 1
        await group.apply({"a": [loud(0, 0.5)]})
        await group.beat()
    after = ends[1].far["b"].playback.voices_of(0)
    assert [(each.origin, each.layer) for each in after] == [
        (each.origin, each.layer) for each in before
    ]
    await group.apply({name: [loud(0, 0.2)] for name in hosts})
    await group.silence(0.0)
    assert [ends[0].levels("a")[0], ends[1].levels("b")[0]] == [0.0, 0.0]
