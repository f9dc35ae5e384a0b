"""NGSolve: Reissner-Mindlin quadrilaterals of any order, and NGSolve's own sparse Cholesky."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import netgen.meshing  # noqa: F401  # NGSolve's mesh class lives there
import ngsolve as ng
import numpy as np
from ngsolve.meshes import MakeStructured2DMesh
from scipy import sparse

from benchmarks.plate.peers.meshes import Elements
from benchmarks.plate.problem import Case
from model.arrays import ComplexArray, FloatArray

NAME = "NGSolve"
ng.SetNumThreads(1)


class Matrices:
    """Matrices of the free plate; all three fields of the same order."""

    def __init__(self, case: Case, elements: Elements) -> None:
        plate = self.plate = case.plate
        sides = {"left": plate.length, "right": plate.length}
        sides |= {"top": plate.width, "bottom": plate.width}
        strips = {side: [w / size for w in elements.strips] for side, size in sides.items()}
        more = 2 * len(elements.strips)
        self.mesh = MakeStructured2DMesh(
            quads=True,
            nx=elements.nx + more,
            ny=elements.ny + more,
            boundarylayer=strips,
            mapping=lambda x, y: (plate.length * x, plate.width * y),
        )
        self.scalar = ng.H1(self.mesh, order=elements.order)
        self.size = 3 * self.scalar.ndof
        self.order = elements.order

    @cached_property
    def _real(self) -> tuple[Any, Any]:
        return self._assembled(is_complex=False)

    @cached_property
    def _complex(self) -> tuple[Any, Any, Any]:
        stiffness, mass = self._assembled(is_complex=True)
        return stiffness, mass, stiffness.CreateMatrix()

    def _assembled(self, *, is_complex: bool) -> tuple[Any, Any]:
        """Stiffness and mass."""
        plate, material = self.plate, self.plate.material
        h, nu = plate.thickness, material.nu
        rigidity = material.E * h**3 / (12 * (1 - nu**2))
        shear = 5 / 6 * material.E / (2 * (1 + nu)) * h
        scalar = ng.H1(self.mesh, order=self.order, complex=is_complex)
        space = ng.FESpace([scalar] * 3)
        (w, bx, by), (v, cx, cy) = space.TnT()
        first, second = ng.CF((bx, by)), ng.CF((cx, cy))
        xx, yy = ng.grad(bx)[0], ng.grad(by)[1]
        twist, twist_test = ng.grad(bx)[1] + ng.grad(by)[0], ng.grad(cx)[1] + ng.grad(cy)[0]
        bending = (xx + nu * yy) * ng.grad(cx)[0] + (yy + nu * xx) * ng.grad(cy)[1]
        bending = rigidity * (bending + (1 - nu) / 2 * twist * twist_test)
        sliding = shear * (ng.grad(w) - first) * (ng.grad(v) - second)
        turning = material.rho * h**3 / 12 * first * second
        stiffness = ng.BilinearForm((bending + sliding) * ng.dx).Assemble()
        mass = ng.BilinearForm((material.rho * h * w * v + turning) * ng.dx).Assemble()
        return stiffness.mat, mass.mat

    def at(self, points: FloatArray) -> sparse.csr_array:
        """The deflection at points (p, 2) [m] by degrees of freedom, (p, size)."""
        dofs, values = [], []
        for x, y in points.tolist():
            place = self.mesh(x, y)
            element = ng.ElementId(ng.VOL, place.nr)
            dofs.append(self.scalar.GetDofNrs(element))
            values.append(self.scalar.GetFE(element).CalcShape(*place.pnt[:2]).NumPy())
        columns = np.array(dofs).ravel()
        starts = np.arange(len(points) + 1) * len(dofs[0])
        shape = (len(points), self.size)
        return sparse.csr_array((np.array(values).ravel(), columns, starts), shape=shape)

    def dynamic_factor(self, omega: float) -> Callable[[ComplexArray], ComplexArray]:
        """Solve (1 + i eta) K - omega² M for right-hand sides (size, n)."""
        stiffness, mass, dynamic = self._complex
        dynamic.AsVector().data = (1 + 1j * self.plate.loss_factor) * stiffness.AsVector()
        dynamic.AsVector().data -= omega**2 * mass.AsVector()
        inverse = dynamic.Inverse(inverse="sparsecholesky")
        return lambda forces: _solve(inverse, dynamic, forces)

    def shifted_factor(self, shift: float) -> Callable[[FloatArray], FloatArray]:
        """Solve K + shift M for right-hand sides (size,) or (size, n)."""
        stiffness, mass = self._real
        shifted = stiffness.CreateMatrix()
        shifted.AsVector().data = stiffness.AsVector() + shift * mass.AsVector()
        inverse = shifted.Inverse(inverse="sparsecholesky")
        return lambda forces: _solve(inverse, shifted, forces)

    def real(self) -> tuple[Any, Any]:
        """K and M."""
        shape = (self.size, self.size)
        stiffness, mass = (
            sparse.csr_array((values.NumPy(), columns.NumPy(), starts.NumPy()), shape=shape)
            for values, columns, starts in (each.CSR() for each in self._real)
        )
        return stiffness, mass


def _solve(inverse: Any, matrix: Any, forces: Any) -> Any:
    force, field = matrix.CreateColVector(), matrix.CreateColVector()
    result = np.empty_like(forces)
    for column in np.ndindex(forces.shape[1:]):
        force.FV().NumPy()[:] = forces[:, *column]
        field.data = inverse * force
        result[:, *column] = field.FV().NumPy()
    return result
