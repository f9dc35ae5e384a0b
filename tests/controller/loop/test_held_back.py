"""Patterns that come while a channel fades between two others, in virtual time."""

import asyncio
from itertools import pairwise

import pytest

from controller_bench import Bench, running
from drivers.protocol.messages import Apply, Nak, NakCode, Ping, Stage
from model.vibration.excitation import Excitation, Tone
from virtual_loop import in_virtual_time

RAMP, LAG = 0.015, 0.002  # s; of the bench's patterns, and of playback
AT_ONCE = 0.001  # s


def tones(frequency: float) -> Excitation:
    """A pattern of both ERAs."""
    return {"SW": Tone(frequency, 2e-5), "NE": Tone(frequency, 2e-5)}


async def touch(bench: Bench, number: int, *, rest: float) -> float:
    """Move to another finger, felt at 100 Hz and 10 Hz more for each; returns when [s]."""
    bench.table.excitation = tones(100.0 + 10.0 * number)
    begin = asyncio.get_running_loop().time()
    bench.touch((number, 0.1 * number, 0.5))
    await asyncio.sleep(rest)
    return begin


def played(bench: Bench) -> list[list[tuple[float, float]]]:
    """When each amplifier began to play a pattern [s], and its frequency [Hz]."""
    return [
        [
            (output[-1].origin, output[-1].frequency)
            for output in far_end.amplifier.outputs
            if output
        ]
        for far_end in bench.far_ends
    ]


@pytest.mark.parametrize("names", [("main",), ("a", "b")])
@in_virtual_time
async def test_pattern_waits_for_the_end_of_a_fade_and_the_newest_is_played(
    names: tuple[str, ...],
) -> None:
    """On all amplifiers at one moment; at most one ramp after its touch."""
    async with running(*names, voices=2) as bench:
        await touch(bench, 1, rest=0.05)
        second = await touch(bench, 2, rest=0.005)
        third = await touch(bench, 3, rest=0.005)
        fourth = await touch(bench, 4, rest=0.003)
        assert all({f for _, f in each} == {120.0} for each in played(bench))
        await asyncio.sleep(RAMP)
        for each in played(bench):
            assert {frequency for _, frequency in each} == {140.0}
            for begun, _ in each:
                assert begun == pytest.approx(second + RAMP + LAG, abs=AT_ONCE)
                assert begun - fourth <= RAMP
        kinds = (Apply, Stage)
        sets = [one.command_set for one in bench.far_end.requests(*kinds)]
        frequencies = [one.commands[0].frequency for one in sets]
        assert 130.0 not in frequencies
        assert bench.reports.refused == []
        latency = bench.reports.applied[-1].latency  # since the first touch that was not played
        assert latency == pytest.approx(second + RAMP + LAG - third, abs=AT_ONCE)


@in_virtual_time
async def test_lift_is_not_held_back() -> None:
    """Silence is sent at once, and the pattern that waited never."""
    async with running() as bench:
        await touch(bench, 1, rest=0.05)
        await touch(bench, 2, rest=0.005)
        await touch(bench, 3, rest=0.002)
        begin = asyncio.get_running_loop().time()
        bench.touch()
        await asyncio.sleep(AT_ONCE)
        assert bench.far_end.sets()[-1].is_silent
        assert bench.far_end.times(Apply)[-1] - begin < AT_ONCE
        await asyncio.sleep(0.05)
        assert bench.far_end.sets()[-1].is_silent


@pytest.mark.parametrize(("voices", "least"), [(2, 41), (8, 100)])
@in_virtual_time
async def test_hundred_changes_in_a_second_are_never_refused(voices: int, least: int) -> None:
    """Ten milliseconds apart, ramps of fifteen; heartbeats go on. With eight voices all play."""
    async with running(voices=voices) as bench:
        replies = []
        obey = bench.far_end.obey
        bench.far_end.answer = lambda request: replies.append(obey(request)) or replies[-1]
        for number in range(100):
            await touch(bench, 1 + number % 5, rest=0.01)
        assert Nak(NakCode.FADING, 0) not in replies
        assert not any(isinstance(reply, Nak) for reply in replies)
        beats = bench.far_end.times(Ping)
        assert max(b - a for a, b in pairwise(beats)) < 0.075
        assert len(bench.far_end.times(Apply)) >= least
