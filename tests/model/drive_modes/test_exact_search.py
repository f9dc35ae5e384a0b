"""Searches of drives against exhaustive ones: compiled, limited in level, by dual weights."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from drives import by_hand
from model.drive_modes import find_drives
from model.drive_modes.dual_weights import dual_weights
from model.drive_modes.exact_search import groupings, pattern_count, search_exactly, sensation_found
from model.drive_modes.forms import SILENT, Forms, Weights
from model.drive_modes.phased import PHASED
from model.drive_modes.switched import find_switched
from model.errors import InputError
from model.rig.uncertainty import Uncertainty
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


def _forms(seed: int, short: float) -> Forms:
    """Random forms at one frequency, whose best weights miss the level by a factor."""
    rng = np.random.default_rng(seed)
    target = rng.normal(size=4) + 1j * rng.normal(size=4)
    near = target + 0.2 * (rng.normal(size=4) + 1j * rng.normal(size=4))
    form = np.outer(near.conj(), near) + 0.01 * np.diag(np.abs(near) ** 2)
    best = np.linalg.solve(form, target.conj())
    level = abs(target @ best) / np.abs(best).max()
    assert short * level < np.abs(target).sum()
    power = np.outer(target.conj(), target)
    return Forms(
        targets=target[None, None].astype(np.complex64),
        target_power=power[None, None].astype(np.complex64),
        quiet=form[None, None].astype(np.complex64),
        threshold=np.ones(1, dtype=np.float32),
        wanted=short * level,
        level_margin=0.0,
    )


def _optimum(forms: Forms) -> float:
    """The best score within full stroke, by sequential quadratic programming."""
    target, form = forms.targets[0, 0].astype(complex), forms.quiet[0, 0].astype(complex)
    n = len(target)

    def weights(x):
        return x[:n] + 1j * x[n:]

    def power(x):
        return float((weights(x).conj() @ form @ weights(x)).real)

    limits = [
        {"type": "ineq", "fun": lambda x: 1 - np.abs(weights(x)) ** 2},
        {"type": "ineq", "fun": lambda x: (target @ weights(x)).real - forms.wanted},
        {"type": "eq", "fun": lambda x: (target @ weights(x)).imag},
    ]
    loud = target.conj() / np.abs(target)
    start = np.concatenate([loud.real, loud.imag]) * 0.99
    found = minimize(power, start, constraints=limits, method="SLSQP", options={"maxiter": 500})
    assert found.success
    return float(abs(target @ weights(found.x)) / np.sqrt(power(found.x)))


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("short", [1.1, 1.4])
def test_level_beyond_the_best_weights_costs_no_more_than_it_must(seed: int, short: float) -> None:
    """The drive reaches the level within full stroke, half a decibel from the best at most."""
    forms = _forms(seed, short)
    (score, drive), *_ = find_drives(forms, "phased")
    assert np.abs(drive.values).max() <= 1 + 1e-6
    assert abs(forms.targets[0, 0] @ drive.values) >= 0.999 * forms.wanted
    assert 20 * np.log10(_optimum(forms) / score) < 0.5


def sources(seed):
    """Powers of 40 sources at 80 quiet fingertips."""
    return np.random.default_rng(seed).exponential(size=(40, 80))


@pytest.mark.parametrize("seed", range(4))
def test_dual_weights_reach_the_primal_optimum(seed):
    """The primal program has the same value, to a thousandth."""
    relative = sources(seed)
    n, points = relative.shape
    primal = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([relative.T, -np.ones(points)]),
        b_ub=np.zeros(points),
        A_eq=[np.append(np.ones(n), 0.0)],
        b_eq=[1.0],
        method="highs-ipm",
    )
    share = dual_weights(np.ones(n), relative)
    bound = 1 / (relative @ share).min()
    assert share.sum() == pytest.approx(1.0)
    assert (share >= 0).all()
    assert 1 / primal.fun <= bound * (1 + 1e-9)
    assert bound == pytest.approx(1 / primal.fun, rel=2e-3)
