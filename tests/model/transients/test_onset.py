"""Onsets and endings: their knots, envelopes and bounded solutions."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize

from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import Era
from model.structure.materials import material
from model.structure.plate import Plate
from model.transients.base_motion import (
    BaseEnvelope,
    BaseMotions,
    Motion,
    Term,
    raised_cosine,
    ramped_ending,
    ramped_onset,
    shaped,
)
from model.transients.knots import (
    ENDING_KNOTS,
    bounded_minimum,
    mean_square,
    solve_carrier,
    while_ending,
)
from model.transients.shaping import Transients, responses_at
from model.transients.time_response import plate_in_time
from model.vibration import Tone
from plates import make_paper_rig, make_plate_in_time


def test_while_ending_is_the_mean_square_of_the_response():
    """For knots at random, what the form adds to a tone that stops is that of sampled vibrations.

    Mean over phases.
    """
    rig, plate = make_plate_in_time()
    frequency = 217.0
    carrier = solve_carrier(
        plate, frequency, residual_form=mean_square(plate, 0.1), gain_variance=0.0
    )
    point = np.array([[0.21, 0.06]])
    rows = plate.reduced.at(point)
    transients = Transients(plate)

    def sampled(knots) -> float:
        found = 0.0
        for phase in (0.0, math.pi / 2):  # their squares add up to that of the complex amplitude
            turned = knots * np.exp(1j * phase)
            envelopes, tones = {}, {}
            for number, era in enumerate(rig.eras):
                start, *rest = (turned[:, number] * era.stroke).tolist()
                envelopes[era.name] = BaseEnvelope(frequency, start, (*rest, 0j))
                tones[era.name] = Tone(frequency, abs(start), float(np.angle(start)))
            felt = transients.acceleration(
                shaped(envelopes, rig.eras), point, duration=0.005 * ENDING_KNOTS, after=tones
            )
            found += (felt**2).mean()
        return found

    for seed in range(3):
        rng = np.random.default_rng(seed)
        shape = (ENDING_KNOTS, 4)  # the tone, then seven knots, in strokes; the eighth is silence
        knots = 0.1 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        knots += (rng.standard_normal(4) + 1j) * np.linspace(1, 0, ENDING_KNOTS)[:, None]
        felt = responses_at(carrier, rows, rows)
        form, right = while_ending(felt, knots[0], gain_variance=0.0)
        added = value(form, right, knots[1:].ravel())
        stopped = np.vstack([knots[:1], 0 * knots[1:]])
        assert added == pytest.approx(sampled(knots) - sampled(stopped), abs=0.03 * sampled(knots))


def motion(terms: tuple[Term, ...], time: float) -> float:
    """Displacement of a base [m] at a time [s]: the sum of the terms that hold then."""
    return sum(
        (
            (term.c0 + term.c1 * (time - term.start))
            * cmath.exp(1j * term.omega * (time - term.start))
        ).imag
        for term in terms
        if term.start <= time < term.end
    )


def test_envelope_terms_are_linear_between_knots():
    """Half way between knots the complex amplitude is their mean, at its carrier's phase."""
    envelope = BaseEnvelope(100.0, 0j, (2e-5 + 1e-5j, -4e-5j), step=0.005)
    terms = envelope.terms()
    for time, amplitude in [
        (0.0025, 1e-5 + 0.5e-5j),
        (0.0075, 1e-5 - 1.5e-5j),
        (0.02, -4e-5j),  # the last knot stays
    ]:
        expected = (amplitude * cmath.exp(2j * math.pi * 100.0 * time)).imag
        assert motion(terms, time) == pytest.approx(expected, abs=1e-17)
        assert envelope.amplitude(np.array([time]))[0] == pytest.approx(amplitude)


def test_ramped_onset_and_ending_are_raised_cosines():
    """Half way through a ramp, up or down, the amplitude is half, and none or all at its ends."""
    rig = make_paper_rig(2, 2)
    excitation = {"SE": Tone(50.0, 1e-4, 0.3)}
    up = ramped_onset(excitation, rig.eras, ramp=0.02)
    down = ramped_ending(excitation, rig.eras, ramp=0.02)
    assert [len(base) > 0 for base in up] == [era.name == "SE" for era in rig.eras]
    se = [era.name for era in rig.eras].index("SE")
    for time, share in [(0.0, 0.0), (0.01, 0.5), (0.03, 1.0)]:
        tone = 1e-4 * math.sin(2 * math.pi * 50.0 * time + 0.3)
        assert motion(up[se], time) == pytest.approx(share * tone, abs=1e-17)
        assert motion(down[se], time) == pytest.approx((1 - share) * tone, abs=1e-17)


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
def test_bounded_minimum_equals_a_general_optimiser(seed):
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


