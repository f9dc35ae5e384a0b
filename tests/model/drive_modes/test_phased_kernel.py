"""The search for one target in C, against the same in numpy."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from model.drive_modes.phased import PHASED
from model.rig.uncertainty import Uncertainty
from model.table.question import Question
from paper_table import contact_sets, smooth_table
from random_forms import random_forms


@pytest.mark.parametrize("wanted", [1e-6, 1.0, 1.5, 3.0, 9.0])
@pytest.mark.parametrize("margin", [0.0, 1.0])
@pytest.mark.parametrize(("quiet", "eras"), [(1, 3), (2, 5), (6, 4), (19, 8)])
def test_both_ways_find_the_same(
    quiet: int, eras: int, margin: float, wanted: float, without_kernels: Callable[[], None]
) -> None:
    """Scores of the best frequency, bounds, and whether a level is missed; none to all reach it."""
    given = random_forms(3, frequencies=21, eras=eras, quiet=quiet, wanted=wanted)
    if margin:
        doubtful = given.target_power * np.float32(1.1)
        given = replace(given, target_power=doubtful, level_margin=margin)
    by_kernel = PHASED.search(given)
    without_kernels()
    by_numpy = PHASED.search(given)
    best = int(by_numpy.score.argmax())
    assert by_kernel.score[best] == pytest.approx(by_numpy.score[best], rel=1e-4)
    assert by_kernel.weights[best] == pytest.approx(by_numpy.weights[best], abs=1e-3)
    assert by_kernel.is_level_limited == by_numpy.is_level_limited
    assert by_kernel.bound == pytest.approx(by_numpy.bound, rel=1e-3)


def test_loudest_points_count_in_both_ways(without_kernels: Callable[[], None]) -> None:
    """Of a rig that is known exactly, where few points do not show the nulls."""
    (places,) = contact_sets(1, fingers=4, seed=8)
    known = replace(smooth_table(), uncertainty=Uncertainty.none())
    given = known.forms(Question((places[0],), tuple(places[1:])))
    assert given.fine is not None
    by_kernel = PHASED.search(given)
    without_kernels()
    by_numpy = PHASED.search(given)
    assert (by_numpy.score > 0).any()
    assert by_kernel.score == pytest.approx(by_numpy.score, rel=2e-3)
    assert np.isfinite(by_kernel.weights).all()
