"""Knots by the kernel in C, beside the same in numpy."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from model.transients.base_motion import shaped
from model.transients.knots import (
    Carrier,
    FingerResponses,
    ending_by_numpy,
    ending_knots,
    onset_by_numpy,
    onset_knots,
    quiet_weight,
)
from model.transients.shaping import Shaper, Transients, of_eras, responses_at
from model.vibration import Tone

EXAMPLES = Path(__file__).parents[3] / "examples"
VARIANCE = 0.05**2 + np.radians(5) ** 2


def random_plate(rng, eras: int, quiet: int) -> tuple[Carrier, FingerResponses]:
    """Responses that ring and decay, of one target and so many quiet fingers."""
    r, samples, steps = 6 + quiet, 5, 30

    def drawn(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    ago = np.arange(steps)[::-1, None] + np.arange(samples) / samples
    rates = rng.uniform(-0.4, -0.1, r) + 1j * rng.uniform(-2, 2, r)
    shapes = drawn(r, eras)
    hats = np.exp(rates * ago[..., None]).transpose(1, 2, 0)[..., None] * shapes[:, None]
    rows = drawn(8 * eras, 8 * eras) * np.repeat(0.5 ** np.arange(8), eras)[::-1]
    form = rows.conj().T @ rows
    single = np.complex64
    carrier = Carrier(
        hats.astype(single), drawn(eras, r), form.astype(single), gain_variance=VARIANCE
    )
    at = rng.standard_normal((1 + 5 * quiet, r))
    return carrier, responses_at(carrier, at[:1], at[1:])


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize(("eras", "quiet"), list(product([4, 5, 8, 11, 16], [1, 9])))
@pytest.mark.parametrize("level", [0.05, 1.0])
def test_knots_are_those_of_numpy(eras, quiet, level):
    """Random tones, low ones and at full stroke; some ERAs silent in the endings.

    In single precision; the bounded ones of the others after thirty steps.
    """
    rng = np.random.default_rng(100 * eras + quiet)
    carrier, found = random_plate(rng, eras, quiet)
    weights = rng.standard_normal(eras) + 1j * rng.standard_normal(eras)
    weights *= level / np.abs(weights).max()
    knots = onset_knots(weights, found, VARIANCE)
    expected = onset_by_numpy(weights, found, VARIANCE)
    np.testing.assert_allclose(knots[1:-1], expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_array_equal(knots[0], 0)
    np.testing.assert_array_equal(knots[-1], weights)
    assert np.abs(knots[1:-1]).max() <= 1
    active = np.arange(eras)[rng.permutation(eras) > 0]
    for felt in (None, of_eras(found, active)):
        weight = 0.0 if felt is None else quiet_weight(carrier, weights, active, felt)
        knots = ending_knots(carrier, weights, active, felt)
        expected = ending_by_numpy(carrier, weights, active, felt, weight)
        np.testing.assert_allclose(knots[1:-1], expected, atol=2e-3 * np.abs(expected).max())
        np.testing.assert_array_equal(knots[0], weights[active])
        np.testing.assert_array_equal(knots[-1], 0)
        assert np.abs(knots[1:-1]).max() <= 1


@pytest.mark.parametrize("rig", ["paper_plate", "eight_eras", "table"])
def test_onsets_and_endings_do_what_those_of_numpy_do(rig, without_kernels):
    """Contrast of onsets within 0.02 dB, what is left after endings within 0.2, on rigs.

    At a fifth of the stroke and at all of it; against no, one and three quiet fingers.
    """
    table = build_table(load_rig(EXAMPLES / f"{rig}.yaml"), frequencies=np.array([130.0]))
    shaper = Shaper(table.in_time, gain_variance=VARIANCE)
    transients = Transients(table.in_time)
    rng = np.random.default_rng(7)
    size = np.array([table.plate.length, table.plate.width])
    cases = []
    for quiet, level in product([0, 1, 3], [0.2, 1.0]):
        places = [tuple(each) for each in (size * rng.uniform(0.1, 0.9, (1 + quiet, 2))).tolist()]
        weights = rng.standard_normal((len(table.eras), 2)) @ [1, 1j]
        weights *= level / np.abs(weights).max()
        cases.append((places, excitation(table, weights)))

    def measured():
        found = []
        for (target, *quiet), tones in cases:
            onset = shaped(shaper.onset(tones, targets=[target], quiet=quiet), table.eras)
            ending = shaped(shaper.ending(tones, targets=[target], quiet=quiet), table.eras)
            others = quiet or [tuple((size - target).tolist())]
            contrast = transients.contrast_db(onset, targets=[target], quiet=others)
            found.append((contrast, transients.residual_db(tones, ending)))
        return np.array(found)

    by_kernel = measured()
    without_kernels()
    by_numpy = measured()
    np.testing.assert_allclose(by_kernel[:, 0], by_numpy[:, 0], atol=0.02)
    np.testing.assert_allclose(by_kernel[:, 1], by_numpy[:, 1], atol=0.2)
    assert np.abs(by_kernel - by_numpy).max() > 0  # two ways indeed


def excitation(table, weights):
    """Tones of 130 Hz from weights in strokes."""
    return {
        era.name: Tone(130.0, float(era.stroke * abs(w)), float(np.angle(w)))
        for era, w in zip(table.eras, weights, strict=True)
    }
