"""scikit-fem: Reissner-Mindlin quadrilaterals of any order, solved with SuperLU."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import skfem
from scipy import sparse
from scipy.sparse.linalg import splu

from benchmarks.plate.peers.meshes import Elements
from benchmarks.plate.problem import Case
from model.arrays import ComplexArray, FloatArray

NAME = "scikit-fem"

# Those options of SuperLU that are fastest here; its defaults take two to three times as long.
_SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}


class Matrices:
    """Matrices of the free plate; all three fields of the same order.

    They are combined from five of one field, which is three times as fast as forms of all three.
    """

    def __init__(self, case: Case, elements: Elements) -> None:
        plate = self.plate = case.plate
        self.lines = [
            _lines(length, count, elements.strips)
            for length, count in ((plate.length, elements.nx), (plate.width, elements.ny))
        ]
        mesh = skfem.MeshQuad.init_tensor(*self.lines)
        self.element = skfem.ElementQuadP(elements.order)
        self.basis = skfem.Basis(mesh, self.element, intorder=2 * elements.order)
        self.size = 3 * self.basis.N

    @cached_property
    def _matrices(self) -> tuple[Any, Any]:
        """Stiffness and mass."""
        plate, material = self.plate, self.plate.material
        h, nu = plate.thickness, material.nu
        rigidity = material.E * h**3 / (12 * (1 - nu**2))
        shear = 5 / 6 * material.E / (2 * (1 + nu)) * h

        def integral(form: Callable[[Any, Any], Any]) -> Any:
            return skfem.BilinearForm(lambda u, v, _: form(u, v)).assemble(self.basis)

        one = integral(lambda u, v: u * v)
        xx = integral(lambda u, v: u.grad[0] * v.grad[0])
        yy = integral(lambda u, v: u.grad[1] * v.grad[1])
        xy = integral(lambda u, v: u.grad[1] * v.grad[0])  # rows by x, columns by y
        x = integral(lambda u, v: u * v.grad[0])
        y = integral(lambda u, v: u * v.grad[1])
        half = (1 - nu) / 2
        across = rigidity * (nu * xy + half * xy.T)
        stiffness = sparse.block_array(
            [
                [shear * (xx + yy), -shear * x, -shear * y],
                [-shear * x.T, rigidity * (xx + half * yy) + shear * one, across],
                [-shear * y.T, across.T, rigidity * (yy + half * xx) + shear * one],
            ]
        )
        turning = material.rho * h**3 / 12 * one
        mass = sparse.block_diag([material.rho * h * one, turning, turning])
        return stiffness.tocsc(), mass.tocsc()

    def at(self, points: FloatArray) -> sparse.csr_array:
        """The deflection at points (p, 2) [m] by degrees of freedom, (p, size)."""
        cells = [
            np.clip(np.searchsorted(lines, along) - 1, 0, len(lines) - 2)
            for lines, along in zip(self.lines, points.T, strict=True)
        ]
        elements = self._numbers[cells[0], cells[1]]
        mapping = self.basis.mapping
        local = mapping.invF(points.T[:, :, None], tind=elements)
        values = [
            self.element.gbasis(mapping, local, number, tind=elements)[0].value[:, 0]
            for number in range(self.basis.Nbfun)
        ]
        columns = self.basis.element_dofs[:, elements]
        starts = np.arange(len(points) + 1) * self.basis.Nbfun
        shape = (len(points), self.size)
        return sparse.csr_array(
            (np.array(values).T.ravel(), columns.T.ravel(), starts), shape=shape
        )

    @cached_property
    def _numbers(self) -> Any:
        """Numbers of the elements by place along x and y."""
        mesh = self.basis.mesh
        middles = mesh.p[:, mesh.t].mean(axis=1)
        cells = [
            np.searchsorted(line, along) - 1
            for line, along in zip(self.lines, middles, strict=True)
        ]
        numbers = np.empty([len(line) - 1 for line in self.lines], dtype=int)
        numbers[cells[0], cells[1]] = np.arange(middles.shape[1])
        return numbers

    def dynamic_factor(self, omega: float) -> Callable[[ComplexArray], ComplexArray]:
        """Solve (1 + i eta) K - omega² M for right-hand sides (size, n)."""
        stiffness, mass = self._matrices
        dynamic = (1 + 1j * self.plate.loss_factor) * stiffness - omega**2 * mass
        return splu(dynamic, **_SYMMETRIC).solve

    def shifted_factor(self, shift: float) -> Callable[[FloatArray], FloatArray]:
        """Solve K + shift M for right-hand sides (size,) or (size, n)."""
        stiffness, mass = self._matrices
        return splu((stiffness + shift * mass).tocsc(), **_SYMMETRIC).solve

    def real(self) -> tuple[Any, Any]:
        """K and M."""
        return self._matrices


def _lines(length: float, count: int, strips: tuple[float, ...]) -> FloatArray:
    """Lines between elements along a side."""
    edge = np.concatenate([[0.0], np.cumsum(strips)])
    inner = np.linspace(edge[-1], length - edge[-1], count + 1)
    return np.concatenate([edge[:-1], inner, length - edge[:-1][::-1]])
