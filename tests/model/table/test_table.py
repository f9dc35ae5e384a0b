"""Patterns of a localization table against the direct solve of every tone."""

import numpy as np
import pytest

from model.drive_modes.sources import all_combinations, magnitudes_of_sources, sums_of_sources
from model.fem.plate import assemble, direct_acceleration
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import detection_threshold
from model.structure.attachments import FingertipLoad
from model.table.question import Question
from model.vibration.excitation import tone_amplitudes
from paper_table import contact_sets, smooth_rig, smooth_table

TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18),)


def test_all_patterns_are_those_of_the_paper():
    """Four ERAs alone and six pairs at 27 frequencies: 4 * 27 + 6 * 27² = 4482 different ones."""
    patterns = all_combinations(4, 27).index
    assert len(np.unique(patterns, axis=0)) == len(patterns) == 4482
    assert set((patterns >= 0).sum(axis=1)) == {1, 2}


def test_sums_of_sources_add_up_the_tones_of_each_pattern():
    """Row by row, the vectorised sum equals Eq. 28 written out for that pattern."""
    rng = np.random.default_rng(0)
    response = rng.normal(size=(5, 3, 4)) + 1j * rng.normal(size=(5, 3, 4))
    fast = sums_of_sources(magnitudes_of_sources(response).T, 3).T
    for row, pattern in zip(fast, all_combinations(3, 5).index, strict=True):
        slow = np.zeros(4)
        for frequency in range(5):
            slow += np.abs(response[frequency, pattern == frequency].sum(axis=0))
        np.testing.assert_allclose(row, slow)


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_query_predicts_what_the_direct_solver_finds(mode):
    """Level, contrast and the loudest quiet level, by the sparse direct solve with fingers on."""
    rig, table = smooth_rig(), smooth_table()
    target, *quiet = places = contact_sets(1, fingers=4, seed=2)[0]
    pattern = table.query(Question((target,), tuple(quiet), level_db_sl=17.0, drive_mode=mode))
    points = np.concatenate([fingertip_points(*place, rig.plate) for place in places])
    matrices = assemble(rig.plate, rig.mesh)

    fingers = [FingertipLoad(*place, rig.fingertip) for place in places]
    frequencies, amplitudes = tone_amplitudes(
        pattern.excitation,
        rig.eras,
        lambda f: direct_acceleration(matrices, rig.eras, f, points, loads=fingers),
    )
    weights = fingertip_weights(*target, rig.plate)
    count = len(weights)
    above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
    peak = amplitudes.sum(axis=0)
    level = 20 * np.log10(above[:count] @ weights)
    assert pattern.level_db_sl == pytest.approx(level, abs=0.03)
    assert pattern.robust_level_db_sl == pytest.approx(17.0)
    assert pattern.quiet_level_db_sl == pytest.approx(20 * np.log10(above[count:].max()), abs=0.1)
    contrast = 20 * np.log10(peak[:count] @ weights / peak[count:].max())
    assert pattern.contrast_db == pytest.approx(contrast, abs=0.1)


def test_query_scales_the_drive_with_the_level():
    """A softer level admits every pattern; 1 dB less is 0.89 of the stroke of the same ERAs."""
    loud, less, soft = (
        smooth_table().query(Question(((0.1, 0.1),), ((0.2, 0.1),), level_db_sl=level))
        for level in (20.0, 19.0, -20.0)
    )
    assert soft.robust_felt_contrast_db >= loud.robust_felt_contrast_db - 0.5
    assert less.contrast_db == pytest.approx(loud.contrast_db)
    assert less.excitation.keys() == loud.excitation.keys()
    for name, tone in less.excitation.items():
        assert tone.amplitude == pytest.approx(loud.excitation[name].amplitude * 10 ** (-1 / 20))
