"""Shaped onsets and endings, their knots and predictions, against ramps and a stepping solver."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import minimize

from kit.plates import (
    STILL,
    faded_base,
    shaped_base,
)
from model.arrays import ComplexArray, FloatArray, Point, lattice
from model.errors import InputError
from model.finger import fingertip_points, fingertip_weights
from model.reduction.reduced_plate import ReducedPlate
from model.rig.rig import Rig
from model.structure.material import material
from model.structure.plate import Plate
from model.structure.sources import Era
from model.transients.base_motion import (
    BaseEnvelope,
    Envelopes,
    ramped_ending,
    ramped_onset,
    shaped,
)
from model.transients.knots import ONSET_KNOTS, bounded_minimum, steady_states
from model.transients.plate_in_time import PlateInTime, plate_in_time
from model.transients.shaping import SAMPLE_RATE, Shaper, Transients
from model.vibration import Excitation, Tone
from tests.model.transients.stepped_plate import make_plate_in_time, stepped_acceleration

GAIN_VARIANCE = 0.05**2 + np.radians(5) ** 2


@dataclass(frozen=True)
class Setup:
    """The paper's rig, its plate in time, and what shapes and predicts onsets on it."""

    rig: Rig
    plate: PlateInTime
    shaper: Shaper
    transients: Transients

    def tones(self, frequency: float, weights: ComplexArray) -> Excitation:
        """Tones of a frequency from weights in strokes."""
        excitation = {}
        for era, weight in zip(self.rig.eras, weights, strict=True):
            excitation[era.name] = Tone.from_phasor(frequency, complex(era.stroke * weight))
        return excitation

    def random_tones(self, frequency: float, seed: int) -> Excitation:
        """Every ERA at a random phase, the strongest at full stroke."""
        rng = np.random.default_rng(seed)
        weights = rng.standard_normal((len(self.rig.eras), 2)) @ [1, 1j]
        return self.tones(frequency, weights / np.abs(weights).max())

    def steady_at(self, frequency: float, finger: Point) -> ComplexArray:
        """Steady accelerations (4, n) at a fingertip by each ERA at full stroke."""
        omega = 2 * np.pi * frequency
        coordinates = steady_states(self.plate, omega) @ self.plate.displacement.T
        points = fingertip_points(*finger, self.rig.plate)
        return np.asarray(-(omega**2) * coordinates @ self.plate.reduced.at(points).T)

    def loaded_weights(self, frequency: float, target: Point, quiet: Point) -> ComplexArray:
        """R w = conj(h) with errors of 0.1, the largest weight 1."""
        target_mean = self.steady_at(frequency, target).mean(axis=1)
        quiet_fields = self.steady_at(frequency, quiet)
        covariance = quiet_fields.conj() @ quiet_fields.T / quiet_fields.shape[1]
        covariance += 0.01 * np.diag(np.diag(covariance))
        weights = np.linalg.solve(covariance, target_mean.conj())
        return np.asarray(weights / np.abs(weights).max())

    def steady_contrast_db(
        self, weights: ComplexArray, frequency: float, target: Point, quiet: Point
    ) -> float:
        """Mean at the target over the largest value at the quiet finger."""
        target_sizes = np.abs(weights @ self.steady_at(frequency, target))
        quiet_sizes = np.abs(weights @ self.steady_at(frequency, quiet))
        target_mean = target_sizes @ fingertip_weights(*target, self.rig.plate)
        return float(20 * np.log10(target_mean / quiet_sizes.max()))


@pytest.fixture(scope="module")
def setup() -> Setup:
    """One shaper and predictor for all tests."""
    rig, plate = make_plate_in_time()
    return Setup(rig, plate, Shaper(plate, gain_variance=GAIN_VARIANCE), Transients(plate))


def era_errors(seed: int, rig: Rig) -> dict[str, complex]:
    """A complex factor per ERA, with errors of 5 % in gain and 5 degrees in phase."""
    rng = np.random.default_rng(seed)
    gains = 1 + 0.05 * rng.standard_normal(4)
    factors = gains * np.exp(1j * np.radians(5) * rng.standard_normal(4))
    names = sorted(era.name for era in rig.eras)
    return dict(zip(names, factors.tolist(), strict=True))


def tones_with(errors: dict[str, complex], excitation: Excitation) -> Excitation:
    """The tones that ERAs with errors play."""
    return {
        name: Tone.from_phasor(tone.frequency, tone.phasor * errors[name])
        for name, tone in excitation.items()
    }


def envelopes_with(errors: dict[str, complex], envelopes: Envelopes) -> Envelopes:
    """The envelopes that ERAs with errors play."""
    changed = {}
    for name, envelope in envelopes.items():
        error = errors[name]
        knots = tuple(knot * error for knot in envelope.knots)
        changed[name] = replace(envelope, start=envelope.start * error, knots=knots)
    return changed


# Shaped onsets and endings


