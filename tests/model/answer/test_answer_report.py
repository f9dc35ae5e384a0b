"""Measures of answers, their exposure, and questions in JSON."""

import errno
import re
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from kit.plates import make_paper_rig, smooth_rig, smooth_table
from kit.set_table import only, phased, wants
from model.answer.answer_report import (
    Timing,
    exposures,
    hand_weighting,
    measures,
    query_batch,
)
from model.answer.plan import query
from model.answer.stimulus import Finger, Placement
from model.arrays import lattice
from model.commands.table_cli import query as query_command
from model.finger import detection_threshold, fingertip_points
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Uncertainty
from model.structure.attachments import footprints_of
from model.table.table_file import build_table, save_table
from model.transients.base_motion import ramped_ending, ramped_onset, shaped
from model.transients.plate_in_time import plate_in_time
from model.transients.shaping import Transients

PUBLISHED = {
    6.3: 0.727, 8: 0.873, 10: 0.951, 12.5: 0.958, 16: 0.896, 20: 0.782, 25: 0.647, 31.5: 0.519,
    40: 0.411, 50: 0.324, 63: 0.256, 80: 0.202, 100: 0.160, 125: 0.127, 160: 0.101, 200: 0.0799,
    250: 0.0634, 315: 0.0503, 400: 0.0398, 500: 0.0314, 630: 0.0245, 800: 0.0186, 1000: 0.0135,
    1250: 0.00894,
}  # fmt: skip
"""Factors of ISO 5349-1:2001, table A.2, at the nominal frequencies of third octaves [Hz]."""


def test_hand_weighting_is_that_of_the_standard():
    """Its table is of the exact frequencies, 10^(n/10)."""
    nominal = np.array([*PUBLISHED])
    exact = 10 ** (np.round(10 * np.log10(nominal)) / 10)
    assert hand_weighting(exact) == pytest.approx([*PUBLISHED.values()], rel=5e-3)


def test_exposure_is_the_weighted_rms_of_the_vibration_of_a_finger():
    """By levels above threshold: of a content alone, and of what two leak to a quiet finger.

    A finger's own content counts at its loudest point, up to 6 dB above the mean of its level.
    """
    table = smooth_table()
    served, louder = (
        phased(
            table,
            [wants((0.09, 0.07), level_db_sl=level), wants((0.25, 0.18), level_db_sl=level)],
            [Finger((0.16, 0.20))],
        )
        for level in (20.0, 26.0)
    )
    hertz = np.array([layer.frequency for layer in served.layers])
    weighted = hand_weighting(hertz) * detection_threshold(hertz) / np.sqrt(2)

    *own, quiet = exposures(table, served)
    louder_exposures = exposures(table, louder)

    for number, exposure in enumerate(own):
        level = served.fingers[number].promised_level_db_sl
        mean = weighted[number] * 10 ** (level / 20)
        assert mean < exposure < 2.5 * mean, number
    crosstalk = 10 ** (served.fingers[2].foreign_level_db_sl / 20)
    assert min(weighted) * crosstalk <= quiet <= max(weighted) * crosstalk
    expected = 10 ** (6 / 20) * np.array([*own, quiet])
    np.testing.assert_allclose(louder_exposures, expected, rtol=1e-3)


PLATE = smooth_rig().plate
AREA = PLATE.length * PLATE.width


def test_concentration_agrees_with_points_counted_one_by_one():
    """Two targets, from points 1.7 mm apart."""
    table = smooth_table()
    targets = ((0.09, 0.08), (0.24, 0.14))
    answer = query(table, Placement(targets), drive_mode="phased")

    concentration = measures(table, answer).concentration

    excitation = answer.layers[0].excitation
    columns = np.arange(0.0008, PLATE.length, 0.0017)
    points = lattice(columns, np.arange(0.0008, PLATE.width, 0.0017))
    frequencies, amplitudes = table.amplitudes(excitation, points)
    energy = ((amplitudes / frequencies[:, None]) ** 2).sum(axis=0)
    peak = amplitudes.sum(axis=0)
    means = []
    for target in targets:
        _, at_fingertip = table.amplitudes(excitation, fingertip_points(*target, PLATE))
        means.append(at_fingertip.sum(axis=0).mean())
    felt = min(means)
    distances = [np.linalg.norm(points - target, axis=1) for target in targets]
    is_near = np.min(distances, axis=0) <= 0.05
    far = np.sort(peak[~is_near])
    contrast = 20 * np.log10(felt / far[int(0.95 * len(far))])
    assert concentration.contrast_95_db == pytest.approx(contrast, abs=0.1)
    area = np.mean(peak > felt / 2) * AREA
    assert concentration.area_above_half == pytest.approx(area, rel=0.02)
    energy_share = energy[is_near].sum() / energy.sum()
    assert concentration.energy_share_near == pytest.approx(energy_share, abs=0.01)


