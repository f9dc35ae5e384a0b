"""Drive modes: what each finds is the best there is, by other ways of looking for it."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import minimize

from kit.plates import by_hand, contact_sets, forms_of, smooth_table
from model import phased_weights, switched_patterns
from model.answer.stimulus import Placement
from model.arrays import NEARLY, Complex64Array
from model.drive_forms import Forms
from model.drive_modes import playable_drive_modes
from model.finger import fingertip_points
from model.rig.rig import Uncertainty

SIGMA = 0.1
"""Relative error of each ERA's contribution."""


def random_forms(
    seed: int,
    *,
    frequencies: int = 5,
    eras: int = 3,
    targets: int = 1,
    points: int = 3,
    quiet: int = 6,
    wanted: float = 1e-6,
) -> Forms:
    """Complex normal fields at points of quiet fingertips, thresholds between 0.5 and 2."""
    rng = np.random.default_rng(seed)

    def field(*shape: int) -> Complex64Array:
        parts = rng.standard_normal((2, *shape, eras))
        return (parts[0] + 1j * parts[1]).astype(np.complex64)

    threshold = rng.uniform(0.5, 2.0, frequencies).astype(np.float32)
    at_targets = field(targets, frequencies)
    at_quiet = field(frequencies, quiet, points)
    forms = at_quiet.conj().swapaxes(2, 3) @ at_quiet / np.float32(points)
    own = np.einsum("fqii->fqi", forms)
    own *= 1 + SIGMA**2
    power = at_targets.conj()[..., :, None] * at_targets[..., None, :]
    return Forms(at_targets, power, forms, threshold, wanted, level_margin=0.0)


F, E = 5, 3


def forms_on_plate(places, *, targets=1, level=12.0):
    """Forms of fingertips on the paper's plate."""
    placed = Placement(tuple(places[:targets]), tuple(places[targets:]))
    return forms_of(smooth_table(), placed, level)


def test_the_loudest_point_of_a_quiet_fingertip_counts_as_modeled():
    """Of a rig that is known exactly, in place of the mean of a few points."""
    (places,) = contact_sets(1, fingers=3, seed=8)
    known = replace(smooth_table(), uncertainty=Uncertainty.none())
    given = forms_of(known, Placement((places[0],), tuple(places[1:])))
    rng = np.random.default_rng(0)
    weights = (rng.standard_normal((27, 4)) + 1j * rng.standard_normal((27, 4))).astype("c8")
    power = given.quiet_power(weights)
    for frequency, finger in ((3, 0), (20, 1)):
        w = weights[frequency]
        expected = (w.conj() @ given.quiet[frequency, finger] @ w).real
        points = fingertip_points(*places[1 + finger], smooth_table().plate)
        fields = smooth_table().unit_fields(points, contacts=places)[frequency]
        loudest = (np.abs(w @ fields) ** 2).max()
        few = (np.abs(given.few[frequency, finger] @ w) ** 2).sum()
        assert power[frequency, finger] == pytest.approx(expected + loudest - few, rel=2e-3)


MODES = ("switched", "phased")


def found_in(mode, given):
    """The scores and drives that a mode finds, the best first; none where none reach the level."""
    if mode == "switched":
        return switched_patterns.find_switched(given)
    found = phased_weights.search(given)
    order = [at for at in np.argsort(-found.score).tolist() if found.score[at] > 0]
    return [(float(found.score[at]), [(at, found.weights[at])]) for at in order]


HIGHEST = {
    "switched": switched_patterns.max_sensation_switched,
    "phased": phased_weights.max_sensation,
}
"""Of a mode, the highest amplitude to threshold."""


def found_alone(mode, given):
    """The best drive of a mode."""
    return found_in(mode, given)[0][1]


@pytest.mark.parametrize("quiet", [1, 6])
@pytest.mark.parametrize("targets", [1, 2])
@pytest.mark.parametrize(
    ("wanted", "batch"), [(1e-6, 4), (1.8, 4), (2.5, 4), (1e-6, 512), (2.5, 512)]
)
def test_find_switched_equals_brute_force(quiet, targets, wanted, batch, monkeypatch):
    """One or two ERAs of three at five frequencies: the best, each once, of all tried by hand."""
    monkeypatch.setattr(switched_patterns, "BATCH", batch)
    for seed in range(5):
        given = random_forms(seed, targets=targets, quiet=quiet, wanted=wanted)
        scores = []
        for index in product([None, *range(F)], repeat=E):
            if 1 <= sum(i is not None for i in index) <= 2:
                drive = [
                    (row, np.array([i == row for i in index]).astype(np.complex64))
                    for row in {*index} - {None}
                ]
                score, level = by_hand(given, drive)
                scores += [score] if level >= wanted else []
        best = sorted(scores, reverse=True)[: switched_patterns.ALTERNATIVES]
        found = switched_patterns.find_switched(given)
        assert [score for score, _ in found] == pytest.approx(best, rel=1e-5)
        for score, drive in found:
            by, level = by_hand(given, drive)
            assert by == pytest.approx(score, rel=1e-5)
            assert level >= wanted * (1 - 1e-5)