@pytest.mark.parametrize("frequency", [40.0, 110.8, 500.0])
def test_shaped_envelopes_stay_within_the_stroke_and_stop_the_plate(
    setup: Setup, frequency: float
) -> None:
    """At full stroke, resonance or not, onset and ending join the steady pattern.

    An ending of 40 ms leaves at least 6 dB less than a ramp as long, or than an abrupt stop.
    """
    excitation = setup.random_tones(frequency, seed=int(frequency))
    onsets = setup.shaper.onset(excitation, targets=[(0.08, 0.06)], quiet=[(0.2, 0.17)])
    endings = setup.shaper.ending(excitation)
    eras = setup.rig.eras

    for era in eras:
        onset = onsets[era.name]
        ending = endings[era.name]
        amplitude = excitation[era.name].phasor
        assert max(onset.largest, ending.largest) <= era.stroke * (1 + 1e-9)
        assert onset.start == ending.knots[-1] == 0
        assert onset.knots[-1] == pytest.approx(amplitude)
        assert ending.start == pytest.approx(amplitude)
        assert len(onset.knots) == ONSET_KNOTS == 21
        assert ending.duration == pytest.approx(0.040)
    residual = setup.transients.residual_db(excitation, shaped(endings, eras))
    for ramp in (0.0, 0.04):
        plain_ending = ramped_ending(excitation, eras, ramp=ramp)
        assert residual < setup.transients.residual_db(excitation, plain_ending) - 6


PAIRS = [
    ((0.19, 0.19), (0.23, 0.06), 93.1),
    ((0.235, 0.11), (0.1, 0.07), 110.8),
    ((0.02, 0.12), (0.14, 0.2), 199.2),
    ((0.19, 0.16), (0.04, 0.12), 464.6),
]
"""Target, quiet finger and frequency."""


@pytest.mark.parametrize(("target", "quiet", "frequency"), PAIRS)
def test_shaped_onset_keeps_most_of_the_steady_contrast(
    setup: Setup, target: Point, quiet: Point, frequency: float
) -> None:
    """In the first 100 ms and with errors: 6 dB above a 20 ms ramp, at most 6 dB below steady."""
    eras = setup.rig.eras
    weights = setup.loaded_weights(frequency, target, quiet)
    excitation = setup.tones(frequency, weights)
    onset = setup.shaper.onset(excitation, targets=[target], quiet=[quiet])
    fingers = {"targets": [target], "quiet": [quiet]}
    onset_contrasts, steady_contrasts = [], []

    for seed in range(12):
        errors = era_errors(seed, setup.rig)
        bases = shaped(envelopes_with(errors, onset), eras)
        onset_contrasts.append(setup.transients.contrast_db(bases, **fingers))
        factors = np.array([errors[era.name] for era in eras])
        contrast = setup.steady_contrast_db(weights * factors, frequency, target, quiet)
        steady_contrasts.append(contrast)

    ramp = ramped_onset(excitation, eras, ramp=0.02)
    ramp_contrast = setup.transients.contrast_db(ramp, **fingers)
    assert np.median(onset_contrasts) > ramp_contrast + 6
    assert np.median(onset_contrasts) > np.median(steady_contrasts) - 6


def test_shaping_accounts_for_errors_of_the_eras(setup: Setup) -> None:
    """On ERAs with errors, robust onsets and endings are better than those for exact ERAs."""
    target, quiet, frequency = PAIRS[2]
    eras = setup.rig.eras
    fingers = {"targets": [target], "quiet": [quiet]}
    excitation = setup.tones(frequency, setup.loaded_weights(frequency, target, quiet))
    low_excitation = setup.random_tones(110.8, seed=1)

    def medians(shaper: Shaper) -> tuple[float, float]:
        onset = shaper.onset(excitation, **fingers)
        ending = shaper.ending(low_excitation)
        contrasts, residuals = [], []
        for seed in range(40):
            errors = era_errors(seed, setup.rig)
            bases = shaped(envelopes_with(errors, onset), eras)
            contrasts.append(setup.transients.contrast_db(bases, **fingers))
            stopped = shaped(envelopes_with(errors, ending), eras)
            tones = tones_with(errors, low_excitation)
            residuals.append(setup.transients.residual_db(tones, stopped))
        return float(np.median(contrasts)), float(np.median(residuals))

    robust_contrast, robust_residual = medians(setup.shaper)
    exact_contrast, exact_residual = medians(Shaper(setup.plate, gain_variance=0.0))

    assert robust_contrast > exact_contrast + 0.2
    assert robust_residual < exact_residual - 1


