"""The unreduced finite-element plate on its ERAs, stepped through time by Newmark's method.

Matrices come from the mesh and its assembly, what holds and loads the plate is put on them here,
and structural damping is made of all modes of the supported plate by the formula of the
documentation; none of it is the code of the plate in time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.fem.plate import PlateMatrices, assemble
from model.structure.attachments import Era, FingertipLoad
from model.structure.plate import Plate

Motion = Callable[[float], tuple[float, float]]
"""Displacement [m] and velocity [m/s] of a base at a time [s]."""


@dataclass(frozen=True, eq=False)
class WholePlate:
    """M, C, K (dof, dof) of the plate on its ERAs; hold: takes the deflections at them (n, dof)."""

    matrices: PlateMatrices
    eras: Sequence[Era]
    M: FloatArray
    C: FloatArray
    K: FloatArray
    hold: FloatArray

    def with_contacts(
        self, contacts: Mapping[str, FingertipLoad]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M, C, K (dof + n, dof + n) with n fingers on it, the phalanges' displacements last."""
        dof, n = len(self.M), len(contacts)
        M, C, K = (np.pad(each, (0, n)) for each in (self.M, self.C, self.K))
        for number, each in enumerate(contacts.values(), start=dof):
            tip = each.fingertip
            touch = np.zeros(dof + n)
            touch[:dof] = self.matrices.deflection_at(np.array([[each.x, each.y]])).toarray()[0]
            squeezed = touch.copy()
            squeezed[number] = -1.0
            M += tip.contact_mass * np.outer(touch, touch)
            C += tip.damping * np.outer(squeezed, squeezed)
            K += tip.stiffness * np.outer(squeezed, squeezed)
            M[number, number] += tip.phalanx_mass
            C[number, number] += tip.joint_damping
            K[number, number] += tip.joint_stiffness
        return M, C, K

    def stepped(
        self,
        bases: Sequence[Motion],
        contacts: Sequence[tuple[float, Mapping[str, FingertipLoad]]],
        *,
        until: float,
        step: float,
        every: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement, velocity and acceleration (n, dof) from rest, every so many steps.

        By Newmark's method of the mean acceleration. step [s]; contacts: from when on which fingers
        rest on the plate, at multiples of the step; those that stay take their phalanx along, new
        ones come with it at rest. A sample at such a moment is still of the plate as it was before.
        """
        count, dof = round(until / step), len(self.M)
        begins = {round(begin / step): fingers for begin, fingers in contacts}
        resting = begins.pop(0, {})
        M, C, K = self.with_contacts(resting)
        u, v = np.zeros(len(M)), np.zeros(len(M))

        def force(number: int) -> FloatArray:
            motion = [base(number * step) for base in bases]
            size = [
                era.stiffness * y + era.damping * dy
                for era, (y, dy) in zip(self.eras, motion, strict=True)
            ]
            return np.pad(np.array(size) @ self.hold, (0, len(resting)))

        inverse = linalg.inv(M + step / 2 * C + step**2 / 4 * K)
        a = linalg.solve(M, force(0))
        samples = np.empty((3, count // every, dof))
        for number in range(1, count + 1):
            u_guess = u + step * v + step**2 / 4 * a
            v_guess = v + step / 2 * a
            a = inverse @ (force(number) - C @ v_guess - K @ u_guess)
            u, v = u_guess + step**2 / 4 * a, v_guess + step / 2 * a
            if number % every == 0:
                samples[:, number // every - 1] = u[:dof], v[:dof], a[:dof]
            if number in begins:
                u, v = (
                    np.concatenate(
                        [each[:dof], [dict(zip(resting, each[dof:], strict=True)).get(id, 0.0)
                                      for id in begins[number]]]
                    )
                    for each in (u, v)
                )  # fmt: skip
                resting = begins[number]
                M, C, K = self.with_contacts(resting)
                inverse = linalg.inv(M + step / 2 * C + step**2 / 4 * K)
                a = linalg.solve(M, force(number) - C @ v - K @ u)
        return samples[0], samples[1], samples[2]


def whole_plate(plate: Plate, mesh: Mesh, eras: Sequence[Era]) -> WholePlate:
    """Put a plate on its ERAs; C_jk = eta psi_j' K psi_k / sqrt(omega_j omega_k) in its modes."""
    matrices = assemble(plate, mesh)
    hold = matrices.deflection_at(np.array([[era.x, era.y] for era in eras])).toarray()
    dense = [sparse.csc_array(each).toarray() for each in (matrices.mass, matrices.stiffness)]
    M = dense[0] + sum(
        era.bolt_mass * np.outer(row, row) for era, row in zip(eras, hold, strict=True)
    )
    K = dense[1] + sum(
        era.stiffness * np.outer(row, row) for era, row in zip(eras, hold, strict=True)
    )
    squares, psi = linalg.eigh(K, M)
    omega = np.sqrt(squares)
    back = M @ psi
    lossy = psi.T @ dense[1] @ psi / np.sqrt(np.outer(omega, omega))
    C = plate.loss_factor * back @ lossy @ back.T
    C += sum(era.damping * np.outer(row, row) for era, row in zip(eras, hold, strict=True))
    return WholePlate(matrices, tuple(eras), M, C, K, hold)
