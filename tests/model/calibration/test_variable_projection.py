"""Exact Jacobians of searches, against extrapolated differences of their residuals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import optimize

from model.arrays import ComplexArray, FloatArray
from model.calibration import fit
from model.calibration.fit import sensed_plate
from model.diagnosis import plate_match
from model.identification import least_squares
from model.rig.rig import Rig
from plates import extrapolated_slopes, make_paper_rig

RIG = make_paper_rig(12, 9)
POINTS = np.random.default_rng(0).uniform(0.02, 0.2, (5, 2))
FREQUENCIES = np.array([70.0, 130.0, 260.0, 410.0])


def measured(rig: Rig) -> ComplexArray:
    """Responses (f, e, s) of the rig with other gains, noise, and one value left out."""
    rng = np.random.default_rng(3)
    values = sensed_plate(rig, POINTS, FREQUENCIES).responses()
    values = values * rng.uniform(0.8, 1.2, (*values.shape[:2], 1))
    values = values * (1 + 0.1 * rng.standard_normal(values.shape))
    values[1, 2, 3] = np.nan
    return np.asarray(values)


def fit_a_rig(*, are_free: bool) -> None:
    """Search with all sensor scales free, or with all but one held."""
    free_scales = np.ones(len(POINTS), dtype=bool)
    free_scales[1:] = are_free
    plate = sensed_plate(RIG, POINTS, FREQUENCIES, has_form=True)
    problem = replace(fit.CalibrationProblem.of(plate, measured(RIG)), free_scales=free_scales)
    start = fit.start_at(problem, np.zeros(plate.model.space.size))
    fit.solve(problem, replace(start, z=0 * start.z))


def match_a_plate() -> None:
    """Search for a plate with one channel that was not driven."""
    values = measured(replace(RIG, plate=RIG.plate.scaled(modulus=1.1)))
    values[:, 1] = np.nan
    plate = sensed_plate(RIG, POINTS, FREQUENCIES)
    plate_match.match_plate(plate, values, drives=[0, 2, 1, 3])


@pytest.mark.parametrize(
    "searched",
    [lambda: fit_a_rig(are_free=True), lambda: fit_a_rig(are_free=False), match_a_plate],
    ids=["rig and all scales", "rig and one scale", "plate"],
)
def test_jacobians_of_searches_are_exact(
    searched: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By every argument at the first start of each size, to 1e-6 of the column's largest."""
    solver: Callable[..., Any] = vars(optimize)["least_squares"]
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

    monkeypatch.setattr(optimize, "least_squares", checking)
    searched()
    assert checked


def test_residuals_found_are_without_the_robust_weights() -> None:
    """A line through four points, one of them far off, whose weight in the sum is small."""
    A, values = np.array([[1.0], [2.0], [3.0], [4.0]]), np.array([1.0, 2.0, 3.0, 40.0])
    found = least_squares.search(
        lambda x: (A @ x - values + 0j, A + 0j),
        np.zeros(1),
        np.array([[-9.0], [9.0]]),
        np.array([True]),
        prior=(np.zeros((0, 1)), np.zeros(0)),
        robust=0.1,
    )
    assert found.x[0] < 2.0  # 7.1 by least squares
    np.testing.assert_allclose(found.jacobian, np.vstack([A, 0 * A]))
    np.testing.assert_allclose(found.residuals[:4], A @ found.x - values)