def test_phased_equals_closed_form():
    """One target, one quiet fingertip: the largest Rayleigh quotient of h h^H by R."""
    for seed in range(8):
        given = random_forms(seed, quiet=1, eras=3)
        best = 0.0
        for f in range(F):
            R, t = given.quiet[f, 0].astype(complex), given.targets[0, f].astype(complex)
            best = max(best, np.sqrt((t @ np.linalg.solve(R, t.conj())).real))
        assert by_hand(given, found_alone("phased", given))[0] == pytest.approx(best, rel=1e-3)


def test_weights_are_not_improved_by_nelder_mead():
    """On the plate with two quiet fingers the three iterations are within 4 % (0.34 dB).

    Of the best score at a frequency by a general optimizer, of real and imaginary parts.
    """
    (places,) = contact_sets(1, fingers=3, seed=4)
    given = forms_on_plate(places, level=-60.0).at(np.array([2, 9, 16]))
    rng = np.random.default_rng(0)
    options = {"maxiter": 800, "xatol": 1e-4, "fatol": 1e-4}
    best = [
        minimize(
            lambda x, f=f: -by_hand(given, [(f, x[:4] + 1j * x[4:])])[0],
            rng.standard_normal(8),
            method="Nelder-Mead",
            options=options,
        ).fun
        for f in range(3)
    ]
    assert by_hand(given, found_alone("phased", given))[0] >= -0.96 * min(best)


@pytest.mark.parametrize("seed", range(4))
def test_weights_satisfy_the_constraints_of_their_mode(seed):
    """Switched: full stroke; none above 1."""
    given = random_forms(seed)
    switched, phased = (found_alone(mode, given) for mode in MODES)
    assert {abs(each) for _, weights in switched for each in weights.tolist()} <= {0.0, 1.0}
    assert np.abs(phased[0][1]).max() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_best_drives_come_first(mode):
    """Scores are those of the drives by hand, none above the one before, all reaching the level."""
    for places in contact_sets(4, fingers=3, seed=11):
        given = forms_on_plate(places)
        found = found_in(mode, given)
        assert len(found) >= 4
        scores = [score for score, _ in found]
        assert (np.diff(scores) <= NEARLY * np.array(scores[:-1])).all()
        for score, drive in found:
            by, level = by_hand(given, drive)
            assert score == pytest.approx(by, rel=1e-3)
            assert level >= given.wanted * (1 - 1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_max_sensation_is_reached_and_not_exceeded(mode):
    """Just below the highest level a drive is found, a tenth above none."""
    for places in contact_sets(5, fingers=2, seed=5):
        given = replace(forms_on_plate(places), level_margin=0.0)
        most = HIGHEST[mode](given)
        found = found_in(mode, replace(given, wanted=0.999 * most))
        assert by_hand(given, found[0][1])[1] >= 0.999 * most * (1 - 1e-5)
        assert found_in(mode, replace(given, wanted=1.1 * most)) == []


def test_max_sensation_includes_two_tones():
    """Two ERAs that each move the target at a frequency of their own are felt sqrt(2) as much.

    No weights of up to full stroke give more than the sum of the magnitudes.
    """
    target = np.eye(2, dtype=np.complex64)[None]
    power = (np.eye(2)[:, :, None] * np.eye(2)[:, None])[None].astype(np.complex64)
    quiet = np.tile(0.01 * np.eye(2, dtype=np.complex64), (2, 1, 1, 1))
    given = Forms(target, power, quiet, np.ones(2, dtype=np.float32), 1.0, level_margin=0.0)
    assert HIGHEST["switched"](given) == pytest.approx(np.sqrt(2), rel=1e-4)
    given = random_forms(2)
    sums = np.abs(given.targets[0]).sum(axis=1) / given.threshold
    assert HIGHEST["phased"](given) == pytest.approx(sums.max(), rel=1e-4)


def test_an_only_era_is_switched_at_its_best_frequency():
    """By hand: contrasts of 2, 4, 3 and of 8 below the level; the highest level is 5."""
    target = np.array([2, 4, 3, 0.8], dtype=np.complex64).reshape(1, 4, 1)
    quiet = np.array([1, 1, 1, 0.01], dtype=np.complex64).reshape(4, 1, 1, 1)
    threshold = np.array([1, 1, 0.6, 1], dtype=np.float32)
    power = (target * target)[..., None]
    given = Forms(target, power, quiet, threshold, wanted=1.5, level_margin=0.0)
    found = switched_patterns.find_switched(given)
    assert [score for score, _ in found] == pytest.approx([4, 3, 2])
    assert [drive[0][0] for _, drive in found] == [1, 2, 0]
    assert [drive[0][1].tolist() for _, drive in found] == [[1]] * 3
    assert HIGHEST["switched"](given) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("level_step", "phase_step", "richest"),
    [
        (1.0, 1.0, "switched"),
        (0.01, 360.0, "switched"),
        (0.01, 45.0, "switched"),
        (1 / 4096, 0.1, "phased"),
    ],
)
def test_playable_drive_modes_follow_from_steps(level_step, phase_step, richest):
    """Without levels or fine phases only switching is left."""
    assert playable_drive_modes(level_step=level_step, phase_step=phase_step)[-1] == richest