def test_bounds_are_those_of_eras_not_of_their_combinations():
    """Two combinations of five ERAs: none exceeds its stroke, and all stay combinations."""
    A, b = random_form(3, 6)
    rng = np.random.default_rng(4)
    rows = rng.standard_normal((5, 2)) + 1j * rng.standard_normal((5, 2))
    combinations = np.linalg.qr(rows)[0]
    free = np.linalg.solve(A, b).reshape(3, 2) @ combinations.T
    knots = bounded_minimum(A, 1.3 / np.abs(free).max() * b.reshape(3, 2), combinations)
    assert knots.shape == (3, 5)
    assert 0.99 < np.abs(knots).max() <= 1
    within = knots @ combinations.conj() @ combinations.T
    np.testing.assert_allclose(within, knots, atol=0.02)


def test_bounded_minimum_of_few_rows_is_right_in_single_precision():
    """A form of three rows with decades between them, of forty unknowns, gains nearly all."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rows = np.logspace(0, -3, 3)[:, None] * rng.standard_normal((3, 40))
        A = (rows.T @ rows).astype(complex)
        wanted = 0.05 * rng.standard_normal(40)
        right = A @ wanted
        found = bounded_minimum(A, right.reshape(-1, 4), np.eye(4)).ravel()
        assert value(A, right, found) <= 0.99 * value(A, right, wanted)


OMEGA = 2 * math.pi * 110.0


class Fade(NamedTuple):
    """From one complex amplitude [m] to another; start and ramp [s]."""

    start: float
    ramp: float
    omega: float
    first: complex
    last: complex


FADES = [
    Fade(1.0, 0.02, OMEGA, 0j, 1e-4 * cmath.exp(0.7j)),
    Fade(1.005, 0.01, 2 * OMEGA, 1.6e-4j, 6e-5 - 2e-5j),
    Fade(1.01, 0.03, OMEGA, 5e-5 + 0j, 0j),
    Fade(1.015, 0.0, OMEGA / 2, 0j, 6e-5 + 0j),
]


def moved(motions: BaseMotions, number: int, era: int, time: float) -> float:
    """Displacement [m] of a base at a time [s] by the definition of a term."""
    (of_set,) = motions.active([number], [time])
    tau = time - motions.start
    value = motions.c0 + (0j if motions.c1 is None else motions.c1) * tau
    y = (value * np.exp(1j * motions.omega * tau)).imag
    return float(y[of_set & (motions.era == era)].sum())


def faded(fade: Fade, time: float) -> float:
    """Displacement [m] along a raised cosine."""
    tau = time - fade.start
    if tau < 0:
        return 0.0
    share = 1.0 if tau >= fade.ramp else (1 - math.cos(math.pi * tau / fade.ramp)) / 2
    amplitude = fade.first + (fade.last - fade.first) * share
    return (amplitude * cmath.exp(1j * fade.omega * tau)).imag


def terms(fades: Sequence[Fade]) -> Motion:
    """The motion of a base by some fades."""
    return [term for fade in fades for term in raised_cosine(*fade)]


@pytest.mark.parametrize("time", [0.99, 1.0, 1.0031, 1.0142, 1.015, 1.0199, 1.03, 1.2])
def test_terms_of_fades_add_up_to_raised_cosines(time: float) -> None:
    """Of two sets of motions each base has its own, at every moment of a fade and after it."""
    rest: Motion = ()
    motions = BaseMotions([terms(FADES[:1]), terms(FADES[1:3])], [rest, terms(FADES[3:])])
    for number, era, fades in (
        (0, 0, FADES[:1]),
        (0, 1, FADES[1:3]),
        (1, 0, []),
        (1, 1, FADES[3:]),
    ):
        expected = sum(faded(fade, time) for fade in fades)
        assert moved(motions, number, era, time) == pytest.approx(expected, abs=1e-17)


def test_terms_that_have_ended_are_left_out() -> None:
    """A fade to silence is forgotten once it is silent, a lasting tone is not."""
    motions = BaseMotions([terms([FADES[0], FADES[2]])], since=1.05)
    assert motions.omega.tolist() == [OMEGA]
    assert motions.end.tolist() == [math.inf]


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
