"""Shaped onsets and endings, their knots and predictions, against ramps and a stepping solver."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from kit.plates import (
    STILL,
    faded_base,
    make_paper_rig,
    make_plate_in_time,
    motion_of,
    shaped_base,
    stepped_acceleration,
)
from model.arrays import lattice
from model.errors import InputError
from model.finger import fingertip_points, fingertip_weights
from model.reduction.reduced_plate import ReducedPlate
from model.structure.material import material
from model.structure.plate import Plate
from model.structure.sources import Era
from model.transients.base_motion import (
    BaseEnvelope,
    Envelopes,
    Motion,
    raised_cosine,
    ramped_ending,
    ramped_onset,
    shaped,
)
from model.transients.knots import (
    ONSET_KNOTS,
    bounded_minimum,
    hat_accelerations,
    steady_states,
)
from model.transients.shaping import SAMPLE_RATE, Shaper, Transients
from model.transients.time_response import plate_in_time
from model.vibration import Excitation, Tone

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
    onsets = shaper.onset(excitation, targets=[(0.08, 0.06)], quiet=[(0.2, 0.17)])
    endings = shaper.ending(excitation)
    for era in rig.eras:
        onset, ending, amplitude = (
            onsets[era.name],
            endings[era.name],
            excitation[era.name].phasor,
        )
        assert max(onset.largest, ending.largest) <= era.stroke * (1 + 1e-9)
        assert onset.start == ending.knots[-1] == 0
        assert onset.knots[-1] == pytest.approx(amplitude)
        assert ending.start == pytest.approx(amplitude)
        assert len(onset.knots) == ONSET_KNOTS == 21
        assert ending.duration == pytest.approx(0.040)
    left = transients.residual_db(excitation, shaped(endings, rig.eras))
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


def test_a_shaped_target_follows_its_ramp_and_its_quiet_finger_stays_quiet(setup):
    """A target has nothing at first, half its amplitude within 35 ms, and most of it by 60 ms.

    Peaks of an ending at a quiet finger are lower than if it did not know it, above 150 Hz lower
    than in a ramp. In a few periods of a low frequency a plate is not stopped that quietly, but it
    is stopped.
    """
    rig, plate, shaper, transients = setup
    for target, quiet, frequency in PAIRS:
        at = {"targets": [target], "quiet": [quiet]}
        weights = loaded_weights(plate, frequency, target, quiet)
        excitation = tones(rig, frequency, 0.1 * weights)
        knowing = shaped(shaper.ending(excitation, **at), rig.eras)
        known, unknown, ramp = (
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
        )
        is_low = frequency < 150
        assert known < 0.7 * unknown
        assert is_low or known < 0.7 * ramp
        assert transients.residual_db(excitation, knowing) < (-30 if is_low else -40)
        if frequency > 100:
            onset = shaped(shaper.onset(excitation, **at), rig.eras)
            felt = np.abs(transients.acceleration(onset, np.array([target]), duration=0.3)[:, 0])
            steady = felt[-800:].max()
            assert felt[:24].max() < 0.1 * steady  # 3 ms
            assert felt[:280].max() > 0.5 * steady
            assert felt[280:480].max() > 0.65 * steady


def test_envelopes_keep_the_frequency_of_each_era(setup):
    """With two frequencies each ERA keeps its own, and one that is silent stays silent.

    Of one frequency it plays during the onset, and is silent again at its end and during the
    ending.
    """
    rig, _, shaper, transients = setup
    at = {"targets": [(0.05, 0.05)], "quiet": [(0.2, 0.15)]}
    two = {"SW": Tone(110.8, 8e-5), "NE": Tone(217.0, 6e-5, 1.0)}
    onset, ending = shaper.onset(two, **at), shaper.ending(two)
    assert {name: each.frequency for name, each in onset.items()} == {"SW": 110.8, "NE": 217.0}
    assert onset["NE"].knots[-1] == pytest.approx(6e-5 * np.exp(1j))
    stopped = transients.residual_db(two, ramped_ending(two, rig.eras, ramp=0.0))
    assert transients.residual_db(two, shaped(ending, rig.eras)) < stopped - 3

    one = {"SW": Tone(110.8, 8e-5), "NE": Tone(110.8, 6e-5, 1.0)}
    onset = shaper.onset(one, **at)
    assert set(onset) == {era.name for era in rig.eras}
    assert onset["SE"].knots[-1] == 0
    assert onset["SE"].largest > 1e-7
    assert set(shaper.ending(one)) == set(one)


def test_onset_of_a_lone_finger_keeps_the_surroundings_quiet(setup):
    """Without quiet fingers the rest of the plate moves less during the onset than with a ramp.

    Or than with a quiet finger nearby. Relative to the target's peak, as contrast is.
    """
    rig, _, shaper, transients = setup
    target = (0.05, 0.18)
    excitation = random_excitation(rig, 217.0, np.random.default_rng(5))
    rest = lattice(np.linspace(0.12, 0.3, 8), np.linspace(0.01, 0.12, 6))
    share = []
    for bases in (
        shaped(shaper.onset(excitation, targets=[target]), rig.eras),
        ramped_onset(excitation, rig.eras, ramp=0.02),
        shaped(shaper.onset(excitation, targets=[target], quiet=[(0.05, 0.05)]), rig.eras),
    ):
        felt = transients.acceleration(bases, np.vstack([[target], rest]))
        share.append(np.sqrt((felt[:, 1:] ** 2).mean()) / np.abs(felt[:, 0]).max())
    assert share[0] < 0.9 * min(share[1:])


STEP = 0.005


@pytest.fixture(scope="module")
def few_modes():
    """Rig and plate with modes for 100 Hz only, so that a stepping solver is quick."""
    return make_plate_in_time(frequency_max=100.0)


def test_hat_response_equals_time_stepping(few_modes):
    """Closed form, back on its carrier, follows Runge-Kutta through rise, fall and ringing."""
    rig, plate = few_modes
    omega, samples = 2 * math.pi * 90.0, 4
    hats = hat_accelerations(plate, omega, step=STEP, steps=6, samples=samples)
    times = STEP * (np.arange(len(hats)) + 0.5) / samples
    hat = shaped_base(rig.eras[1].stroke, 90.0, start=0.0, step=STEP, knots=(0, 1, 0))
    breaks = np.array([0, STEP, 2 * STEP, 6 * STEP])
    bases = [each.motion for each in (STILL, hat, STILL, STILL)]
    stepped = stepped_acceleration(plate, bases, times, breaks=breaks)
    found = (hats[:, 1] * np.exp(1j * omega * times)[:, None]).imag
    np.testing.assert_allclose(found, stepped, atol=1e-5 * np.abs(stepped).max())


def test_acceleration_equals_time_stepping(few_modes):
    """A ramped tone and an envelope at another frequency together follow Runge-Kutta."""
    rig, plate = few_modes
    knots = (3e-5 + 2e-5j, -1e-5j, 5e-5 + 0j)
    ramp = ramped_onset({"SW": Tone(70.0, 8e-5, 0.4)}, rig.eras, ramp=0.01)
    bases = (ramp[0], (), BaseEnvelope(120.0, 0j, knots).terms(), ())
    tone = faded_base(8e-5, 70.0, 0.4, rise=(0.0, 0.01), fall=(1.0, 2.0))
    on = 4 * knots[-1:]  # the last knot stays
    envelope = shaped_base(1.0, 120.0, start=0.0, step=STEP, knots=(0, *knots, *on))
    points = fingertip_points(0.07, 0.16, rig.plate)
    found = Transients(plate).acceleration(bases, points, duration=0.03)
    times = np.arange(len(found)) / SAMPLE_RATE
    breaks = np.array([0, 0.005, 0.01, 0.015, 0.03])
    motions = [each.motion for each in (tone, STILL, envelope, STILL)]
    stepped = stepped_acceleration(plate, motions, times, breaks=breaks)
    expected = stepped @ plate.reduced.at(points).T
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_ramped_onset_and_ending_are_raised_cosines():
    """Half way through a ramp, up or down, the amplitude is half, and none or all at its ends."""
    rig = make_paper_rig(2, 2)
    excitation = {"SE": Tone(50.0, 1e-4, 0.3)}
    up, down = (each(excitation, rig.eras, ramp=0.02) for each in (ramped_onset, ramped_ending))
    assert [len(base) > 0 for base in up] == [era.name == "SE" for era in rig.eras]
    times, shares = np.array([0.0, 0.01, 0.03]), np.array([0.0, 0.5, 1.0])
    tone = 1e-4 * np.sin(2 * math.pi * 50.0 * times + 0.3)
    assert motion_of(up[1], times) == pytest.approx(shares * tone, abs=1e-17)
    assert motion_of(down[1], times) == pytest.approx((1 - shares) * tone, abs=1e-17)


def random_form(seed: int, n: int):
    """A (n, n) Hermitian positive definite and b (n,) for which bounds of 1 matter."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((2 * n, n)) + 1j * rng.standard_normal((2 * n, n))
    A = rows.conj().T @ rows
    return A, 3 * A @ (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(n)


def value(A, b, x):
    """What is minimised."""
    return float((x.conj() @ A @ x - 2 * b.conj() @ x).real)


@pytest.mark.parametrize("seed", range(5))
def test_bounded_minimum_equals_a_general_optimizer(seed):
    """No bound is exceeded, and the value is that of SLSQP within 1 % of what is to be gained."""
    A, b = random_form(seed, 6)
    found = bounded_minimum(A, b.reshape(3, 2), np.eye(2)).ravel()
    general = minimize(
        lambda z: value(A, b, z[:6] + 1j * z[6:]),
        np.zeros(12),
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: 1 - z[:6] ** 2 - z[6:] ** 2},
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert np.abs(np.linalg.solve(A, b)).max() > 1  # the bounds are in the way
    assert np.abs(found).max() <= 1
    assert value(A, b, found) <= 0.99 * general.fun


def terms(*fades: tuple[float, float, float, complex, complex]) -> Motion:
    """The motion of a base by some fades."""
    return [term for fade in fades for term in raised_cosine(*fade)]


ERA = Era("", 0, 0, stiffness=100.0**2, damping=2 * 100.0, bolt_mass=0.0, stroke=1e-4)
"""Under one kilogram it is damped critically, in numbers that are exact."""

PLATE = Plate(0.3, 0.2, 0.001, material("steel"), loss_factor=0.0)
THREE_MASSES = ReducedPlate(
    PLATE, np.zeros(3), np.zeros(3), lambda points: np.eye(3)[: len(points)]
)
"""A kilogram on each of three ERAs, and nothing between them: as few coordinates as stand."""


@pytest.mark.parametrize("mass", [0.0, 3.0])
def test_plate_in_time_refuses_critical_damping(mass: float) -> None:
    """c = 2 sqrt(k m): two eigenvectors are one, and nothing must be computed with their inverse.

    With 1 + 3 kg and twice the damping as well, there the numbers make it singular altogether.
    """
    factor = (1 + mass) ** 0.5
    era = replace(ERA, bolt_mass=mass, damping=factor * ERA.damping)
    eras = [replace(era, x=x, y=y) for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1))]
    with pytest.raises(InputError, match="damped critically"):
        plate_in_time(THREE_MASSES, eras)
    softer = [replace(each, damping=0.999 * era.damping) for each in eras]
    solved = plate_in_time(THREE_MASSES, softer)
    assert np.abs(solved.eigenvalues) == pytest.approx(100 / factor)
