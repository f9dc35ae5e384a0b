"""Exact Jacobians of projected gains, against extrapolated differences of the residuals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from extrapolated import extrapolated_slopes
from model.arrays import ComplexArray, FloatArray
from model.calibration import fit, least_squares
from model.calibration.form_errors import form_model
from model.calibration.parameters import parameters_of
from model.calibration.variable_projection import project_gains, projection_slopes
from model.diagnosis import plate_match
from model.rig.rig import Rig
from model.vibration.parametric_plate import parametric_plate
from paper_plate import make_paper_rig

RIG = make_paper_rig(12, 9)
POINTS = np.random.default_rng(0).uniform(0.02, 0.2, (5, 2))
FREQUENCIES = np.array([70.0, 130.0, 260.0, 410.0])


def curved(count: int, shape: tuple[int, ...]) -> Callable[[FloatArray], ComplexArray]:
    """A random complex function of count arguments, of second degree."""
    rng = np.random.default_rng(1)
    parts = rng.standard_normal((2, 1 + 2 * count, *shape))
    terms = parts[0] + 1j * parts[1]

    def function(z: FloatArray) -> ComplexArray:
        return np.asarray(np.tensordot(np.concatenate([[1.0], z, z**2]), terms, axes=1))

    return function


@pytest.mark.parametrize("is_expected", [False, True], ids=["free gains", "expected magnitudes"])
def test_projection_slopes_are_those_of_gains_and_residual(is_expected: bool) -> None:
    """Of a random curved model with values left out, to 1e-8 of the largest."""
    rng = np.random.default_rng(2)
    model = curved(3, (2, 4, 5))
    values = model(rng.standard_normal(3))[::-1] + 0.3
    weight = rng.uniform(0.5, 2.0, values.shape) * (rng.random(values.shape) < 0.8)
    expected_slopes = rng.uniform(-0.2, 0.2, (3, 4))

    def known(z: FloatArray) -> dict[str, Any]:
        if not is_expected:
            return {}
        return {"expected": 1.5 + z @ expected_slopes, "tolerance": 0.2}

    at = np.array([0.3, -0.2, 0.1])
    slopes = extrapolated_slopes(model, at, step=1e-3)
    further: dict[str, Any] = {"expected_slopes": expected_slopes} if is_expected else {}
    found = projection_slopes(model(at), slopes, values, weight, **known(at), **further)
    for number, own in enumerate(found):

        def projected(z: FloatArray, number: int = number) -> ComplexArray:
            return project_gains(model(z), values, weight, **known(z))[number]

        exact = extrapolated_slopes(projected, at, step=1e-3)
        np.testing.assert_allclose(own, exact, atol=1e-8 * np.abs(exact).max())


def measured(rig: Rig) -> ComplexArray:
    """Responses (f, e, s) of the rig with other gains, noise, and one value left out."""
    rng = np.random.default_rng(3)
    values = parametric_plate(rig, POINTS, FREQUENCIES).responses(rig)
    values = values * rng.uniform(0.8, 1.2, (*values.shape[:2], 1))
    values = values * (1 + 0.1 * rng.standard_normal(values.shape))
    values[1, 2, 3] = np.nan
    return np.asarray(values)


def fit_a_rig(*, has_form: bool) -> None:
    """Search without form errors and with all sensor scales free, or with all but one held."""
    free_scales = np.ones(len(POINTS), dtype=bool)
    free_scales[1:] = not has_form
    parameters = parameters_of(RIG)
    problem = fit.Problem(
        RIG,
        form_model(RIG, POINTS, FREQUENCIES),
        parameters,
        measured(RIG),
        np.ones(len(parameters), dtype=bool),
        free_scales,
    )
    start = np.array([p.start for p in parameters])
    found = fit.first_fit(problem, start)
    if has_form:
        fit.solve(problem, replace(found, scales=np.ones(len(POINTS))))


def match_a_plate() -> None:
    """Search for a plate with one channel that was not driven."""
    values = measured(replace(RIG, plate=RIG.plate.scaled(modulus=1.1)))
    values[:, 1] = np.nan
    plate = parametric_plate(RIG, POINTS, FREQUENCIES)
    plate_match.match_plate(RIG, plate, values, drives=[0, 2, 1, 3])


@pytest.mark.parametrize(
    "searched",
    [lambda: fit_a_rig(has_form=False), lambda: fit_a_rig(has_form=True), match_a_plate],
    ids=["rig and all scales", "rig and form errors", "plate"],
)
def test_jacobians_of_searches_are_exact(
    searched: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By every argument at the first start of each size, to 1e-6 of the column's largest."""
    solver: Callable[..., Any] = vars(least_squares)["least_squares"]
    checked: set[int] = set()

    def checking(
        residuals: Callable[[FloatArray], FloatArray],
        start: FloatArray,
        jacobian: Callable[[FloatArray], FloatArray],
        **options: Any,
    ) -> Any:
        if len(start) not in checked:
            at = start + 0.05
            exact = extrapolated_slopes(residuals, at, step=1e-3)
            size = np.abs(exact).max(axis=1, keepdims=True)
            np.testing.assert_allclose(jacobian(at).T / size, exact / size, atol=1e-6)
            checked.add(len(start))
        return solver(residuals, start, jacobian, **options)

    monkeypatch.setattr(least_squares, "least_squares", checking)
    searched()
    assert checked


def test_derivatives_found_are_those_of_the_residuals_whatever_the_loss() -> None:
    """A line through four points, one of them far off, whose weight in the loss is small."""
    A, values = np.array([[1.0], [2.0], [3.0], [4.0]]), np.array([1.0, 2.0, 3.0, 40.0])
    found = least_squares.search(
        lambda x: (A @ x - values, A), np.zeros(1), np.array([[-9.0], [9.0]]), loss="soft_l1"
    )
    np.testing.assert_allclose(found.jac, A)
