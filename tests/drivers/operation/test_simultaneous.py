"""Commits over wires of different speed, in virtual time."""

import asyncio
from dataclasses import dataclass, field

import pytest

from drivers.operation.simultaneous import simultaneous_commits
from virtual_loop import VirtualLoop, in_virtual_time


@dataclass
class Wire:
    """An amplifier, the time [s] its commits take, and when they were sent."""

    takes: float
    sent: list[float] = field(default_factory=list)

    async def commit(self) -> float:
        self.sent.append(asyncio.get_running_loop().time())
        await asyncio.sleep(0.01)
        return self.takes


@in_virtual_time
async def test_commits_arrive_together() -> None:
    """6.5, 2 and 0 ms on the wire: sent at once, after 4.5 and after 6.5 ms."""
    wires = [Wire(0.002), Wire(0.0), Wire(0.0065)]
    begin = asyncio.get_running_loop().time()
    answers = await asyncio.gather(*simultaneous_commits([(w.takes, w.commit) for w in wires]))
    assert answers == [0.0065, 0.002, 0.0]
    assert [wire.sent[0] - begin for wire in wires] == pytest.approx([0.0045, 0.0065, 0.0])


@in_virtual_time
async def test_equal_wires_commit_at_once() -> None:
    """Within one iteration of the event loop."""
    wires = [Wire(0.003) for _ in range(4)]
    tasks = [
        asyncio.ensure_future(each)
        for each in simultaneous_commits([(w.takes, w.commit) for w in wires])
    ]
    await asyncio.sleep(0)
    assert all(len(wire.sent) == 1 for wire in wires)
    await asyncio.gather(*tasks)


@in_virtual_time
async def test_remainder_below_clock_resolution_ends() -> None:
    """2 ms and 0.4 ps to wait, on a clock whose steps are 0.9 ps: it goes out after 2 ms."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.now = begin = 4552.311810074659
    wires = [Wire(0.0), Wire(0.0020000000004)]
    await asyncio.gather(*simultaneous_commits([(w.takes, w.commit) for w in wires]))
    assert [wire.sent[0] - begin for wire in wires] == pytest.approx([0.002, 0.0])
