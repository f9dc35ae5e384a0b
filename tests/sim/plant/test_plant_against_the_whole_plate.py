"""The plate in time against the unreduced finite-element plate: transients and steady states."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import linalg, sparse
from scipy.signal import butter, sosfiltfilt

from benchmarks.direct_plate import direct_acceleration
from model.arrays import ComplexArray, FloatArray
from model.fem import Mesh, PlateMatrices, assemble
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import Era, FingertipLoad, footprints_of
from model.structure.plate import Plate
from model.transients.base_motion import Term
from plates import BASES, STROKE, Base, apart, lock_in, make_paper_rig, resting
from sim.plant.plant import Plant

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


RATE = 100_000.0
FIRST, SECOND, MOVED = (0.11, 0.07), (0.25, 0.15), (0.19, 0.12)
COMING_AND_GOING: list[tuple[float, Mapping[str, FingertipLoad]]] = [
    (0.0312, resting(FIRST)),
    (0.05, resting(FIRST, SECOND)),
    (0.06, resting(MOVED, SECOND)),
    (0.085, resting(MOVED)),
    (0.1, {}),
]


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate on a mesh for a stepping solver; no two ERAs damp alike."""
    coarse = make_paper_rig(8, 6)
    unlike = zip(coarse.eras, (0.5, 3.5, 10.0, 20.0), (0.0, 0.005, 0.01, 0.02), strict=True)
    return replace(coarse, eras=tuple(replace(era, damping=c, bolt_mass=m) for era, c, m in unlike))


@pytest.fixture(scope="module")
def whole(rig: Rig) -> WholePlate:
    """All its degrees of freedom."""
    return whole_plate(rig.plate, rig.mesh, rig.eras)


@pytest.fixture(scope="module")
def reduced(rig: Rig) -> ReducedPlate:
    """A few dozen coordinates of it, as the bench takes them."""
    return reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))


def set_bases(plant: Plant, bases: Sequence[Base]) -> None:
    """Let all bases move as they do."""
    for number, base in enumerate(bases):
        plant.set_input(number, base.terms)


def felt(samples: FloatArray) -> FloatArray:
    """What lies below 1 kHz, all that a finger can feel and more, without delay."""
    return np.asarray(sosfiltfilt(butter(6, 1000.0, fs=RATE, output="sos"), samples, axis=0))


def test_plant_with_changing_contacts_agrees_with_newmark(
    rig: Rig, whole: WholePlate, reduced: ReducedPlate
) -> None:
    """Ramps, an envelope and two fingers: displacement, velocity and what can be felt within 1 %.

    Over the plate, and under the fingers, in every stretch between two changes.
    """
    plant = Plant(reduced, rig.eras)
    set_bases(plant, BASES)
    points = np.vstack([rig.mesh.nodes, [FIRST, SECOND, MOVED]])
    pieces, states = [], []
    for until, contacts in [*COMING_AND_GOING, (0.12, None)]:
        shapes = plant.reduced.at(points)
        pieces.append(plant.advance(until, sample_rate=RATE, shapes=shapes)[1])
        states.append([shapes @ part[: shapes.shape[1]] for part in plant.state])
        if contacts is not None:
            plant.set_contacts(contacts)
    motions = [base.motion for base in BASES]
    stepped = whole.stepped(motions, COMING_AND_GOING, until=0.12, step=1e-5, every=1)
    touch = whole.matrices.deflection_at(points)
    u, v, a = ((touch @ part.T).T for part in stepped)
    found, expected = felt(np.vstack(pieces)), felt(a)
    for begin, end in [(0, 3100), (3200, 5000), (5000, 6000), (6000, 8500), (8500, 12000)]:
        assert apart(found[begin:end], expected[begin:end]) < 0.005
    for finger in (-3, -2, -1):
        assert apart(found[:, finger], expected[:, finger]) < 0.01
    for (until, _), state in zip([*COMING_AND_GOING, (0.12, None)], states, strict=True):
        row = round(until * RATE) - 1
        assert apart(state[0], u[row]) < 0.01
        assert apart(state[1], v[row]) < 0.01


def phasors(
    plant: Plant, points: FloatArray, driven: int, frequency: float, since: float
) -> ComplexArray:
    """Accelerations per base amplitude [1/s²] at points, of one ERA that has been driven long."""
    times, samples = plant.advance(
        since + 0.2, sample_rate=10_000.0, shapes=plant.reduced.at(points)
    )
    return lock_in(times, samples, frequency) / STROKE


def test_plant_viscous_equivalent_agrees_with_the_loss_factor() -> None:
    """Against the hysteretic direct solve: magnitudes over the plate, 0.1 % in the median.

    No causal law of damping can have the same loss at all frequencies; this is what is left.
    """
    fine = make_paper_rig(24, 18)
    eras: Sequence[Era] = fine.eras
    reduced = reduce_plate(fine.plate, fine.mesh, footprints_of(eras))
    frequencies = np.arange(40.0, 501.0, 46.0)
    direct = direct_acceleration(
        assemble(fine.plate, fine.mesh), eras, frequencies, fine.mesh.nodes
    )
    plant = Plant(reduced, eras)
    off = []
    for row, frequency in enumerate(frequencies):
        begin = plant.time
        plant.set_input(0, [Term(begin, np.inf, 2 * np.pi * frequency, STROKE)])
        plant.skip(begin + 20.0)
        found = phasors(plant, fine.mesh.nodes, 0, float(frequency), begin + 20.0)
        off.append(apart(np.abs(found), np.abs(direct[row, 0]) / eras[0].stroke))
    assert np.median(off) < 0.001
    assert max(off) < 0.002