PLACED = Placement(((0.09, 0.07),), ((0.25, 0.18), (0.05, 0.19)))


@pytest.fixture(scope="module")
def rig():
    """A mesh that is quick to solve, and weightless fingers, as on the plate in time."""
    tolerances = replace(Uncertainty.none(), gain=0.05, phase_deg=5.0)
    return replace(make_paper_rig(24, 18), fingertip=None, uncertainty=tolerances)


@pytest.fixture(scope="module")
def table(rig):
    """A few frequencies are enough to choose among."""
    return build_table(rig, frequencies=np.array([90.0, 130.0, 220.0, 300.0]), drive_mode="phased")


def test_transient_measures_agree_with_another_solution_of_the_plate(rig, table):
    """Measures of ramps and envelopes agree with those of the plate in time, without the table.

    Envelopes do better with the same excitation.
    """
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras), frequency_max=300.0)
    plate = Transients(plate_in_time(reduced, rig.eras))
    timing = Timing(table)
    plain, _ = only(table, PLACED, drive_mode="phased")

    shaped_layer = timing.with_envelopes(plain, PLACED)

    assert plain.onset is plain.ending is None
    assert shaped_layer.excitation == plain.excitation
    ramped = (
        ramped_onset(plain.excitation, rig.eras, ramp=0.040),
        ramped_ending(plain.excitation, rig.eras, ramp=0.040),
    )
    enveloped = (shaped(shaped_layer.onset, rig.eras), shaped(shaped_layer.ending, rig.eras))
    contrasts = []
    residuals = []
    for layer, (onset, ending) in ((plain, ramped), (shaped_layer, enveloped)):
        contrast = timing.transient_contrast_db(layer, PLACED)
        residual = timing.residual_db(layer, PLACED)
        in_time = plate.contrast_db(onset, targets=PLACED.targets, quiet=PLACED.quiet)
        residual_in_time = plate.residual_db(layer.excitation, ending)
        assert contrast == pytest.approx(in_time, abs=0.1)
        assert residual == pytest.approx(residual_in_time, abs=0.2)
        contrasts.append(contrast)
        residuals.append(residual)
    assert contrasts[1] > contrasts[0] + 3
    assert residuals[1] < residuals[0] - 10


BAD_LINES = {
    "nonsense": r'such as \{"target".*Invalid JSON',
    "[]": "object",
    '{"target": [0.1]}': "target",
    '{"target": [0.1, 0.1], "loud": 3}': "loud",
    '{"target": [0.1, "x"]}': "target.1",
    '{"target": [0.1, 0.1], "targets": [[0.2, 0.1]]}': "target must be given without targets",
    "{}": "at least one finger",
}
GOOD_LINE = (
    '{"targets": [[0.1, 0.1], [0.2, 0.2]], "quiet": [[0.05, 0.02]], "mode": "switched",'
    ' "level_db_sl": 15, "loads": [1, 2, 0.5]}'
)


def test_batch_reports_the_wrong_key_of_a_line():
    """With the number of the line."""
    *errors, _ = query_batch(smooth_table(), [*BAD_LINES, GOOD_LINE])

    assert [row["line"] for row in errors] == [1, 2, 3, 4, 5, 6, 7]
    for row, named in zip(errors, BAD_LINES.values(), strict=True):
        assert re.search(named, row["error"])


def test_batch_reads_a_line_key_by_key():
    """Targets, quiet fingers, mode, level and loads."""
    (row,) = query_batch(smooth_table(), [GOOD_LINE])

    placed = Placement(((0.1, 0.1), (0.2, 0.2)), ((0.05, 0.02),), (1.0, 2.0, 0.5))
    layer, sensation = only(smooth_table(), placed, 15.0, drive_mode="switched")
    (row_layer,) = row["layers"]
    assert row_layer["drive"] == smooth_table().drive_of(layer.excitation)
    assert row_layer["fingers"] == [0, 1]
    contrast = row["fingers"][0]["promised_contrast_db"]
    assert contrast == sensation.promised_contrast_db


def test_batch_reports_a_closed_pipe_and_no_broken_file(tmp_path, monkeypatch):
    """As in `era table query TABLE --batch FILE | head`."""
    batch = tmp_path / "b.jsonl"
    batch.write_text('{"target": [0.1, 0.1]}\n')
    file = tmp_path / "t.npz"
    save_table(smooth_table(), file)
    broken = Mock(side_effect=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    monkeypatch.setattr("builtins.print", broken)

    with pytest.raises(BrokenPipeError):
        query_command(file, batch=batch)
