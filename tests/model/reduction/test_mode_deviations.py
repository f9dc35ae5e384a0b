"""Modes that differ from a plate's theory, and a loss factor that varies, in every solution."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.config.document import ConfigError
from model.reduction.free_plate import SpectralModes, solve_free_plate
from model.reduction.reduced_plate import modal_matrices, reduce_free_plate, reduce_plate
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig, parse_rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh, local_compliance
from model.structure.attachments import footprints_of
from model.structure.plate import LOSS_FREQUENCY
from model.study.verification import verify_table
from model.table.table_file import build_table
from plates import LENGTH, WIDTH, make_paper_rig

FREQUENCIES = np.array([65.0, 150.0, 240.0, 430.0])
DEVIATIONS = ((0.02, 0.3), (0.0, 0.0), (-0.03, -0.4))
POINTS = np.array([[0.05, 0.04], [0.2, 0.11]])


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate with three modes off its theory, and a loss that rises with frequency."""
    rig = load_rig(example_rig_path())
    plate = replace(rig.plate, loss_exponent=0.4, mode_deviations=DEVIATIONS)
    return replace(rig, plate=plate)


def test_only_the_modes_named_change_the_receptance(rig: Rig) -> None:
    """The receptance changes by that of three oscillators with stiffness and loss of their own."""
    plain = replace(rig, plate=replace(rig.plate, mode_deviations=()))
    solved = [solve_free_plate(each.plate, each.mesh, frequency_max=500.0) for each in (rig, plain)]
    found, before = (free.receptances(POINTS, POINTS, FREQUENCIES)[0] for free in solved)
    modes = solved[0].modes
    elastic = np.sort(modes.eigenvalues)[3:6]
    omega = 2 * np.pi * FREQUENCIES
    eta = rig.plate.loss_factor * (FREQUENCIES / LOSS_FREQUENCY) ** 0.4
    expected = before.copy()
    for eigenvalue, (shift, loss) in zip(elastic, DEVIATIONS, strict=True):
        phi = modes.shapes_at(POINTS)[:, np.flatnonzero(modes.eigenvalues == eigenvalue)[0]]
        for factor, more, sign in ((np.exp(shift), np.exp(loss), 1), (1.0, 1.0, -1)):
            oscillator = 1 / ((1 + 1j * eta * more) * eigenvalue * factor - omega**2)
            expected += sign * oscillator[:, None, None] * np.outer(phi, phi)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_loss_varies_alike_in_modes_and_in_a_direct_solution(rig: Rig) -> None:
    """Modal and direct accelerations agree where the loss factor rises with frequency."""
    plate = replace(rig.plate, mode_deviations=())
    assert isinstance(rig.mesh, SpectralMesh)
    direct = direct_spectral_acceleration(plate, rig.mesh, rig.eras, FREQUENCIES, POINTS)
    free = solve_free_plate(plate, rig.mesh, frequency_max=500.0)
    found = free.acceleration(rig.eras, FREQUENCIES, POINTS)
    np.testing.assert_allclose(found, direct, atol=1e-4 * np.abs(direct).max())


def test_a_table_is_verified_with_them(rig: Rig) -> None:
    """Its fields and one answer are those of the plate anew, not of the plate in theory."""
    table = build_table(rig)
    assert verify_table(table, rig, samples=1).failed_count == 0
    other = replace(rig, plate=replace(rig.plate, mode_deviations=()))
    checks = verify_table(table, other, samples=1).content
    assert not any(check.is_passed for check in checks)


def test_plate_in_time_has_them(rig: Rig) -> None:
    """Steady vibration of the viscous plate in time is that of the hysteretic one within 1 %."""
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))
    M, C, K = modal_matrices(reduced, rig.eras)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    expected = free.acceleration(rig.eras, FREQUENCIES, POINTS)[:, 0]
    era = rig.eras[0]
    forces = reduced.at(footprints_of(rig.eras[:1]))[0]
    for row, omega in enumerate(2 * np.pi * FREQUENCIES):
        base = (era.stiffness + 1j * omega * era.damping) * era.stroke
        moved = np.linalg.solve(K + 1j * omega * C - omega**2 * M, forces * base)
        found = -(omega**2) * (reduced.at(POINTS) @ moved)
        error = np.linalg.norm(found - expected[row]) / np.linalg.norm(expected[row])
        assert error < 0.01


@pytest.mark.parametrize("wrong", ["loss_exponent: 3", "modes: [[1.5, 1]]", "modes: [[1, 0]]"])
def test_rig_file_refuses_what_is_no_deviation(wrong: str) -> None:
    """Exponents and deviations beyond what a plate may have are refused where they are read."""
    text = example_rig_path().read_text()
    with pytest.raises(ConfigError):
        parse_rig("rig.yaml", text.replace("loss_factor:", f"{wrong}\n  loss_factor:"))


PLATE = replace(make_paper_rig(12, 9).plate, loss_factor=0.0)
PLACES = np.array([(0.13, 0.11, 0), (0.17, 0, 0), (LENGTH, WIDTH, 0), (0.05, 0.06, 0.01)])

# ln 10 / (2 pi kappa G h) with kappa 5/6 and G = 70 GPa / 2.66, at a point inside; on an edge and
# at a corner its images double it once and twice; a disc ends the logarithm.
DECADE = math.log(10) / (2 * math.pi * 5 / 6 * 70e9 / 2.66 * 0.0015)
DECADES = DECADE * np.array([1, 2, 4, 0])


def plates():
    """The paper's plate without damping in polynomials, and the softer one."""
    free = solve_free_plate(PLATE, SpectralMesh(12, 9, LENGTH, WIDTH), frequency_max=500.0)
    assert isinstance(free.modes, SpectralModes)
    return free, replace(free, modes=free.modes.softer())


def test_softer_plate_gives_way_by_a_fifth_and_a_decade_more():
    """Under slow forces: a fifth of the unresolved compliance, and a decade under points."""
    free, softer = plates()
    (stiff, to_points), (soft, to_softer_points) = (
        plate.receptances(PLACES, PLACES, np.array([5.0])) for plate in (free, softer)
    )
    assert pytest.approx(1.1e-8, rel=0.05) == DECADE
    expected = 0.2 * local_compliance(PLATE, (12, 9), PLACES, PLACES) + np.diag(DECADES)
    np.testing.assert_allclose((soft - stiff)[0].real, expected, rtol=1e-3, atol=1e-13)
    np.testing.assert_allclose(
        (to_softer_points - to_points)[0].real, expected, rtol=1e-3, atol=1e-13
    )


def test_softer_plate_can_be_reduced():
    """Its reduction has the same receptance, as that of the plate itself."""
    _, softer = plates()
    exact, _ = softer.receptances(PLACES, PLACES, np.array([5.0]))
    reduced = reduce_free_plate(softer, PLACES)
    shapes = reduced.at(PLACES)
    found = shapes / (reduced.omega**2 - (10 * math.pi) ** 2) @ shapes.T
    np.testing.assert_allclose(found, exact[0].real, rtol=1e-5)
