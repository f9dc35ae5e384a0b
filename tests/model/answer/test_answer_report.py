"""Measures of answers on request, their exposure, and questions as JSON and on the command line."""

import errno
import re
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from kit.plates import make_paper_rig, smooth_rig, smooth_table
from kit.set_table import only, wants
from kit.set_table import phased as answer
from model.answer.answer_report import (
    Timing,
    cell_centers,
    concentration_of,
    exposures,
    hand_weighting,
    measures,
    query_batch,
)
from model.answer.plan import query
from model.answer.stimulus import Finger, Placement
from model.arrays import lattice
from model.commands.table_cli import query as query_command
from model.finger import detection_threshold, fingertip_points, is_beyond
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Uncertainty
from model.structure.attachments import footprints_of
from model.table.table_file import build_table, save_table
from model.transients.base_motion import ramped_ending, ramped_onset, shaped
from model.transients.shaping import Transients
from model.transients.time_response import plate_in_time

PUBLISHED = {
    6.3: 0.727, 8: 0.873, 10: 0.951, 12.5: 0.958, 16: 0.896, 20: 0.782, 25: 0.647, 31.5: 0.519,
    40: 0.411, 50: 0.324, 63: 0.256, 80: 0.202, 100: 0.160, 125: 0.127, 160: 0.101, 200: 0.0799,
    250: 0.0634, 315: 0.0503, 400: 0.0398, 500: 0.0314, 630: 0.0245, 800: 0.0186, 1000: 0.0135,
    1250: 0.00894,
}  # fmt: skip
"""Factors of ISO 5349-1:2001, table A.2, at the nominal frequencies of third octaves [Hz]."""


def test_weighting_is_that_of_the_standard():
    """Its table is of the exact frequencies, 10^(n/10)."""
    nominal = np.array([*PUBLISHED])
    exact = 10 ** (np.round(10 * np.log10(nominal)) / 10)
    assert hand_weighting(exact) == pytest.approx([*PUBLISHED.values()], rel=5e-3)


def test_exposure_is_the_weighted_root_mean_square_of_all_that_a_finger_feels():
    """By levels above threshold: of a content alone, of what leaks, and of two together.

    A finger's own content counts at its loudest point, up to 6 dB above the mean of its level.
    """
    table = smooth_table()
    found, louder = (
        answer(
            table,
            [wants(at, level_db_sl=level) for at in ((0.09, 0.07), (0.25, 0.18))],
            [Finger((0.16, 0.20))],
        )
        for level in (20.0, 26.0)
    )
    hertz = np.array([layer.frequency for layer in found.layers])
    weighted = hand_weighting(hertz) * detection_threshold(hertz) / np.sqrt(2)
    *own, quiet = exposures(table, found)
    for exposure, each, alone in zip(own, found.fingers, weighted, strict=False):
        mean = alone * 10 ** (each.promised_level_db_sl / 20)
        assert mean < exposure < 2.5 * mean
    heard = 10 ** (found.fingers[2].foreign_level_db_sl / 20)
    assert min(weighted) * heard <= quiet <= max(weighted) * heard
    assert exposures(table, louder) == pytest.approx(
        [10 ** (6 / 20) * each for each in (*own, quiet)], rel=1e-3
    )


TARGET = (0.15, 0.12)
PLATE = smooth_rig().plate
AREA = PLATE.length * PLATE.width
POINTS = cell_centers(PLATE)


def concentration(*amplitudes, frequencies=(100.0,)):
    """Concentration of amplitudes (f, p) at the centers of cells, 1 m/s² at the target."""
    field = np.array(amplitudes, dtype=float)
    return concentration_of(
        np.array(frequencies), field, ~is_beyond(POINTS, [TARGET]), felt=1.0, plate=PLATE
    )


