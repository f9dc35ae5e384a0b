"""Drive modes: each finds the best drives, compared with other ways to look for them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from kit.plates import by_hand, contact_sets, forms_of, make_paper_rig, smooth_table
from model import phased_weights, switched_patterns
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import Complex64Array, Point
from model.drive_forms import Forms, WeightedTones
from model.drive_modes import playable_drive_modes
from model.table.table_file import build_table

FREQUENCY_COUNT, ERA_COUNT, POINT_COUNT = 5, 3, 3
SIGMA = 0.1
"""Relative error of each ERA's contribution."""
MODES = ("switched", "phased")


def complex_normal(rng: np.random.Generator, *shape: int) -> Complex64Array:
    """Return complex normal numbers."""
    parts = rng.standard_normal((2, *shape))
    return np.asarray(parts[0] + 1j * parts[1], dtype=np.complex64)


def random_forms(seed: int, *, targets: int = 1, quiet: int = 6, wanted: float = 1e-6) -> Forms:
    """Return forms of complex normal fields at quiet fingertips; thresholds are 0.5 to 2."""
    rng = np.random.default_rng(seed)
    thresholds = rng.uniform(0.5, 2.0, FREQUENCY_COUNT).astype(np.float32)
    at_targets = complex_normal(rng, targets, FREQUENCY_COUNT, ERA_COUNT)
    at_quiet = complex_normal(rng, FREQUENCY_COUNT, quiet, POINT_COUNT, ERA_COUNT)
    quiet_forms = at_quiet.conj().swapaxes(2, 3) @ at_quiet / np.float32(POINT_COUNT)
    diagonal = np.einsum("fqii->fqi", quiet_forms)
    diagonal *= 1 + SIGMA**2
    target_forms = at_targets.conj()[..., :, None] * at_targets[..., None, :]
    return Forms(at_targets, target_forms, quiet_forms, thresholds, wanted, level_margin=0.0)


def forms_on_plate(places: Sequence[Point], *, level: float = 12.0) -> Forms:
    """Return forms on the paper's plate, of a target and quiet fingers."""
    placed = Placement(tuple(places[:1]), tuple(places[1:]))
    return forms_of(smooth_table(), placed, level)


def scored_drives(mode: str, forms: Forms) -> list[tuple[float, WeightedTones]]:
    """Return the scores and drives that a mode finds, the best first; none without the level."""
    if mode == "switched":
        return switched_patterns.find_switched(forms)
    tones = phased_weights.search(forms)
    drives = []
    for row in np.argsort(-tones.score).tolist():
        if tones.score[row] > 0:
            drives.append((float(tones.score[row]), [(row, tones.weights[row])]))
    return drives


def best_score(mode: str, forms: Forms) -> float:
    """Return the score of a mode's best drive, computed by hand."""
    _, drive = scored_drives(mode, forms)[0]
    score, _ = by_hand(forms, drive)
    return score


HIGHEST_LEVELS = {
    "switched": switched_patterns.max_sensation_switched,
    "phased": phased_weights.max_sensation,
}
"""Of a mode, the highest ratio of amplitude to threshold."""


def switched_scores(forms: Forms, wanted: float) -> list[float]:
    """Return the scores of all drives with one or two ERAs that reach a level, best first."""
    scores = []
    for rows in product([None, *range(FREQUENCY_COUNT)], repeat=ERA_COUNT):
        driven = set(rows) - {None}
        if rows.count(None) not in (ERA_COUNT - 1, ERA_COUNT - 2):
            continue
        drive = []
        for row in driven:
            weights = [era_row == row for era_row in rows]
            drive.append((row, np.array(weights, dtype=np.complex64)))
        score, level = by_hand(forms, drive)
        if level >= wanted:
            scores.append(score)
    return sorted(scores, reverse=True)


