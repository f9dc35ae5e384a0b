"""Shaped onsets and endings: within the stroke, robust, and better than ramps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.answer.stimulus import Placement
from model.finger import fingertip_points, fingertip_weights
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from model.transients.base_motion import Envelopes, ramped_ending, ramped_onset, shaped
from model.transients.knots import ONSET_KNOTS, steady_states
from model.transients.shaping import Shaper, Transients
from model.vibration import Excitation, Tone
from plates import make_plate_in_time
from set_table import only

EXAMPLES = Path(__file__).parents[3] / "examples"
VARIANCE = 0.05**2 + np.radians(5) ** 2
FREQUENCIES = [40.0, 75.4, 110.8, 217.0, 500.0]


@pytest.fixture(scope="module")
def setup():
    """Rig, plate in time, and one shaper and predictor for all tests."""
    rig, plate = make_plate_in_time()
    return rig, plate, Shaper(plate, gain_variance=VARIANCE), Transients(plate)


def random_excitation(rig, frequency, rng) -> Excitation:
    """Every ERA at random phase, the strongest at full stroke."""
    weights = rng.standard_normal(len(rig.eras)) + 1j * rng.standard_normal(len(rig.eras))
    return tones(rig, frequency, weights / np.abs(weights).max())


def tones(rig, frequency, weights) -> Excitation:
    """An excitation from weights in strokes."""
    return {
        era.name: Tone(frequency, float(era.stroke * abs(w)), float(np.angle(w)))
        for era, w in zip(rig.eras, weights, strict=True)
    }


def loaded_weights(plate, frequency, target, quiet):
    """R w = conj(h) with errors of 0.1, from steady accelerations at both fingertips."""
    omega = 2 * np.pi * frequency
    steady = -(omega**2) * steady_states(plate, omega) @ plate.displacement.T
    h, q = (
        steady @ plate.reduced.at(fingertip_points(*each, plate.reduced.plate)).T
        for each in (target, quiet)
    )
    power = (np.abs(q) ** 2).mean(axis=1)
    w = np.linalg.solve(q.conj() @ q.T / q.shape[1] + np.diag(0.01 * power), h.mean(axis=1).conj())
    return w / np.abs(w).max()


def era_errors(rng):
    """Complex factors (4,) of ERAs with errors of 5 % in gain and 5 degrees in phase."""
    gains = 1 + 0.05 * rng.standard_normal(4)
    return gains * np.exp(1j * np.radians(5) * rng.standard_normal(4))


def wrong_tones(excitation: Excitation, errors) -> Excitation:
    """The tones of ERAs with errors, in the order of the names."""
    return {
        name: Tone(tone.frequency, tone.amplitude * abs(e), tone.phase + np.angle(e))
        for (name, tone), e in zip(sorted(excitation.items()), errors, strict=True)
    }


def wrong(envelopes: Envelopes, errors) -> Envelopes:
    """The envelopes of ERAs with errors, in the order of the names."""
    return {
        name: replace(
            envelopes[name],
            start=complex(envelopes[name].start * error),
            knots=tuple(complex(knot * error) for knot in envelopes[name].knots),
        )
        for name, error in zip(sorted(envelopes), errors, strict=True)
    }


@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_shaped_envelopes_stay_within_the_stroke_and_stop_the_plate(setup, frequency):
    """At full stroke, resonance or not, they join the pattern.

    After an ending of 40 ms at least 6 dB less is left than after a ramp as long, or a stop.
    """
    rig, _, shaper, transients = setup
    excitation = random_excitation(rig, frequency, np.random.default_rng(int(frequency)))
    onset = shaper.onset(excitation, targets=[(0.08, 0.06)], quiet=[(0.2, 0.17)])
    ending = shaper.ending(excitation)
    for era in rig.eras:
        tone = excitation[era.name]
        amplitude = tone.amplitude * np.exp(1j * tone.phase)
        assert onset[era.name].largest <= era.stroke * (1 + 1e-9)
        assert ending[era.name].largest <= era.stroke * (1 + 1e-9)
        assert onset[era.name].start == 0
        assert onset[era.name].knots[-1] == pytest.approx(amplitude)
        assert ending[era.name].start == pytest.approx(amplitude)
        assert ending[era.name].knots[-1] == 0
        assert len(onset[era.name].knots) == ONSET_KNOTS == 21
        assert ending[era.name].duration == pytest.approx(0.040)
    left = transients.residual_db(excitation, shaped(ending, rig.eras))
    for ramp in (0.0, 0.04):
        plain = ramped_ending(excitation, rig.eras, ramp=ramp)
        assert left < transients.residual_db(excitation, plain) - 6


PAIRS = [
    ((0.19, 0.19), (0.23, 0.06), 93.1),
    ((0.235, 0.11), (0.1, 0.07), 110.8),
    ((0.02, 0.12), (0.14, 0.2), 199.2),
    ((0.19, 0.16), (0.04, 0.12), 464.6),
]


@pytest.mark.parametrize(("target", "quiet", "frequency"), PAIRS)
def test_shaped_onset_keeps_most_of_the_steady_contrast(setup, target, quiet, frequency):
    """In the first 100 ms and with errors: 6 dB more than a 20 ms ramp, 6 dB off steady at most."""
    rig, plate, shaper, transients = setup
    weights = loaded_weights(plate, frequency, target, quiet)
    excitation = tones(rig, frequency, weights)
    onset = shaper.onset(excitation, targets=[target], quiet=[quiet])

    def contrast(bases):
        return transients.contrast_db(bases, targets=[target], quiet=[quiet])

    def steady_contrast(weights):
        omega = 2 * np.pi * frequency
        steady = -(omega**2) * steady_states(plate, omega) @ plate.displacement.T
        at = [
            np.abs(weights @ steady @ plate.reduced.at(fingertip_points(*each, rig.plate)).T)
            for each in (target, quiet)
        ]
        return 20 * np.log10(at[0] @ fingertip_weights(*target, rig.plate) / at[1].max())

    realised, steady = [], []
    names = sorted(excitation)
    order = [names.index(era.name) for era in rig.eras]
    for seed in range(12):
        errors = era_errors(np.random.default_rng(seed))
        realised.append(contrast(shaped(wrong(onset, errors), rig.eras)))
        steady.append(steady_contrast(weights * errors[order]))
    ramp = contrast(ramped_onset(excitation, rig.eras, ramp=0.02))
    assert np.median(realised) > ramp + 6
    assert np.median(realised) > np.median(steady) - 6


def test_onset_of_many_eras_is_as_good_as_of_few():
    """Of sixteen, more than it combines: within the stroke, to the pattern, 6 dB above a ramp."""
    table = build_table(load_rig(EXAMPLES / "table.yaml"), frequencies=np.array([130.0]))
    size = np.array([table.plate.length / 0.3048, table.plate.width / 0.2286])
    shaper = Shaper(table.in_time, gain_variance=VARIANCE)
    transients = Transients(table.in_time)
    gained = []
    for *places, _ in PAIRS:
        target, quiet = (tuple((size * place).tolist()) for place in places)
        layer, _ = only(table, Placement((target,), (quiet,)), drive_mode="phased")
        excitation = layer.excitation
        onset = shaper.onset(excitation, targets=[target], quiet=[quiet])
        for era in table.eras:
            tone = excitation[era.name]
            assert onset[era.name].largest <= era.stroke
            assert onset[era.name].knots[-1] == pytest.approx(
                tone.amplitude * np.exp(1j * tone.phase)
            )
        shaped_db, ramped_db = (
            transients.contrast_db(bases, targets=[target], quiet=[quiet])
            for bases in (
                shaped(onset, table.eras),
                ramped_onset(excitation, table.eras, ramp=0.04),
            )
        )
        gained.append(shaped_db - ramped_db)
    assert np.median(gained) > 6


def test_shaping_includes_the_errors_of_the_eras(setup):
    """With errors the robust onset and ending do better than those that know of no errors."""
    rig, plate, shaper, transients = setup
    target, quiet, frequency = PAIRS[2]
    excitation = tones(rig, frequency, loaded_weights(plate, frequency, target, quiet))
    low = random_excitation(rig, 110.8, np.random.default_rng(1))
    found = [(shaper.onset(excitation, targets=[target], quiet=[quiet]), shaper.ending(low))]
    shaper = Shaper(plate, gain_variance=0.0)
    found.append((shaper.onset(excitation, targets=[target], quiet=[quiet]), shaper.ending(low)))
    contrast, left = [], []
    for onset, ending in found:
        for seed in range(40):
            errors = era_errors(np.random.default_rng(seed))
            bases = shaped(wrong(onset, errors), rig.eras)
            contrast.append(transients.contrast_db(bases, targets=[target], quiet=[quiet]))
            off = wrong_tones(low, errors)
            left.append(transients.residual_db(off, shaped(wrong(ending, errors), rig.eras)))
    assert np.median(contrast[:40]) > np.median(contrast[40:]) + 0.2
    assert np.median(left[:40]) < np.median(left[40:]) - 1


def test_shaped_onset_target_follows_its_ramp(setup):
    """A target has nothing at first, half its amplitude within 35 ms, and most of it by 60 ms."""
    rig, plate, shaper, transients = setup
    for target, quiet, frequency in PAIRS[1:]:
        weights = loaded_weights(plate, frequency, target, quiet)
        excitation = tones(rig, frequency, 0.1 * weights)
        onset = shaper.onset(excitation, targets=[target], quiet=[quiet])
        felt = transients.acceleration(shaped(onset, rig.eras), np.array([target]), duration=0.3)[
            :, 0
        ]
        steady = np.abs(felt[-800:]).max()
        assert np.abs(felt[:24]).max() < 0.1 * steady  # 3 ms
        assert np.abs(felt[:280]).max() > 0.5 * steady
        assert np.abs(felt[280:480]).max() > 0.65 * steady


def test_ending_keeps_known_quiet_finger_quiet(setup):
    """Its peaks are lower than if the ending did not know it, above 150 Hz lower than in a ramp.

    In a few periods of a low frequency a plate is not stopped that quietly, but it is stopped.
    """
    rig, plate, shaper, transients = setup
    for target, quiet, frequency in PAIRS:
        weights = loaded_weights(plate, frequency, target, quiet)
        excitation = tones(rig, frequency, 0.2 * weights)
        knowing = shaped(shaper.ending(excitation, targets=[target], quiet=[quiet]), rig.eras)
        peaks = [
            np.abs(
                transients.acceleration(
                    bases, fingertip_points(*quiet, rig.plate), duration=0.1, after=excitation
                )
            ).max()
            for bases in (
                knowing,
                shaped(shaper.ending(excitation), rig.eras),
                ramped_ending(excitation, rig.eras, ramp=0.02),
            )
        ]
        assert peaks[0] < 0.7 * peaks[1]
        if frequency > 150:
            assert peaks[0] < 0.7 * peaks[2]
        limit = -30 if frequency < 150 else -40
        assert transients.residual_db(excitation, knowing) < limit


def test_envelopes_keep_the_frequency_of_each_era(setup):
    """With two frequencies each ERA keeps its own, and one that is silent stays silent."""
    rig, _, shaper, transients = setup
    excitation = {"SW": Tone(110.8, 8e-5), "NE": Tone(217.0, 6e-5, 1.0)}
    onset = shaper.onset(excitation, targets=[(0.05, 0.05)], quiet=[(0.2, 0.15)])
    ending = shaper.ending(excitation)
    assert {name: each.frequency for name, each in onset.items()} == {"SW": 110.8, "NE": 217.0}
    assert onset["NE"].knots[-1] == pytest.approx(6e-5 * np.exp(1j))
    residual_shaped = transients.residual_db(excitation, shaped(ending, rig.eras))
    stopped = transients.residual_db(excitation, ramped_ending(excitation, rig.eras, ramp=0.0))
    assert residual_shaped < stopped - 3


def test_silent_era_plays_in_onset_of_one_frequency(setup):
    """It plays during the onset, and is silent again at its end and during the ending."""
    rig, _, shaper, _ = setup
    excitation = {"SW": Tone(110.8, 8e-5), "NE": Tone(110.8, 6e-5, 1.0)}
    onset = shaper.onset(excitation, targets=[(0.05, 0.05)], quiet=[(0.2, 0.15)])
    ending = shaper.ending(excitation)
    assert set(onset) == {era.name for era in rig.eras}
    assert onset["SE"].knots[-1] == 0
    assert onset["SE"].largest > 1e-7
    assert set(ending) == set(excitation)


def test_onset_of_a_lone_finger_keeps_the_surroundings_quiet(setup):
    """Without quiet fingers the rest of the plate moves less during the onset than with a ramp."""
    rig, _, shaper, transients = setup
    target = (0.05, 0.18)
    excitation = random_excitation(rig, 217.0, np.random.default_rng(5))
    onset = shaper.onset(excitation, targets=[target])
    x, y = np.meshgrid(np.linspace(0.12, 0.3, 8), np.linspace(0.01, 0.12, 6))
    rest = np.column_stack([x.ravel(), y.ravel()])
    one_finger = shaper.onset(excitation, targets=[target], quiet=[(0.05, 0.05)])
    # Relative to the target's peak, as contrast is.
    share = []
    for bases in (
        shaped(onset, rig.eras),
        ramped_onset(excitation, rig.eras, ramp=0.02),
        shaped(one_finger, rig.eras),
    ):
        felt = transients.acceleration(bases, np.vstack([[target], rest]))
        share.append(np.sqrt((felt[:, 1:] ** 2).mean()) / np.abs(felt[:, 0]).max())
    assert share[0] < 0.9 * min(share[1:])
    assert len(onset["SW"].knots) == 21
