"""Onsets, endings and transient measures of a table's patterns."""

import json
from dataclasses import replace

import numpy as np
import pytest

from model.answer.answer_report import Timing, query_batch
from model.answer.stimulus import Placement
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Uncertainty
from model.structure.attachments import footprints_of
from model.table.table_file import build_table
from model.transients.base_motion import ramped_ending, ramped_onset, shaped
from model.transients.shaping import Shaper, Transients
from model.transients.time_response import plate_in_time
from plates import make_paper_rig
from set_table import only

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


@pytest.fixture(scope="module")
def solved(rig):
    """The same plate solved in time without the table."""
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras), frequency_max=300.0)
    return Transients(plate_in_time(reduced, rig.eras))


def test_transient_measures_agree_with_another_solution_of_the_plate(rig, table, solved):
    """Measures of ramps and envelopes agree; envelopes do better with the same excitation."""
    timing = Timing(table)
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
        assert found[-1][0] == pytest.approx(contrast, abs=0.1)
        assert found[-1][1] == pytest.approx(left, abs=0.2)
    assert found[1][0] > found[0][0] + 3
    assert found[1][1] < found[0][1] - 10
    assert shaped_layer.excitation == plain.excitation


@pytest.mark.parametrize("quiet", [(), ((0.25, 0.18), (0.005, 0.1))])
def test_envelopes_are_those_of_fingertips_read_point_by_point(table, quiet):
    """Knots within a per mille of the largest, at an edge of the plate as well."""
    placed = replace(PLACED, quiet=quiet)
    layer, _ = only(table, placed, drive_mode="phased")
    found = Timing(table).with_envelopes(layer, placed)
    shaper = Shaper(table.in_time, gain_variance=table.uncertainty.gain_variance)
    onset = shaper.onset(found.excitation, targets=placed.targets, quiet=quiet)
    largest = max(each.largest for each in onset.values())
    for name, each in onset.items():
        np.testing.assert_allclose(found.onset[name].knots, each.knots, atol=1e-3 * largest)


def test_transient_measures_without_quiet_fingers(table):
    """There is no contrast; what is left after the end is known all the same."""
    alone, timing = Placement(((0.09, 0.07),)), Timing(table)
    layer = timing.with_envelopes(only(table, alone, drive_mode="phased")[0], alone)
    assert timing.transient_contrast_db(layer, alone) is None
    assert timing.residual_db(layer, alone) < -20


def test_query_batch_has_knots_only_with_envelopes(table):
    """21 and 8 knots for every ERA, from silence to the pattern and back; else null."""
    line = {"target": [0.09, 0.07], "quiet": [[0.25, 0.18]]}
    plain, with_knots = query_batch(
        table, [json.dumps(line), json.dumps(line | {"envelopes": True})]
    )
    before, after = plain["transient_contrast_db"], with_knots["transient_contrast_db"]
    (plain,), (with_knots,) = plain["layers"], with_knots["layers"]
    assert plain["onset"] is plain["ending"] is None
    assert {len(each["knots"]) for each in with_knots["onset"].values()} == {21}
    assert {len(each["knots"]) for each in with_knots["ending"].values()} == {8}
    assert {each["start"]["level"] for each in with_knots["onset"].values()} == {0.0}
    for era, tone in with_knots["drive"].items():
        start = with_knots["ending"][era]["start"]
        assert start["level"] == pytest.approx(tone["level"])
        assert start["phase_deg"] == pytest.approx(tone["phase_deg"], abs=1e-6)
        last = with_knots["onset"][era]["knots"][-1]
        assert last["level"] == pytest.approx(tone["level"])
        assert last["phase_deg"] == pytest.approx(tone["phase_deg"], abs=1e-6)
        assert with_knots["onset"][era]["frequency_hz"] == tone["frequency_hz"]
        assert with_knots["ending"][era]["knots"][-1]["level"] == 0
    assert after > before
