"""Which of several drives keeps quiet fingers quiet while it starts along a plain ramp."""

from dataclasses import replace

import numpy as np
import pytest

from model.drive_modes.forms import Weights
from model.drive_modes.tones import excitation_of
from model.reduction.reduced_plate import reduce_plate
from model.structure.attachments import footprints_of
from model.table.pattern import ONSET_RAMP
from model.table.question import Question
from model.transients.base_motion import ramped_onset
from model.transients.measures import Transients
from model.transients.onset import RampedOnsets
from model.transients.time_response import plate_in_time
from paper_plate import make_paper_rig
from paper_table import FREQUENCIES, contact_sets, smooth_table


@pytest.mark.parametrize(("ramp", "within"), [(0.020, 0.5), (0.040, 0.25)])
def test_ramped_onset_contrast_equals_sampled_contrast(ramp, within):
    """Twelve moments of an envelope, against 800 samples of the motion, root mean square in dB.

    Random drives, one or two targets, over all frequencies.
    """
    table = smooth_table()
    transients = Transients(table.in_time)
    onsets = RampedOnsets(table.in_time, FREQUENCIES, ramp=ramp)
    rng = np.random.default_rng(5)
    errors = []
    for number, places in enumerate(contact_sets(12, fingers=4, seed=12)):
        targets = places[: 1 + number % 2]
        quiet = places[len(targets) :]
        rows = rng.integers(len(FREQUENCIES), size=3)
        weights = (rng.uniform(-1, 1, (3, 4)) + 1j * rng.uniform(-1, 1, (3, 4))) / 2
        weights = weights.astype(np.complex64)
        tips = table.raster.fingertips(np.array(places))
        _, shapes = tips.read(table.shapes)
        count = len(targets)
        found = onsets.contrast(
            rows,
            weights,
            targets=list(shapes[:count] * 21 * tips.fine_weights[:count, :, None]),
            quiet=shapes[count:].reshape(-1, shapes.shape[-1]),
        )
        for row, weight, contrast in zip(rows, weights, found, strict=True):
            excitation = excitation_of(Weights.at(row, weight), table.eras, FREQUENCIES, gain=1.0)
            bases = ramped_onset(excitation, table.eras, ramp=ramp)
            exact = transients.contrast_db(bases, targets=targets, quiet=quiet)
            errors.append(20 * np.log10(contrast) - exact)
    assert np.sqrt(np.mean(np.square(errors))) < within
    assert np.abs(errors).max() < 2.0


def test_plain_ramps_choose_among_nearly_equal_drives_by_their_onset():
    """Tenths of a decibel of the judged contrast are given, for more in the first 100 ms.

    Beside the same questions with envelopes, which need no such choice; sampled in time.
    """
    table = smooth_table()
    transients = Transients(table.in_time)
    given, gained = [], []
    for places in contact_sets(30, fingers=3, seed=31):
        question = Question((places[0],), tuple(places[1:]), drive_mode="phased")
        ramped = table.query(question)
        steady = table.query(replace(question, envelopes=True))
        first = [
            transients.contrast_db(
                ramped_onset(pattern.excitation, table.eras, ramp=ONSET_RAMP),
                targets=question.targets,
                quiet=question.quiet,
            )
            for pattern in (steady, ramped)
        ]
        given.append(steady.robust_felt_contrast_db - ramped.robust_felt_contrast_db)
        gained.append(first[1] - first[0])
    assert np.mean(given) < 0.3  # judged by other draws than those of the promise
    assert np.count_nonzero(gained) >= 3
    assert np.mean(gained) > 0


def test_ramped_onsets_of_heavily_damped_eras_do_not_overflow():
    """Motion that decays with 37 000 per second, of a plate solved up to 1000 Hz on soft pads."""
    rig = make_paper_rig(12, 9)
    eras = tuple(replace(era, damping=4 * era.damping) for era in rig.eras)
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(eras), frequency_max=1000.0)
    plate = plate_in_time(reduced, eras)
    assert plate.eigenvalues.real.min() < -36_000
    onsets = RampedOnsets(plate, np.array([100.0]), ramp=ONSET_RAMP)
    shapes = reduced.at(np.array([[0.05, 0.05], [0.2, 0.1]])).astype(np.float32)
    weights = np.ones((1, 4), dtype=np.complex64)
    contrast = onsets.contrast(np.array([0]), weights, targets=[shapes[:1]], quiet=shapes[1:])
    assert np.isfinite(contrast).all()
