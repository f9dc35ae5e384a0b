"""Amplifiers that share an address, and one of another version, as `identify` tells of them."""

from collections.abc import Mapping

import pytest

from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from drivers.errors import LinkError
from sim.amplifier.contract import Amplifier
from virtual_loop import in_virtual_time
from words_line import KINDS, MemoryLine, unaltered


class Twins:
    """Two amplifiers at each address, which hear and reply at the same time."""

    def __init__(self, line: MemoryLine, others: Mapping[int, Amplifier]) -> None:
        self._first = line._end
        self._second = line.kind.far_end(others, line._send)
        line._end = self

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        for end in (self._first, self._second):
            end.receive(data, now)


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - {"tcp"}))
@in_virtual_time
async def test_second_amplifier_at_an_address_is_told(kind: str) -> None:
    """Both reply to Hello, with their serial numbers; it names the remedy."""
    line = MemoryLine(kind, "a", "b")
    Twins(line, {2: Amplifier("c", channels=2)})
    with pytest.raises(LinkError, match="several amplifiers reply at address 2"):
        await line.hosts["b"].open()
    await line.hosts["a"].open()


@in_virtual_time
async def test_frames_of_two_nodes_that_mix_are_told() -> None:
    """On CAN frames of both replies alternate: none is put together of both."""
    line = MemoryLine("can", "a")
    Twins(line, {1: Amplifier("c", channels=2)})
    waiting: list[bytes] = []

    def mixed(name: str, data: bytes) -> list[tuple[float, bytes]]:
        if len(unpack_frames(data)) == 1:
            return unaltered(name, data)
        waiting.append(data)
        if len(waiting) < 2:
            return []
        pairs = zip(*map(unpack_frames, waiting), strict=True)
        mixed_up = pack_frames(frame for pair in pairs for frame in pair)
        waiting.clear()
        return [(0.0002, mixed_up)]

    line.outward = mixed
    with pytest.raises(LinkError, match="several amplifiers reply at address 1"):
        await line.hosts["a"].open()


@pytest.mark.parametrize("kind", sorted(KINDS))
@in_virtual_time
async def test_amplifier_of_another_version_is_named(kind: str) -> None:
    """Its identity says version 2 alone: bit 2."""
    line = MemoryLine(kind, "a")
    far = line.far["a"]
    far.identity = {**far.identity, "versions": 1 << 2}
    with pytest.raises(LinkError, match="speaks protocol 2, needs 3"):
        await line.hosts["a"].open()
