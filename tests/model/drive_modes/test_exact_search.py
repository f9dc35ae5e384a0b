"""The exact search: equal to trying everything, and its bounds hold."""

from itertools import product

import numpy as np
import pytest

from drives import by_hand
from model.drive_modes.exact_search import groupings, pattern_count, search_exactly, sensation_found
from model.drive_modes.forms import SILENT, Forms, Weights
from model.drive_modes.switched import find_switched
from model.errors import InputError
from model.table.question import Question
from paper_table import contact_sets, smooth_table
from random_forms import random_forms

F, E = 4, 3


def forms_on_plate(places, *, targets=1):
    """Forms of fingertips on the paper's plate, for 12 dB SL."""
    question = Question(tuple(places[:targets]), tuple(places[targets:]), level_db_sl=12.0)
    return smooth_table().forms(question)


def by_brute_force(given):
    """Score of every pattern that reaches the level, the highest."""
    best = 0.0
    for index in product([SILENT, *range(F)], repeat=E):
        if any(i != SILENT for i in index):
            weight = np.array([i != SILENT for i in index], dtype=np.complex64)
            score, level = by_hand(given, Weights(np.array(index), weight))
            best = max(best, score if level >= given.wanted else 0.0)
    return best


def test_pattern_count_of_the_paper_is_614_655():
    """28^4 - 1, of which 4482 drive one or two; eight ERAs have 28^8 - 1."""
    assert pattern_count(4, 27, eras_at_most=4) == 28**4 - 1 == 614_655
    assert pattern_count(4, 27, eras_at_most=2) == 4482
    assert pattern_count(8, 27, eras_at_most=8) == 28**8 - 1


def test_groupings_are_all_partitions():
    """Bell numbers: five things, one of them silence, fall into 52 partitions, one of them idle."""
    assert len(groupings(4, 4)) == 52 - 1
    assert len(groupings(8, 8)) == 21147 - 1
    for groups in groupings(4, 3):
        assert sum(groups) == sum(1 << era for era in range(4) if any(g >> era & 1 for g in groups))
        assert 1 <= sum(group.bit_count() for group in groups) <= 3
    assert len(set(map(frozenset, groupings(4, 4)))) == 51


@pytest.mark.parametrize("quiet", [1, 8])
@pytest.mark.parametrize("wanted", [1e-6, 2.0, 3.0])
@pytest.mark.parametrize("targets", [1, 2])
def test_search_exactly_equals_brute_force(quiet, wanted, targets, monkeypatch):
    """Three ERAs and four frequencies: the best of all 124 patterns, proven to be.

    Also where one choice at a time is extended.
    """
    for seed in range(4):
        monkeypatch.setattr("model.drive_modes.exact_search.MAX_FRONT", (1, 100_000)[seed % 2])
        given = random_forms(seed, frequencies=F, quiet=quiet, wanted=wanted, targets=targets)
        found = search_exactly(given, eras_at_most=E)
        assert found.score == pytest.approx(by_brute_force(given), rel=1e-5)
        assert found.is_complete
        assert found.bound == found.score
        assert found.pattern_count == 124
        if found.drive is not None:
            score, level = by_hand(given, found.drive)
            assert score == pytest.approx(found.score, rel=1e-5)
            assert level >= wanted * (1 - 1e-5)


def test_sensation_found_is_within_1_5_db_of_the_maximum():
    """Of 1295 patterns of four ERAs on the plate, at one or two targets: within 1.5 dB below."""
    some = np.arange(0, 27, 6)
    patterns = [i for i in product([SILENT, *range(len(some))], repeat=4) if max(i) != SILENT]
    drives = [Weights(np.array(i), (np.array(i) != SILENT).astype(np.complex64)) for i in patterns]
    for places in contact_sets(1, fingers=3, seed=8):
        for count in (1, 2):
            given = forms_on_plate(places, targets=count).at(some)
            most = max(by_hand(given, drive)[1] for drive in drives)
            found = sensation_found(given, eras_at_most=4)
            assert 10 ** (-1.5 / 20) * most <= found <= most * (1 + 1e-5)


def test_search_exactly_equals_find_switched_for_two_eras():
    """With at most two ERAs both searches have the same best; with four it is no worse."""
    for places in contact_sets(6, fingers=3, seed=6):
        given = forms_on_plate(places)
        score, _ = find_switched(given, 0.0)[0]
        two = search_exactly(given, eras_at_most=2)
        assert two.score == pytest.approx(score, rel=1e-5)
        four = search_exactly(given, eras_at_most=4)
        assert two.score <= four.score * (1 + 1e-6)
        assert 0 < four.evaluated_count < 0.01 * four.pattern_count


def test_search_exactly_bounds_the_score_when_out_of_time():
    """Without any time the answer is what two ERAs do, and the bound is above the true best."""
    open_ends = 0
    for places in contact_sets(8, fingers=4, seed=7):
        given = forms_on_plate(places)
        stopped = search_exactly(given, eras_at_most=4, time_limit=0.0)
        whole = search_exactly(given, eras_at_most=4)
        assert stopped.score <= whole.score * (1 + 1e-6)
        assert stopped.bound >= whole.score * (1 - 1e-6)
        assert stopped.is_complete == (stopped.bound == stopped.score)
        open_ends += not stopped.is_complete
    assert open_ends > 0


def test_search_exactly_refuses_ten_eras():
    """Ten ERAs fall into more groupings than can be gone through."""
    field = np.ones((1, 1, 10), dtype=np.complex64)
    form = np.ones((1, 1, 10, 10), dtype=np.complex64)
    given = Forms(field, form, form, np.ones(1, np.float32), 1e-6)
    with pytest.raises(InputError, match="at most 9, got 10"):
        search_exactly(given, eras_at_most=10)
