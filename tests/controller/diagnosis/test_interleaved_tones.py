"""Interleaved tones: who plays what when, for any number of ERAs."""

from dataclasses import replace
from itertools import pairwise

import pytest

from controller.diagnosis.interleaved_tones import interleaved
from model.rig.rig import Rig

RANGE = (45.0, 480.0)  # Hz


def with_eras(rig: Rig, count: int) -> Rig:
    """A rig with more ERAs, or fewer, along its edges."""
    first = rig.eras[0]
    length, width = rig.plate.length, rig.plate.width
    eras = [
        replace(first, name=f"E{n}", x=length * (n % 2), y=width * n / (count - 1))
        for n in range(count)
    ]
    return replace(rig, eras=tuple(eras))


@pytest.mark.parametrize("count", [3, 4, 8, 20])
@pytest.mark.parametrize("is_quick", [True, False])
def test_every_era_has_a_frequency_of_its_own(count: int, is_quick: bool, coarse_rig: Rig) -> None:
    """Tones of a step are told apart by its window; a round plays each once, all rounds by all."""
    tones = interleaved(with_eras(coarse_rig, count), RANGE, is_quick=is_quick)
    played: dict[float, list[int]] = {}
    for step in tones.steps:
        frequencies = sorted(frequency for _, frequency in step)
        assert RANGE[0] <= frequencies[0] < frequencies[-1] <= RANGE[1]
        assert all((after - before) * tones.window > 1 for before, after in pairwise(frequencies))
        assert len(step) <= 16
        for era, frequency in step:
            played.setdefault(frequency, []).append(era)
    assert {era for eras in played.values() for era in eras} == {*range(count)}
    assert len(played) >= 16
    together = min(count, 16)
    for eras in played.values():
        assert len({*eras}) == len(eras)
        assert is_quick or len(eras) in {count % 16, together, count}


def test_whole_takes_at_most_forty_seconds_and_one_round_ten(coarse_rig: Rig) -> None:
    """Settling and windows of the paper's plate, with the two repeated steps."""
    for is_quick, limit in ((True, 10.0), (False, 40.0)):
        tones = interleaved(coarse_rig, RANGE, is_quick=is_quick)
        assert (len(tones.steps) + 2) * (tones.settling + tones.window + 0.07) < limit
