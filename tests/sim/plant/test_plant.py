"""The plate in time, against a linear system and the unreduced finite-element plate.

Transients, steady states and continuity; exciters, the answers of a table as they are played, and
contacts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg, sparse
from scipy.signal import butter, sosfiltfilt

from kit.direct_plate import direct_acceleration
from kit.plates import BASES as MOVED_BASES
from kit.plates import STROKE as BASE_STROKE
from kit.plates import (
    apart,
    exciter_rig,
    faded_base,
    lock_in,
    make_paper_rig,
    resting,
    shaped_base,
)
from model.answer.plan import query
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import Mesh, PlateMatrices, assemble
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.fingertips import Fingertip, FingertipLoad
from model.structure.plate import Plate
from model.structure.sources import Era
from model.table.table_file import build_table
from model.transients.base_motion import Term, raised_cosine
from sim.plant.excited_plate import play
from sim.plant.plant import Plant

STROKE = 1e-4


def test_plant_refuses_an_unsupported_plate(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Two ERAs leave the axis through them free to rotate."""
    with pytest.raises(InputError, match="supported"):
        Plant(reduced, coarse_rig.eras[:2])


BASES = (
    faded_base(STROKE, 110.0, 0.3, rise=(0.0, 0.02), fall=(0.07, 0.08)),
    faded_base(0.7 * STROKE, 250.0, -1.0, rise=(0.01, 0.03), fall=(0.09, 0.1)),
    shaped_base(STROKE, 171.0, start=0.002, step=0.005, knots=(0, 0.5, 0.8j, -0.3, 0)),
)
PLACES = ((0.11, 0.07), (0.25, 0.15), (0.3048, 0.1))
ONE, THREE = resting(PLACES[0]), resting(*PLACES)


def on_the_mesh(plant: Plant) -> tuple[FloatArray, FloatArray]:
    """Displacement and velocity at all nodes."""
    plate = plant.reduced.plate
    shapes = plant.reduced.at(Mesh(12, 9, plate.length, plate.width).nodes)
    q, v = (part[: shapes.shape[1]] for part in plant.state)
    return shapes @ q, shapes @ v


def phalanges(plant: Plant) -> dict[str, FloatArray]:
    """Displacement and velocity of each contact's phalanx."""
    last = np.transpose(plant.state)[len(plant.reduced.omega) :]
    return dict(zip(plant.contacts, last, strict=True))


def test_contacts_drop_vectors_of_lifted_fingers(coarse_rig: Rig, reduced: ReducedPlate) -> None:
    """Half a second later the plate is as small as before, and nothing of it has jumped."""
    plant = Plant(reduced, coarse_rig.eras)
    plant.set_input(0, [Term(0.0, np.inf, 2 * np.pi * 207.0, STROKE)])
    plant.set_contacts(THREE)
    plant.skip(0.1)
    size = len(plant.reduced.omega)
    assert size == len(reduced.omega) + 9
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == size
    plant.skip(0.6)
    before = on_the_mesh(plant)
    plant.set_contacts({})
    plant.set_contacts(ONE)
    assert len(plant.reduced.omega) == len(reduced.omega) + 3
    for old, new in zip(before, on_the_mesh(plant), strict=True):
        assert_allclose(new, old, rtol=0, atol=1e-4 * np.abs(old).max())


def plant_of(rig: Rig) -> Plant:
    """Its plate at rest."""
    places = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(rig.plate, rig.mesh, places, frequency_max=500.0)
    return Plant(reduced, rig.eras, loads=rig.masses)


def settled(plant: Plant, until: float, frequency: float) -> complex:
    """Amplitude at a point in the last fifth of a second up to a time."""
    plant.skip(until - 0.2)
    shapes = plant.reduced.at(np.array([[0.11, 0.09]]))
    times, felt = plant.advance(until, sample_rate=10_000.0, shapes=shapes)
    return complex(lock_in(times, felt, frequency)[0])


