"""scikit-fem: the Kirchhoff plate with Bogner-Fox-Schmit elements, as in its example 02."""

from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray
from skfem.helpers import dd, ddot, eye, trace

from benchmarks.plate.peers.scipy_sweep import sweep
from benchmarks.plate.problem import LENGTH, NU, RHO, THICKNESS, WIDTH, E, Floats

NAME = "scikit-fem"
METHOD = "Kirchhoff, Bogner-Fox-Schmit"


class Plate:
    """Matrices of the free plate on nx by ny elements."""

    def __init__(self, nx: int, ny: int) -> None:
        mesh = skfem.MeshQuad.init_tensor(
            np.linspace(0, LENGTH, nx + 1), np.linspace(0, WIDTH, ny + 1)
        )
        basis = skfem.Basis(mesh, skfem.ElementQuadBFS(), intorder=6)
        rigidity = E * THICKNESS**3 / (12 * (1 - NU**2))

        @skfem.BilinearForm
        def bending(u: Any, v: Any, _: Any) -> Any:
            curvature = dd(u)
            moment = rigidity * ((1 - NU) * curvature + NU * eye(trace(curvature), 2))
            return ddot(moment, dd(v))

        @skfem.BilinearForm
        def inertia(u: Any, v: Any, _: Any) -> Any:
            return RHO * THICKNESS * u * v

        self.points = mesh.p.T
        self.deflection = basis.nodal_dofs[0]
        self.stiffness = bending.assemble(basis)
        self.mass = inertia.assemble(basis)
        self.dof = self.stiffness.shape[0]

    def sweep(self, places: Floats, observed: Floats) -> NDArray[np.complex128]:
        return sweep(self.stiffness, self.mass, self._dofs(places), self._dofs(observed))

    def _dofs(self, places: Floats) -> NDArray[np.int64]:
        far = np.linalg.norm(self.points[None] - places[:, None], axis=2)
        return np.asarray(self.deflection[far.argmin(axis=1)])