@pytest.mark.parametrize("quiet", [1, 6])
@pytest.mark.parametrize("targets", [1, 2])
@pytest.mark.parametrize(
    ("wanted", "batch"), [(1e-6, 4), (1.8, 4), (2.5, 4), (1e-6, 512), (2.5, 512)]
)
def test_find_switched_equals_brute_force(
    quiet: int, targets: int, wanted: float, batch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best drives of one or two ERAs of three at five frequencies, each once."""
    monkeypatch.setattr(switched_patterns, "BATCH", batch)

    for seed in range(3):
        forms = random_forms(seed, targets=targets, quiet=quiet, wanted=wanted)
        drives = switched_patterns.find_switched(forms)

        best = switched_scores(forms, wanted)[: switched_patterns.ALTERNATIVES]
        assert [score for score, _ in drives] == pytest.approx(best, rel=1e-5), seed
        for score, drive in drives:
            expected, level = by_hand(forms, drive)
            assert score == pytest.approx(expected, rel=1e-5)
            assert level >= wanted * (1 - 1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_phased_weights_have_the_score_of_the_closed_form(seed: int) -> None:
    """A target and a quiet fingertip: the largest Rayleigh quotient of h h^H by R."""
    forms = random_forms(seed, quiet=1)

    score = best_score("phased", forms)

    quotients = []
    for row in range(FREQUENCY_COUNT):
        quiet = forms.quiet[row, 0].astype(complex)
        target = forms.targets[0, row].astype(complex)
        quotient = target @ np.linalg.solve(quiet, target.conj())
        quotients.append(quotient.real)
    assert score == pytest.approx(np.sqrt(max(quotients)), rel=1e-3)


@pytest.mark.parametrize("mode", MODES)
def test_highest_level_is_reached_and_not_exceeded(mode: str) -> None:
    """A drive reaches slightly less than the highest level; none reaches a tenth more."""
    for places in contact_sets(5, fingers=2, seed=5):
        forms = replace(forms_on_plate(places), level_margin=0.0)

        highest = HIGHEST_LEVELS[mode](forms)

        _, drive = scored_drives(mode, replace(forms, wanted=0.999 * highest))[0]
        _, level = by_hand(forms, drive)
        assert level >= 0.999 * highest * (1 - 1e-5)
        assert scored_drives(mode, replace(forms, wanted=1.1 * highest)) == []


def test_highest_switched_level_includes_two_tones() -> None:
    """Two ERAs that move the target at a frequency each are felt sqrt(2) as much."""
    unit = np.eye(2, dtype=np.complex64)
    power = (unit[:, :, None] * unit[:, None])[None]
    quiet = np.tile(0.01 * unit, (2, 1, 1, 1))
    thresholds = np.ones(2, dtype=np.float32)
    forms = Forms(unit[None], power, quiet, thresholds, 1.0, level_margin=0.0)

    assert HIGHEST_LEVELS["switched"](forms) == pytest.approx(np.sqrt(2), rel=1e-4)


@pytest.mark.parametrize("band_hz", [(40.0, 40.0), (170.0, 170.0), (40.0, 60.0)])
def test_phased_promises_at_least_as_much_as_switched(band_hz: tuple[float, float]) -> None:
    """Weights of 0 and 1 are phased ones, so freer drives cannot promise less.

    At 40 Hz, second harmonics dominate at quiet fingers.
    """
    table = build_table(make_paper_rig(12, 9), frequencies=np.arange(40.0, 201.0, 10.0))
    gains = []
    for places in [*contact_sets(6, fingers=3, seed=5), *contact_sets(6, fingers=4, seed=5)]:
        placed = Placement((places[0],), tuple(places[1:]))
        worst = {}
        for mode in MODES:
            answer = query(table, placed, 14.0, drive_mode=mode, band_hz=band_hz)
            assert answer.is_reached
            assert answer.promised_worst_db is not None
            worst[mode] = answer.promised_worst_db
        gains.append(worst["phased"] - worst["switched"])

    assert min(gains) >= -0.01
    assert np.mean(gains) > 1.0


@pytest.mark.parametrize(
    ("level_step", "phase_step", "richest"),
    [
        (1.0, 1.0, "switched"),
        (0.01, 45.0, "switched"),
        (1 / 4096, 0.1, "phased"),
    ],
)
def test_playable_drive_modes_follow_from_steps(
    level_step: float, phase_step: float, richest: str
) -> None:
    """Amplifiers without levels or fine phases can only switch."""
    *_, mode = playable_drive_modes(level_step=level_step, phase_step=phase_step)

    assert mode == richest