def test_onset_of_a_lone_finger_keeps_its_surroundings_quiet(setup: Setup) -> None:
    """The plate around moves less, compared with the target, than in a ramp.

    And less than with a quiet finger, which draws attention to one place.
    """
    eras, target = setup.rig.eras, (0.05, 0.18)
    excitation = setup.random_tones(217.0, seed=5)
    x, y = np.linspace(0.12, 0.3, 8), np.linspace(0.01, 0.12, 6)
    surroundings = lattice(x, y)
    points = np.vstack([[target], surroundings])

    def share_around(bases) -> float:
        felt = setup.transients.acceleration(bases, points)
        target_peak = np.abs(felt[:, 0]).max()
        around = np.sqrt((felt[:, 1:] ** 2).mean())
        return float(around / target_peak)

    lone_onset = setup.shaper.onset(excitation, targets=[target])
    pair_onset = setup.shaper.onset(excitation, targets=[target], quiet=[(0.05, 0.05)])
    lone_share = share_around(shaped(lone_onset, eras))
    pair_share = share_around(shaped(pair_onset, eras))
    ramp_share = share_around(ramped_onset(excitation, eras, ramp=0.02))

    assert lone_share < 0.9 * ramp_share
    assert lone_share < 0.9 * pair_share


# Responses in time

STEP = 0.005


@pytest.fixture(scope="module")
def few_modes() -> tuple[Rig, PlateInTime]:
    """Rig and plate with modes for 100 Hz only, so that a stepping solver is quick."""
    return make_plate_in_time(frequency_max=100.0)


def test_acceleration_equals_time_stepping(few_modes: tuple[Rig, PlateInTime]) -> None:
    """A ramped tone and an envelope at another frequency together follow Runge-Kutta."""
    rig, plate = few_modes
    knots = (3e-5 + 2e-5j, -1e-5j, 5e-5 + 0j)
    ramp, *_ = ramped_onset({"SW": Tone(70.0, 8e-5, 0.4)}, rig.eras, ramp=0.01)
    tone = faded_base(8e-5, 70.0, 0.4, rise=(0.0, 0.01), fall=(1.0, 2.0))
    lasting_knots = (0, *knots, *4 * knots[-1:])
    envelope = shaped_base(1.0, 120.0, start=0.0, step=STEP, knots=lasting_knots)
    motions = [tone.motion, STILL.motion, envelope.motion, STILL.motion]
    breaks = np.array([0, 0.005, 0.01, 0.015, 0.03])
    points = fingertip_points(0.07, 0.16, rig.plate)

    bases = (ramp, (), BaseEnvelope(120.0, 0j, knots).terms(), ())
    response = Transients(plate).acceleration(bases, points, duration=0.03)

    times = np.arange(len(response)) / SAMPLE_RATE
    coordinates = stepped_acceleration(plate, motions, times, breaks=breaks)
    expected = coordinates @ plate.reduced.at(points).T
    tolerance = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(response, expected, atol=tolerance)


@pytest.mark.parametrize("seed", [0, 1])
def test_bounded_minimum_equals_a_general_optimizer(seed: int) -> None:
    """No weight exceeds 1, and the value is that of SLSQP within 1 % of the possible gain."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((12, 6)) + 1j * rng.standard_normal((12, 6))
    quadratic = rows.conj().T @ rows
    direction = rng.standard_normal((6, 2)) @ [1, 1j]
    unbounded = 3 * direction / np.sqrt(6)
    linear = quadratic @ unbounded

    def value(weights: ComplexArray) -> float:
        power = weights.conj() @ quadratic @ weights
        gain = 2 * linear.conj() @ weights
        return float((power - gain).real)

    def value_of_parts(parts: FloatArray) -> float:
        return value(parts[:6] + 1j * parts[6:])

    def slack(parts: FloatArray) -> FloatArray:
        return np.asarray(1 - parts[:6] ** 2 - parts[6:] ** 2)

    minimum = bounded_minimum(quadratic, linear.reshape(3, 2), np.eye(2))
    minimum = minimum.ravel()
    reference = minimize(
        value_of_parts,
        np.zeros(12),
        method="SLSQP",
        constraints={"type": "ineq", "fun": slack},
        options={"maxiter": 500, "ftol": 1e-12},
    )

    assert np.abs(unbounded).max() > 1, "the bounds must matter"
    assert np.abs(minimum).max() <= 1
    assert value(minimum) <= 0.99 * reference.fun


@pytest.mark.parametrize("bolt_mass", [0.0, 3.0])
def test_plate_in_time_rejects_critical_damping(bolt_mass: float) -> None:
    """At c = 2 sqrt(k m) two eigenvectors are one, and their inverse must not be used.

    The plate is a kilogram on each of three ERAs, uncoupled, in numbers that are exact.
    """
    root = math.sqrt(1 + bolt_mass)
    plate = Plate(0.3, 0.2, 0.001, material("steel"), loss_factor=0.0)

    def identity_shapes(points: FloatArray) -> FloatArray:
        return np.eye(3)[: len(points)]

    def eras_with(damping: float) -> list[Era]:
        positions = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)]
        return [Era("", x, y, 100.0**2, damping, bolt_mass, stroke=1e-4) for x, y in positions]

    masses = ReducedPlate(plate, np.zeros(3), np.zeros(3), identity_shapes)
    with pytest.raises(InputError, match="damped critically"):
        plate_in_time(masses, eras_with(root * 200.0))

    solved = plate_in_time(masses, eras_with(0.999 * root * 200.0))
    assert np.abs(solved.eigenvalues) == pytest.approx(100 / root)
