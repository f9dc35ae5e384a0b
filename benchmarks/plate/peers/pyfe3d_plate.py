"""pyfe3d: its four-node Reissner-Mindlin shell element with hourglass control, without membrane.

Its other one, Quad4, has a motion without energy that ERAs at the corners set off.
"""

import numpy as np
from numpy.typing import NDArray
from pyfe3d import DOF, DOUBLE, INT, Quad4R, Quad4RData, Quad4RProbe
from pyfe3d.shellprop_utils import isotropic_plate
from scipy import sparse

from benchmarks.plate.peers.scipy_sweep import sweep
from benchmarks.plate.problem import LENGTH, NU, RHO, THICKNESS, WIDTH, E, Floats

NAME = "pyfe3d"
METHOD = "Reissner-Mindlin, Quad4R"


class Plate:
    """Matrices of the free plate on nx by ny elements: deflection and two rotations a node."""

    def __init__(self, nx: int, ny: int) -> None:
        x, y = np.meshgrid(np.linspace(0, LENGTH, nx + 1), np.linspace(0, WIDTH, ny + 1))
        self.points = np.column_stack([x.ravel(), y.ravel()])
        flat = np.column_stack([self.points, np.zeros(len(self.points))]).ravel()
        node = np.arange(len(self.points)).reshape(ny + 1, nx + 1)
        corners = [node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]]
        elements = np.column_stack([corner.ravel() for corner in corners])

        data, probe = Quad4RData(), Quad4RProbe()
        section = isotropic_plate(thickness=THICKNESS, E=E, nu=NU, rho=RHO)
        sizes = (data.KC0_SPARSE_SIZE, data.M_SPARSE_SIZE)
        stiffness, mass = (
            (np.zeros(n, dtype=INT), np.zeros(n, dtype=INT), np.zeros(n, dtype=DOUBLE))
            for n in (size * len(elements) for size in sizes)
        )
        for number, nodes in enumerate(elements.tolist()):
            quad = Quad4R(probe)
            quad.n1, quad.n2, quad.n3, quad.n4 = nodes
            quad.c1, quad.c2, quad.c3, quad.c4 = (DOF * n for n in nodes)
            quad.init_k_KC0, quad.init_k_M = (size * number for size in sizes)
            quad.update_rotation_matrix(flat)
            quad.update_probe_xe(flat)
            quad.update_KC0(*stiffness, section)
            quad.update_M(*mass, section, mtype=0)
        shape = (DOF * len(self.points),) * 2
        bending = (DOF * np.arange(len(self.points))[:, None] + [2, 3, 4]).ravel()
        self.stiffness, self.mass = (
            sparse.coo_array((values, (rows, columns)), shape=shape).tocsc()[bending][:, bending]
            for rows, columns, values in (stiffness, mass)
        )
        self.dof = self.stiffness.shape[0]

    def sweep(self, places: Floats, observed: Floats) -> NDArray[np.complex128]:
        return sweep(self.stiffness, self.mass, self._dofs(places), self._dofs(observed))

    def _dofs(self, places: Floats) -> NDArray[np.int64]:
        far = np.linalg.norm(self.points[None] - places[:, None], axis=2)
        return np.asarray(3 * far.argmin(axis=1))
