"""The plate in time, against a linear system on straight lines, and its continuity."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import lsim

from model.arrays import FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh
from model.reduction.reduced_plate import ReducedPlate, modal_matrices, reduce_plate
from model.structure.attachments import Era
from model.structure.plate import Material, Plate
from model.transients.base_motion import Term
from sim.plant.plant import Plant

PLATE = Plate(0.3048, 0.2286, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33), loss_factor=0.01)
CORNERS = [(0.0, 0.0), (0.3048, 0.0), (0.3048, 0.2286), (0.0, 0.2286)]
STROKE = 1e-4


def eras(damping: float = 3.46, bolt_mass: float = 0.02) -> list[Era]:
    """Four alike, one in each corner."""
    return [
        Era(name, x, y, 17000.0, damping, bolt_mass, STROKE)
        for name, (x, y) in zip("abcd", CORNERS, strict=True)
    ]


MESH = Mesh(16, 12, PLATE.length, PLATE.width)


@pytest.fixture(scope="module")
def reduced() -> ReducedPlate:
    """The paper's plate on a coarse mesh."""
    return reduce_plate(PLATE, MESH, np.array(CORNERS))


def knotted(knots: list[tuple[float, float]]) -> list[Term]:
    """Terms of a base that moves along straight lines through (time [s], displacement [m])."""
    return [
        Term(start, end, 0.0, 1j * y0, 1j * (y1 - y0) / (end - start))
        for (start, y0), (end, y1) in pairwise(knots)
    ]


def linear_acceleration(
    small: ReducedPlate, bases: FloatArray, times: FloatArray, points: FloatArray
) -> FloatArray:
    """Accelerations (n, p) by lsim for bases (n, 2) of two ERAs on springs, on straight lines."""
    M, C, K = modal_matrices(small, eras(damping=0.0))
    inverse, r = np.linalg.inv(M), len(M)
    by_base = inverse @ (small.at(np.array(CORNERS)) * 17000.0).T[:, [0, 2]]
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
    B = np.vstack([np.zeros((r, 2)), by_base])
    _, expected, _ = lsim((A, B, points @ A[r:], points @ by_base), bases, times)
    return np.asarray(expected)


@pytest.mark.parametrize(("precision", "share"), [(np.float64, 1e-9), (np.float32, 1e-6)])
def test_plant_with_many_changes_agrees_with_a_linear_system(
    precision: type[np.floating], share: float
) -> None:
    """Thirty knots, half of them set ahead one by one, then free vibration that dies away.

    share: of the peak; in single precision a millionth of it, also of what is left at the end.
    """
    small = reduce_plate(
        PLATE, Mesh(8, 6, PLATE.length, PLATE.width), np.array(CORNERS), frequency_max=100.0
    )
    rate, end = 2000.0, 0.6
    heights = np.random.default_rng(5).uniform(-STROKE, STROKE, (2, 14))
    knots = [
        [(0.0, 0.0), *zip(np.linspace(*span, 14).tolist(), row.tolist(), strict=True)]
        for span, row in zip([(0.005, 0.07), (0.0025, 0.0675)], heights, strict=True)
    ]
    for era in (0, 1):
        knots[era].append((0.08, 0.0))
    points = small.at(MESH.nodes[::7])
    plant = Plant(small, eras(damping=0.0))
    for since, until in pairwise(knots[0]):
        (line,) = knotted([since, until])  # goes on until the next one is set
        lasting = line if until[0] == 0.08 else line._replace(end=1.0)
        plant.set_input(0, [lasting], since=since[0])
    plant.set_input(2, knotted(knots[1]))
    times, felt = plant.advance(end, sample_rate=rate, shapes=points, precision=precision)
    assert felt.dtype == precision
    grid = np.concatenate([[0.0], times])
    bases = np.column_stack([np.interp(grid, *np.transpose(each)) for each in knots])
    expected = linear_acceleration(small, bases, grid, points)
    for part in (times > 0, times > 0.4):
        peak = np.abs(expected[1:][part]).max()
        np.testing.assert_allclose(felt[part], expected[1:][part], rtol=0, atol=share * peak)


def test_plant_structural_damping_is_passive(reduced: ReducedPlate) -> None:
    """The viscous equivalent is symmetric and positive semidefinite."""
    _, C, _ = modal_matrices(reduced, eras(damping=0.0))
    np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())
    assert np.linalg.eigvalsh((C + C.T) / 2)[0] > -1e-9 * np.abs(C).max()


@pytest.mark.parametrize("damping", [3.46, 3000.0])
def test_plant_is_continuous_when_drives_change(reduced: ReducedPlate, damping: float) -> None:
    """Starting, replacing and ending a drive abruptly changes neither at that moment.

    With the larger damping some eigenvalues are real.
    """
    plant = Plant(reduced, eras(damping))
    assert (plant.loaded.plate.eigenvalues.imag == 0).any() == (damping > 1000)
    plant.set_input(0, [Term(0.0, 0.1, 700.0, STROKE * np.exp(0.7j), 3j * STROKE)])
    plant.skip(0.0345)
    before = plant.state
    plant.set_input(0, [Term(0.0345, np.inf, 1500.0, STROKE * 1j)])
    plant.set_input(3, [Term(0.0, np.inf, 900.0, -STROKE)])
    for old, new in zip(before, plant.state, strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-9 * np.abs(old).max())
    plant.skip(0.05)
    before = plant.state
    plant.set_input(0, [])
    for old, new in zip(before, plant.state, strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-6, atol=1e-9 * np.abs(old).max())


def test_plant_refuses_an_unsupported_plate(reduced: ReducedPlate) -> None:
    """Two ERAs leave the axis through them free to rotate."""
    with pytest.raises(InputError, match="supported"):
        Plant(reduced, eras()[:2])
