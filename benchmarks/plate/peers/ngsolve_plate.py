"""NGSolve: Reissner-Mindlin with order 3 on quadrilaterals, and NGSolve's own sparse solver.

Elements are three times as large, for as many unknowns as the others have.
"""

import netgen.meshing  # noqa: F401  # NGSolve's mesh class lives there
import ngsolve as ng
import numpy as np
from ngsolve.meshes import MakeStructured2DMesh
from numpy.typing import NDArray

from benchmarks.plate.problem import (
    LENGTH,
    LOSS_FACTOR,
    NU,
    OMEGA,
    RHO,
    STROKE,
    THICKNESS,
    WIDTH,
    E,
    Floats,
    hold,
)  # fmt: skip

NAME = "NGSolve"
METHOD = "Reissner-Mindlin, order 3"
ORDER = 3


class Plate:
    """Matrices of the free plate on nx / 3 by ny / 3 elements of order 3."""

    def __init__(self, nx: int, ny: int) -> None:
        ng.SetNumThreads(1)
        self.mesh = MakeStructured2DMesh(
            quads=True, nx=nx // ORDER, ny=ny // ORDER, mapping=lambda x, y: (LENGTH * x, WIDTH * y)
        )
        rigidity = E * THICKNESS**3 / (12 * (1 - NU**2))
        shear = 5 / 6 * E / (2 * (1 + NU)) * THICKNESS
        scalar = ng.H1(self.mesh, order=ORDER, complex=True)
        space = ng.FESpace([scalar, scalar, scalar])
        (w, bx, by), (v, cx, cy) = space.TnT()
        first, second = ng.CF((bx, by)), ng.CF((cx, cy))
        xx, yy = ng.grad(bx)[0], ng.grad(by)[1]
        twist, twist_test = ng.grad(bx)[1] + ng.grad(by)[0], ng.grad(cx)[1] + ng.grad(cy)[0]
        bending = (xx + NU * yy) * ng.grad(cx)[0] + (yy + NU * xx) * ng.grad(cy)[1]
        bending = rigidity * (bending + (1 - NU) / 2 * twist * twist_test)
        sliding = shear * (ng.grad(w) - first) * (ng.grad(v) - second)
        turning = RHO * THICKNESS**3 / 12 * first * second
        with ng.TaskManager():
            self.stiffness = ng.BilinearForm((bending + sliding) * ng.dx, symmetric=False)
            self.stiffness.Assemble()
            self.mass = ng.BilinearForm((RHO * THICKNESS * w * v + turning) * ng.dx)
            self.mass.Assemble()
        self.space = space
        self.points = np.array([vertex.point for vertex in self.mesh.vertices])
        self.dof = space.ndof

    def sweep(self, places: Floats, observed: Floats) -> NDArray[np.complex128]:
        touch, look = self._dofs(places), self._dofs(observed)
        dynamic = self.stiffness.mat.CreateMatrix()
        force, field = (self.stiffness.mat.CreateColVector() for _ in range(2))
        result = np.empty((len(OMEGA), len(touch), len(look)), dtype=complex)
        for row, omega in enumerate(OMEGA):
            dynamic.AsVector().data = (1 + 1j * LOSS_FACTOR) * self.stiffness.mat.AsVector()
            dynamic.AsVector().data -= omega**2 * self.mass.mat.AsVector()
            for dof in touch:
                dynamic[dof, dof] += hold(omega)
            inverse = dynamic.Inverse(self.space.FreeDofs(), inverse="sparsecholesky")
            for era, dof in enumerate(touch):
                force[:] = 0
                force[dof] = hold(omega) * STROKE
                field.data = inverse * force
                result[row, era] = -(omega**2) * field.FV().NumPy()[look]
        return result

    def _dofs(self, places: Floats) -> list[int]:
        """Of the deflection at vertices; vertices come first, and the deflection first of three."""
        far = np.linalg.norm(self.points[None] - places[:, None], axis=2)
        return [int(vertex) for vertex in far.argmin(axis=1)]
