"""The plate in time, compared with the unreduced finite-element plate and with direct solutions.

Fingers come and go; exciters play the answers of a table.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg, sparse
from scipy.signal import butter, sosfiltfilt

from kit.direct_plate import direct_acceleration
from kit.plates import BASES, STROKE, apart, exciter_rig, lock_in, make_paper_rig, resting
from model.answer.plan import query
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import Mesh, PlateMatrices, assemble
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.fingertips import FingertipLoad
from model.structure.plate import Plate
from model.structure.sources import Era
from model.table.table_file import build_table
from model.transients.base_motion import Term
from sim.plant.excited_plate import play
from sim.plant.plant import Plant


def test_plant_rejects_an_unsupported_plate(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Two ERAs leave the plate free to rotate about the axis through them."""
    with pytest.raises(InputError, match="supported"):
        Plant(reduced, coarse_rig.eras[:2])


def motion_on_mesh(plant: Plant) -> FloatArray:
    """Return displacement and velocity at the nodes of a mesh (2, n)."""
    plate = plant.reduced.plate
    shapes = plant.reduced.at(Mesh(12, 9, plate.length, plate.width).nodes)
    return np.array([shapes @ part[: shapes.shape[1]] for part in plant.state])


def test_plant_drops_the_modes_of_lifted_fingers(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Half a second later the state is as small as before, and the plate has not jumped."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_input(0, [Term(0.0, np.inf, 2 * np.pi * 207.0, 1e-4)])
    single = resting((0.11, 0.07))
    plant.set_contacts(resting((0.11, 0.07), (0.25, 0.15), (0.3048, 0.1)))
    plant.skip(0.1)
    size = len(plant.reduced.omega)
    assert size == len(reduced.omega) + 9
    plant.set_contacts(single)
    assert len(plant.reduced.omega) == size
    plant.skip(0.6)
    earlier_motion = motion_on_mesh(plant)

    plant.set_contacts({})
    plant.set_contacts(single)

    assert len(plant.reduced.omega) == len(reduced.omega) + 3
    for earlier, later in zip(earlier_motion, motion_on_mesh(plant), strict=True):
        assert_allclose(later, earlier, rtol=0, atol=1e-4 * np.abs(earlier).max())


def plant_of(rig: Rig) -> Plant:
    """Return the plate of a rig at rest."""
    footprints = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(rig.plate, rig.mesh, footprints, frequency_max=500.0)
    return Plant(reduced, rig.eras, loads=rig.masses)


def test_nominal_answer_of_exciters_is_felt_on_the_unreduced_plate() -> None:
    """The level of a target agrees within 0.3 dB, and its contrast within 0.5 dB."""
    rig = exciter_rig(frequency="[60, 300]")
    table = build_table(rig, frequencies=np.arange(70.0, 300.0, 20.0), drive_mode="phased")
    target = (0.06, 0.05)
    quiet = (0.22, 0.17)
    answer = query(table, Placement((target,), (quiet,)), 20.0)
    fingers = [Finger(target, stimulus=Stimulus()), Finger(quiet)]

    played = play(rig, plant_of(rig).reduced, answer.layers, fingers, duration=None)

    promised = answer.fingers[0]
    felt = played.fingers[0]
    assert felt.level_db_sl == pytest.approx(promised.level_db_sl, abs=0.3)
    assert played.contrast_db == pytest.approx(promised.contrast_db, abs=0.5)


Contacts = Mapping[str, FingertipLoad]
Motion = Callable[[float], tuple[float, float]]
"""Displacement [m] and velocity [m/s] of a base at a time [s]."""


@dataclass(frozen=True, eq=False)
class WholePlate:
    """The unreduced plate on its ERAs, of `dof` degrees of freedom."""

    matrices: PlateMatrices
    eras: Sequence[Era]
    M: FloatArray
    C: FloatArray
    K: FloatArray
    """Mass, damping and stiffness (dof, dof)."""
    at_eras: FloatArray
    """Takes the deflections at the ERAs (n, dof)."""

    def with_contacts(self, contacts: Contacts) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return M, C and K with the displacements of the fingers' phalanges last."""
        dof = len(self.M)
        M = np.pad(self.M, (0, len(contacts)))
        C = np.pad(self.C, (0, len(contacts)))
        K = np.pad(self.K, (0, len(contacts)))
        for phalanx, load in enumerate(contacts.values(), start=dof):
            tip = load.fingertip
            touch = np.zeros(len(M))
            position = np.array([[load.x, load.y]])
            touch[:dof] = self.matrices.deflection_at(position).toarray()[0]
            compression = touch.copy()
            compression[phalanx] = -1.0
            M += tip.contact_mass * np.outer(touch, touch)
            C += tip.damping * np.outer(compression, compression)
            K += tip.stiffness * np.outer(compression, compression)
            M[phalanx, phalanx] += tip.phalanx_mass
            C[phalanx, phalanx] += tip.joint_damping
            K[phalanx, phalanx] += tip.joint_stiffness
        return M, C, K

    def force(self, bases: Sequence[Motion], time: float) -> FloatArray:
        """Return the forces of the ERAs on the degrees of freedom at a time."""
        forces = np.zeros(len(self.M))
        for era, base, row in zip(self.eras, bases, self.at_eras, strict=True):
            displacement, velocity = base(time)
            forces += (era.stiffness * displacement + era.damping * velocity) * row
        return forces


class Newmark:
    """Newmark's method of the mean acceleration, from rest."""

    def __init__(self, whole: WholePlate, bases: Sequence[Motion], step: float) -> None:
        self.whole = whole
        self.bases = bases
        self.step = step
        self.number = 0
        self.contacts: Contacts = {}
        self.u = np.zeros(len(whole.M))
        self.v = np.zeros(len(whole.M))
        self._assemble()

    def _net_force(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return the forces of the bases less those of springs and dampers."""
        forces = self.whole.force(self.bases, self.number * self.step)
        forces = np.pad(forces, (0, len(self.contacts)))
        return forces - self.C @ v - self.K @ u

    def _assemble(self) -> None:
        self.M, self.C, self.K = self.whole.with_contacts(self.contacts)
        half = self.step / 2
        effective = self.M + half * self.C + half**2 * self.K
        self.inverse = linalg.inv(effective)
        forces = self._net_force(self.u, self.v)
        self.a = linalg.solve(self.M, forces)

    def set_contacts(self, contacts: Contacts) -> None:
        """Change the fingers: a phalanx that remains keeps its motion, a new one is at rest."""
        dof = len(self.whole.M)
        phalanges = self._phalanges(self.u[dof:], contacts)
        self.u = np.append(self.u[:dof], phalanges)
        phalanges = self._phalanges(self.v[dof:], contacts)
        self.v = np.append(self.v[:dof], phalanges)
        self.contacts = contacts
        self._assemble()

    def _phalanges(self, values: FloatArray, contacts: Contacts) -> list[float]:
        by_finger = dict(zip(self.contacts, values, strict=True))
        return [by_finger.get(finger, 0.0) for finger in contacts]

    def advance(self) -> None:
        """Advance by one step."""
        half = self.step / 2
        self.number += 1
        v_guess = self.v + half * self.a
        u_guess = self.u + half * (self.v + v_guess)
        self.a = self.inverse @ self._net_force(u_guess, v_guess)
        self.u = u_guess + half**2 * self.a
        self.v = v_guess + half * self.a


def whole_plate(plate: Plate, mesh: Mesh, eras: Sequence[Era]) -> WholePlate:
    """Put a plate on its ERAs; C_jk = eta psi_j' K psi_k / sqrt(omega_j omega_k) in its modes."""
    matrices = assemble(plate, mesh)
    positions = np.array([[era.x, era.y] for era in eras])
    at_eras = matrices.deflection_at(positions).toarray()
    plate_stiffness = sparse.csc_array(matrices.stiffness).toarray()
    M = sparse.csc_array(matrices.mass).toarray()
    K = plate_stiffness.copy()
    era_damping = np.zeros_like(K)
    for era, row in zip(eras, at_eras, strict=True):
        M += era.bolt_mass * np.outer(row, row)
        K += era.stiffness * np.outer(row, row)
        era_damping += era.damping * np.outer(row, row)
    squares, psi = linalg.eigh(K, M)
    omega = np.sqrt(squares)
    modal_loss = psi.T @ plate_stiffness @ psi
    modal_loss /= np.sqrt(np.outer(omega, omega))
    back = M @ psi
    C = plate.loss_factor * back @ modal_loss @ back.T + era_damping
    return WholePlate(matrices, tuple(eras), M, C, K, at_eras)


FINE_RATE = 100_000.0
FIRST, SECOND, MOVED = (0.11, 0.07), (0.25, 0.15), (0.19, 0.12)
CONTACTS: list[tuple[float, Contacts]] = [
    (0.0312, resting(FIRST)),
    (0.05, resting(FIRST, SECOND)),
    (0.06, resting(MOVED, SECOND)),
    (0.085, resting(MOVED)),
    (0.1, {}),
    (0.12, {}),
]
"""Times [s], and the fingers from then on."""


def below_1_khz(samples: FloatArray) -> FloatArray:
    """Return all that a finger can feel and more, without delay."""
    sections = butter(6, 1000.0, fs=FINE_RATE, output="sos")
    return np.asarray(sosfiltfilt(sections, samples, axis=0))


def test_plant_with_changing_contacts_agrees_with_newmark() -> None:
    """Ramps, an envelope and two fingers: displacement, velocity and perceptible acceleration.

    Within 1 % over the plate and under the fingers, between any two changes. The ERAs differ in
    damping.
    """
    rig = make_paper_rig(8, 6)
    losses = ((0.5, 0.0), (3.5, 0.005), (10.0, 0.01), (20.0, 0.02))
    eras = []
    for era, (damping, bolt_mass) in zip(rig.eras, losses, strict=True):
        eras.append(replace(era, damping=damping, bolt_mass=bolt_mass))
    whole = whole_plate(rig.plate, rig.mesh, eras)
    points = np.vstack([rig.mesh.nodes, [FIRST, SECOND, MOVED]])
    touch = whole.matrices.deflection_at(points)
    plant = Plant(reduce_plate(rig.plate, rig.mesh, footprints_of(eras)), eras)
    for number, base in enumerate(BASES):
        plant.set_input(number, base.terms)
    newmark = Newmark(whole, [base.motion for base in BASES], 1 / FINE_RATE)
    dof = len(whole.M)

    stretches = []
    expected_stretches = []
    for until, contacts in CONTACTS:
        shapes = plant.reduced.at(points)
        _, samples = plant.advance(until, sample_rate=FINE_RATE, shapes=shapes)
        expected = []
        while newmark.number < round(until * FINE_RATE):
            newmark.advance()
            expected.append(touch @ newmark.a[:dof])
        modes = shapes.shape[1]
        displacements = shapes @ plant.state[0][:modes]
        assert apart(displacements, touch @ newmark.u[:dof]) < 0.01, until
        velocities = shapes @ plant.state[1][:modes]
        assert apart(velocities, touch @ newmark.v[:dof]) < 0.01, until
        stretches += [samples]
        expected_stretches += [np.array(expected)]
        plant.set_contacts(contacts)
        newmark.set_contacts(contacts)

    felt = below_1_khz(np.vstack(stretches))
    expected_felt = below_1_khz(np.vstack(expected_stretches))
    for start, end in [(0, 3100), (3200, 5000), (5000, 6000), (6000, 8500), (8500, 12000)]:
        assert apart(felt[start:end], expected_felt[start:end]) < 0.005, start
    for finger in (-3, -2, -1):
        assert apart(felt[:, finger], expected_felt[:, finger]) < 0.01, finger


def test_plant_viscous_damping_agrees_with_the_loss_factor() -> None:
    """Magnitudes over the plate agree with the hysteretic direct solve, 0.1 % in the median.

    No causal law of damping has the same loss at all frequencies, so a difference remains.
    """
    rig = make_paper_rig(24, 18)
    frequencies = np.arange(40.0, 501.0, 46.0)
    nodes = rig.mesh.nodes
    matrices = assemble(rig.plate, rig.mesh)
    eras = rig.eras
    direct = direct_acceleration(matrices, eras, frequencies, nodes)
    first_era = direct[:, 0] / eras[0].stroke
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(eras))
    plant = Plant(reduced, eras)
    shapes = plant.reduced.at(nodes)

    differences = []
    for frequency, expected in zip(frequencies, first_era, strict=True):
        start = plant.time
        omega = 2 * np.pi * frequency
        plant.set_input(0, [Term(start, np.inf, omega, STROKE)])
        plant.skip(start + 20.0)
        times, samples = plant.advance(start + 20.2, sample_rate=10_000.0, shapes=shapes)
        amplitudes = lock_in(times, samples, float(frequency)) / STROKE
        differences.append(apart(np.abs(amplitudes), np.abs(expected)))

    assert np.median(differences) < 0.001
    assert max(differences) < 0.002