def test_a_finger_that_comes_while_exciters_play() -> None:
    """Displacements go on, of magnets too; it settles as if the finger had been there from rest."""
    rig, omega = exciter_rig("type: DAEX25FHE-4"), 2 * math.pi * 95.0
    finger = {"a": FingertipLoad(0.11, 0.09, Fingertip())}
    plant, before = plant_of(rig), plant_of(rig)
    before.set_contacts(finger)
    for each in (plant, before):
        for number in range(4):
            each.set_input(number, raised_cosine(0.0, 0.02, omega, 0j, 1.0 + 0.5j * number))
    plant.skip(0.0317)
    was = np.concatenate(plant.state)
    plant.set_contacts(finger)
    x, v = plant.state
    carried = np.concatenate([x[:-1], v[:-1]])  # without the phalanx, which is at rest
    assert len(x) == len(plant.reduced.omega) + 4 + 1
    magnets = x[-5:-1]
    assert magnets == pytest.approx(was[len(was) // 2 - 4 : len(was) // 2])
    assert np.abs(magnets).min() > 1e-6
    assert len(carried) == 2 * (len(x) - 1)
    assert [x[-1], v[-1]] == pytest.approx([0, 0], abs=1e-12)
    there, from_rest = settled(plant, 1.5, 95.0), settled(before, 1.5, 95.0)
    assert there == pytest.approx(from_rest, rel=1e-3)


def test_answers_are_felt_on_the_exact_board() -> None:
    """What a table of exciters says nominally of two fingers is played: to 0.3 dB."""
    rig = exciter_rig(frequency="[60, 300]")
    table = build_table(rig, frequencies=np.arange(70.0, 300.0, 20.0), drive_mode="phased")
    targets, quiet = ((0.06, 0.05),), ((0.22, 0.17),)
    answer = query(table, Placement(targets, quiet), 20.0)
    fingers = [Finger(targets[0], stimulus=Stimulus()), Finger(quiet[0])]
    found = play(rig, plant_of(rig).reduced, answer.layers, fingers, duration=None)
    assert found.fingers[0].level_db_sl == pytest.approx(answer.fingers[0].level_db_sl, abs=0.3)
    assert found.contrast_db == pytest.approx(answer.fingers[0].contrast_db, abs=0.5)


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


FINE_RATE = 100_000.0
FIRST, SECOND, MOVED = (0.11, 0.07), (0.25, 0.15), (0.19, 0.12)
COMING_AND_GOING: list[tuple[float, Mapping[str, FingertipLoad]]] = [
    (0.0312, resting(FIRST)),
    (0.05, resting(FIRST, SECOND)),
    (0.06, resting(MOVED, SECOND)),
    (0.085, resting(MOVED)),
    (0.1, {}),
]


def felt(samples: FloatArray) -> FloatArray:
    """What lies below 1 kHz, all that a finger can feel and more, without delay."""
    return np.asarray(sosfiltfilt(butter(6, 1000.0, fs=FINE_RATE, output="sos"), samples, axis=0))


def test_plant_with_changing_contacts_agrees_with_newmark() -> None:
    """Ramps, an envelope and two fingers: displacement, velocity and what can be felt within 1 %.

    Over the plate, and under the fingers, in every stretch between two changes; no two ERAs damp
    alike.
    """
    rig = make_paper_rig(8, 6)
    losses = zip(rig.eras, (0.5, 3.5, 10.0, 20.0), (0.0, 0.005, 0.01, 0.02), strict=True)
    eras = [replace(era, damping=c, bolt_mass=m) for era, c, m in losses]
    whole = whole_plate(rig.plate, rig.mesh, eras)
    plant = Plant(reduce_plate(rig.plate, rig.mesh, footprints_of(eras)), eras)
    for number, base in enumerate(MOVED_BASES):
        plant.set_input(number, base.terms)
    points = np.vstack([rig.mesh.nodes, [FIRST, SECOND, MOVED]])
    pieces, states = [], []
    for until, contacts in [*COMING_AND_GOING, (0.12, None)]:
        shapes = plant.reduced.at(points)
        pieces.append(plant.advance(until, sample_rate=FINE_RATE, shapes=shapes)[1])
        states.append([shapes @ part[: shapes.shape[1]] for part in plant.state])
        if contacts is not None:
            plant.set_contacts(contacts)
    motions = [base.motion for base in MOVED_BASES]
    stepped = whole.stepped(motions, COMING_AND_GOING, until=0.12, step=1e-5, every=1)
    touch = whole.matrices.deflection_at(points)
    u, v, a = ((touch @ part.T).T for part in stepped)
    found, expected = felt(np.vstack(pieces)), felt(a)
    for begin, end in [(0, 3100), (3200, 5000), (5000, 6000), (6000, 8500), (8500, 12000)]:
        assert apart(found[begin:end], expected[begin:end]) < 0.005
    for finger in (-3, -2, -1):
        assert apart(found[:, finger], expected[:, finger]) < 0.01
    for (until, _), state in zip([*COMING_AND_GOING, (0.12, None)], states, strict=True):
        row = round(until * FINE_RATE) - 1
        assert apart(state[0], u[row]) < 0.01
        assert apart(state[1], v[row]) < 0.01


def test_plant_viscous_equivalent_agrees_with_the_loss_factor() -> None:
    """Against the hysteretic direct solve: magnitudes over the plate, 0.1 % in the median.

    No causal law of damping can have the same loss at all frequencies; this is what is left.
    """
    fine = make_paper_rig(24, 18)
    eras = fine.eras
    frequencies = np.arange(40.0, 501.0, 46.0)
    direct = direct_acceleration(
        assemble(fine.plate, fine.mesh), eras, frequencies, fine.mesh.nodes
    )
    plant, off = Plant(reduce_plate(fine.plate, fine.mesh, footprints_of(eras)), eras), []
    for row, frequency in enumerate(frequencies):
        begin = plant.time
        plant.set_input(0, [Term(begin, np.inf, 2 * np.pi * frequency, BASE_STROKE)])
        plant.skip(begin + 20.0)
        times, samples = plant.advance(
            begin + 20.2, sample_rate=10_000.0, shapes=plant.reduced.at(fine.mesh.nodes)
        )
        found = lock_in(times, samples, float(frequency)) / BASE_STROKE
        off.append(apart(np.abs(found), np.abs(direct[row, 0]) / eras[0].stroke))
    assert np.median(off) < 0.001
    assert max(off) < 0.002
