"""Two methods of peers for a sweep: a factorization per frequency, or modes."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from benchmarks.plate.problem import Case, accelerations
from model.arrays import ComplexArray, FloatArray
from model.structure.footprints import mean_over

TOLERANCE = 1e-6
"""Relative tolerance of the eigenvalues."""


class Matrices(Protocol):
    """Matrices of a free plate, by a peer."""

    size: int

    def at(self, points: FloatArray) -> sparse.csr_array:
        """The deflection at points (p, 2) [m] by degrees of freedom, (p, size)."""

    def dynamic_factor(self, omega: float) -> Callable[[ComplexArray], ComplexArray]:
        """Solve (1 + i eta) K - omega² M for right-hand sides (size, n)."""

    def shifted_factor(self, shift: float) -> Callable[[FloatArray], FloatArray]:
        """Solve K + shift M for right-hand sides (size,) or (size, n)."""

    def real(self) -> tuple[Any, Any]:
        """K and M."""


def deflections(case: Case, matrices: Matrices, shares: FloatArray) -> sparse.csr_array:
    """Mean deflection under ERAs at shares (n, 2) of the sides, by degrees of freedom."""
    plate = case.plate
    feet = case.footprints(shares)
    return mean_over(matrices.at, feet, length=plate.length, width=plate.width)


class Direct:
    """A factor per frequency."""

    way = "factor per frequency"

    def __init__(self, case: Case, matrices: Matrices) -> None:
        self.case, self.matrices = case, matrices

    def sweep(self, shares: FloatArray) -> ComplexArray:
        """Acceleration (f, eras, p) with ERAs at shares (n, 2) of the sides."""
        return self.sweeps([shares])[0]

    def sweeps(self, layouts: Sequence[FloatArray]) -> list[ComplexArray]:
        """The same for several layouts of equally many ERAs, with the same factors."""
        touch = deflections(self.case, self.matrices, np.concatenate(layouts))
        look = self.matrices.at(self.case.points)
        forces = touch.toarray().T.astype(complex)
        between, to_points = [], []
        for omega in self.case.omega:
            fields = self.matrices.dynamic_factor(omega)(forces)
            between.append(touch @ fields)
            to_points.append((look @ fields).T)
        found, n = [], len(layouts[0])
        for first in range(0, n * len(layouts), n):
            own = slice(first, first + n)
            between_own = np.array(between)[:, own, own]
            to_own = np.array(to_points)[:, own]
            found.append(accelerations(self.case, between_own, to_own))
        return found


class Modes:
    """Modes of the free plate; two static solves per position for truncated modes.

    The factor of K + shift M is used for the modes and the static solves. Truncated modes are the
    first two terms of 1 / (lambda - z) about z = -shift.
    """

    way = "modes, kept factor"

    def __init__(self, case: Case, matrices: Matrices, count: int) -> None:
        self.case, self.matrices = case, matrices
        stiffness, self.mass = matrices.real()
        self.shift = (2 * np.pi * case.highest / 3) ** 2
        self.solve = matrices.shifted_factor(self.shift)
        inverse = LinearOperator(stiffness.shape, matvec=self.solve, dtype=float)
        self.eigenvalues, self.shapes = eigsh(
            stiffness, count, self.mass, sigma=-self.shift, OPinv=inverse, tol=TOLERANCE
        )

    def sweep(self, shares: FloatArray) -> ComplexArray:
        """Acceleration (f, eras, p) with ERAs at shares (n, 2) of the sides."""
        touch = deflections(self.case, self.matrices, shares)
        look = self.matrices.at(self.case.points)
        first = self.solve(touch.toarray().T)
        weighted = self.mass @ first
        at, to = touch @ self.shapes, look @ self.shapes
        loss = 1 + 1j * self.case.plate.loss_factor
        shifted = (self.case.omega**2 / loss + self.shift)[:, None]
        static = 1 / (self.eigenvalues + self.shift)
        modal = 1 / (1 / static - shifted) - static - shifted * static**2
        modal_at = modal[:, None, :] * at
        between = modal_at @ at.T + touch @ first + shifted[..., None] * (first.T @ weighted)
        to_points = modal_at @ to.T + (look @ first).T
        to_points += shifted[..., None] * (look @ self.solve(weighted)).T
        return accelerations(self.case, between / loss, to_points / loss)

    def sweeps(self, layouts: Sequence[FloatArray]) -> list[ComplexArray]:
        """The same for several layouts."""
        return [self.sweep(layout) for layout in layouts]