def test_concentration_agrees_with_points_counted_one_by_one():
    """Two targets, from points 1.7 mm apart; with quiet fingers there is no concentration."""
    table = smooth_table()
    places = ((0.09, 0.08), (0.24, 0.14))
    answer = query(table, Placement(places), drive_mode="phased")
    layer = answer.layers[0]
    points = lattice(*(np.arange(0.0008, side, 0.0017) for side in (PLATE.length, PLATE.width)))
    frequencies, amplitudes = table.amplitudes(layer.excitation, points)
    energy = ((amplitudes / frequencies[:, None]) ** 2).sum(axis=0)
    peak = amplitudes.sum(axis=0)
    discs = [fingertip_points(*place, PLATE) for place in places]
    felt = min(table.amplitudes(layer.excitation, disc)[1].sum(axis=0).mean() for disc in discs)
    near = np.min([np.hypot(*(points - place).T) for place in places], axis=0) <= 0.05
    far = np.sort(peak[~near])
    found = measures(table, answer).concentration
    contrast = 20 * np.log10(felt / far[int(0.95 * len(far))])
    assert found.contrast_95_db == pytest.approx(contrast, abs=0.1)
    assert found.area_above_half == pytest.approx((peak > felt / 2).mean() * AREA, rel=0.02)
    assert found.energy_share_near == pytest.approx(energy[near].sum() / energy.sum(), abs=0.01)
    answer = query(table, Placement(places[:1], places[1:]), drive_mode="phased")
    assert measures(table, answer).concentration is None


PLACED = Placement(((0.09, 0.07),), ((0.25, 0.18), (0.05, 0.19)))


@pytest.fixture(scope="module")
def rig():
    """A mesh that is quick to solve, and weightless fingers, as on the plate in time."""
    known = replace(Uncertainty.none(), gain=0.05, phase_deg=5.0)
    return replace(make_paper_rig(24, 18), fingertip=None, uncertainty=known)


@pytest.fixture(scope="module")
def table(rig):
    """A few frequencies are enough to choose among."""
    return build_table(rig, frequencies=np.array([90.0, 130.0, 220.0, 300.0]), drive_mode="phased")


def test_transient_measures_agree_with_another_solution_of_the_plate(rig, table):
    """Measures of ramps and envelopes agree with those of the plate in time, without the table.

    Envelopes do better with the same excitation.
    """
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras), frequency_max=300.0)
    solved, timing = Transients(plate_in_time(reduced, rig.eras)), Timing(table)
    plain, _ = only(table, PLACED, drive_mode="phased")
    shaped_layer = timing.with_envelopes(plain, PLACED)
    assert plain.onset is plain.ending is None
    ramps = (
        ramped_onset(plain.excitation, rig.eras, ramp=0.040),
        ramped_ending(plain.excitation, rig.eras, ramp=0.040),
    )
    envelopes = (shaped(shaped_layer.onset, rig.eras), shaped(shaped_layer.ending, rig.eras))
    found = []
    for layer, (onset, ending) in ((plain, ramps), (shaped_layer, envelopes)):
        contrast = solved.contrast_db(onset, targets=PLACED.targets, quiet=PLACED.quiet)
        left = solved.residual_db(layer.excitation, ending)
        both = timing.transient_contrast_db(layer, PLACED), timing.residual_db(layer, PLACED)
        found.append(both)
        assert both[0] == pytest.approx(contrast, abs=0.1)
        assert both[1] == pytest.approx(left, abs=0.2)
    assert found[1][0] > found[0][0] + 3
    assert found[1][1] < found[0][1] - 10
    assert shaped_layer.excitation == plain.excitation


BAD_LINES = {
    "nonsense": r'such as \{"target".*Invalid JSON',
    "[]": r'such as \{"target".*object',
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


def test_a_line_of_a_batch_is_read_key_by_key_or_refused():
    """Targets, quiet fingers, mode, level and loads; else the key that is wrong is named."""
    *refused, found = query_batch(smooth_table(), [*BAD_LINES, GOOD_LINE])
    for number, (row, named) in enumerate(zip(refused, BAD_LINES.values(), strict=True), start=1):
        assert row["line"] == number
        assert re.search(named, row["error"])
    placed = Placement(((0.1, 0.1), (0.2, 0.2)), ((0.05, 0.02),), (1.0, 2.0, 0.5))
    layer, felt = only(smooth_table(), placed, 15.0, drive_mode="switched")
    assert found["layers"][0]["drive"] == smooth_table().drive_of(layer.excitation)
    assert found["layers"][0]["fingers"] == [0, 1]
    assert found["fingers"][0]["promised_contrast_db"] == felt.promised_contrast_db


def test_batch_is_not_blamed_where_its_reader_closes(tmp_path, monkeypatch):
    """As in `era table query TABLE --batch FILE | head`: the error is of the answers' pipe."""
    batch, file = tmp_path / "b.jsonl", tmp_path / "t.npz"
    save_table(smooth_table(), file)
    batch.write_text('{"target": [0.1, 0.1]}\n')
    broken = Mock(side_effect=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    monkeypatch.setattr("builtins.print", broken)
    with pytest.raises(BrokenPipeError):
        query_command(file, batch=batch)
