"""The plate in time, against the frequency domain, a stepping solver and conservation laws."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import lsim

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh
from model.reduction.modal_matrices import modal_matrices
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.structure.actuator import Era
from model.structure.material import Material
from model.structure.plate import Plate
from model.transients.base_motion import Term
from model.transients.time_response import plate_in_time
from plate_in_time import apart, lock_in, stepped_acceleration
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


def hysteretic_response(
    reduced: ReducedPlate, eras: list[Era], driven: int, frequency: float
) -> ComplexArray:
    """Modal amplitudes for a base that moves as sin(w t), solved directly and hysteretically."""
    w = 2 * np.pi * frequency
    phi = reduced.at(np.array([[era.x, era.y] for era in eras]))
    dynamic = np.diag((1 + 1j * PLATE.loss_factor) * reduced.omega**2 - w**2 + 0j)
    for row, era in zip(phi, eras, strict=True):
        dynamic += (era.stiffness + 1j * w * era.damping - w**2 * era.bolt_mass) * np.outer(
            row, row
        )
    force = phi[driven] * (eras[driven].stiffness + 1j * w * eras[driven].damping)
    return np.linalg.solve(dynamic, force)


def steady_difference(reduced: ReducedPlate, driven: int, frequency: float) -> float:
    """Relative L2 difference over the plate of time-domain and hysteretic steady accelerations."""
    plant = Plant(reduced, eras())
    w = 2 * np.pi * frequency
    plant.set_input(driven, [Term(0.0, np.inf, w, STROKE)])
    plant.skip(30.0)
    times, felt = plant.advance(30.2, sample_rate=10_000.0, shapes=reduced.at(MESH.nodes))
    q = hysteretic_response(reduced, eras(), driven, frequency) * STROKE
    expected = -(w**2) * (reduced.at(MESH.nodes) @ q)
    return apart(lock_in(times, felt, frequency), expected)


FREQUENCIES = [40.0, 60.0, 85.0, 110.0, 150.0, 207.0, 250.0, 320.0, 410.0, 500.0]


@pytest.mark.parametrize("driven", range(4))
def test_plant_steady_state_agrees_with_the_hysteretic_response(
    reduced: ReducedPlate, driven: int
) -> None:
    """The viscous equivalent costs under 0.6 % of acceleration over the plate, 40 to 500 Hz."""
    differences = [steady_difference(reduced, driven, f) for f in FREQUENCIES]
    assert max(differences) < 0.006, dict(zip(FREQUENCIES, differences, strict=True))


def test_plant_steady_state_is_exact_without_structural_damping() -> None:
    """With the ERAs' dampers alone both domains solve one equation, so they agree to rounding."""
    plate = Plate(PLATE.length, PLATE.width, PLATE.thickness, PLATE.material, loss_factor=0.0)
    lossless = reduce_plate(plate, Mesh(8, 6, plate.length, plate.width), np.array(CORNERS))
    phi = lossless.at(np.array(CORNERS))
    w = 2 * np.pi * 230.0
    dynamic = np.diag(lossless.omega**2 - w**2 + 0j)
    dynamic += (phi.T * (17000.0 + 50j * w - 0.02 * w**2)) @ phi
    expected = (
        -(w**2)
        * STROKE
        * lossless.at(MESH.nodes)
        @ np.linalg.solve(dynamic, phi[2] * (17000.0 + 50j * w))
    )
    plant = Plant(lossless, eras(damping=50.0))
    plant.set_input(2, [Term(0.0, np.inf, w, STROKE)])
    plant.skip(100.0)
    times, felt = plant.advance(100.1, sample_rate=10_000.0, shapes=lossless.at(MESH.nodes))
    np.testing.assert_allclose(lock_in(times, felt, 230.0), expected, rtol=1e-6, atol=1e-6)


def test_plant_transient_agrees_with_runge_kutta() -> None:
    """Two ERAs, a rising envelope and a later tone, on a small reduced plate."""
    small = reduce_plate(
        PLATE, Mesh(8, 6, PLATE.length, PLATE.width), np.array(CORNERS), frequency_max=100.0
    )
    rise, later = 0.01, 0.004
    w1, w2 = 2 * np.pi * 110.0, 2 * np.pi * 180.0

    def rising(t: float) -> tuple[float, float]:
        a, da = (t / rise, 1 / rise) if t < rise else (1.0, 0.0)
        return (
            STROKE * a * np.sin(w1 * t),
            STROKE * (da * np.sin(w1 * t) + a * w1 * np.cos(w1 * t)),
        )

    def late(t: float) -> tuple[float, float]:
        angle = w2 * (t - later)
        return (STROKE * np.sin(angle), STROKE * w2 * np.cos(angle)) if t >= later else (0.0, 0.0)

    def still(t: float) -> tuple[float, float]:
        return 0.0, 0.0

    plant = Plant(small, eras())
    after_rise = Term(rise, np.inf, w1, STROKE * np.exp(1j * w1 * rise))
    plant.set_input(0, [Term(0.0, rise, w1, 0j, STROKE / rise), after_rise])
    plant.set_input(2, [Term(later, np.inf, w2, STROKE)])
    times, felt = plant.advance(0.05, sample_rate=2000.0, shapes=small.at(MESH.nodes))
    stepped = stepped_acceleration(
        plate_in_time(small, eras()),
        [rising, still, late, still],
        times[:-1],
        breaks=np.array([0.0, later, rise, 0.05]),
    )
    expected = stepped @ small.at(MESH.nodes).T
    np.testing.assert_allclose(felt[:-1], expected, atol=2e-6 * np.abs(expected).max())


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


def test_plant_scheduled_inputs_agree_with_a_linear_system() -> None:
    """Set ahead and advanced at once, or set in time and advanced sample by sample: as lsim has it.

    It is exact for bases that move along straight lines and act by springs alone.
    """
    small = reduce_plate(
        PLATE, Mesh(8, 6, PLATE.length, PLATE.width), np.array(CORNERS), frequency_max=100.0
    )
    on_springs = eras(damping=0.0)
    rate, turns, end = 2000.0, 0.0105, 0.04
    first = knotted([(0.0, 0.0), (0.02, STROKE)])
    then = knotted([(turns, turns / 0.02 * STROKE), (0.015, -STROKE), (0.025, 0.0)])
    other = knotted([(0.005, 0.0), (0.0105, STROKE), (0.03, 0.0)])
    points = small.at(MESH.nodes[::7])

    ahead = Plant(small, on_springs)
    ahead.set_input(0, first)
    ahead.set_input(0, then, since=turns)
    ahead.set_input(2, other, since=0.001)
    times, at_once = ahead.advance(end, sample_rate=rate, shapes=points)

    in_time, pieces = Plant(small, on_springs), []
    in_time.set_input(0, first)
    for moment in times:
        pieces.append(in_time.advance(moment, sample_rate=rate, shapes=points)[1])
        if moment == 0.001:
            in_time.set_input(2, other)
        if moment == turns:
            in_time.set_input(0, then)

    grid = np.concatenate([[0.0], times])
    bases = STROKE * np.column_stack(
        [
            np.interp(grid, [0.0, turns, 0.015, 0.025], [0.0, turns / 0.02, -1.0, 0.0]),
            np.interp(grid, [0.005, 0.0105, 0.03], [0.0, 1.0, 0.0]),
        ]
    )
    expected = linear_acceleration(small, bases, grid, points)
    peak = np.abs(expected).max()
    np.testing.assert_allclose(at_once, expected[1:], atol=1e-9 * peak)
    np.testing.assert_allclose(np.concatenate(pieces), expected[1:], atol=1e-9 * peak)


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


def test_plant_superposes_terms(reduced: ReducedPlate) -> None:
    """As when a tone fades into one of its own frequency: two terms are one of their sum."""
    w, a, b = 2 * np.pi * 110.0, (1 + 2j) * STROKE / 4, (-0.5 + 1j) * STROKE / 4
    felt = []
    for terms in (
        [Term(0.0, 0.05, w, a, 3 * b), Term(0.0, 0.05, w, b, a)],
        [Term(0.0, 0.05, w, a + b, 3 * b + a)],
    ):
        plant = Plant(reduced, eras())
        plant.set_input(1, terms)
        felt.append(plant.advance(0.08, sample_rate=10_000.0, shapes=reduced.at(MESH.nodes[:9]))[1])
    np.testing.assert_allclose(felt[0], felt[1], atol=1e-9 * np.abs(felt[1]).max())


def test_plant_refuses_an_unsupported_plate(reduced: ReducedPlate) -> None:
    """Two ERAs leave the axis through them free to rotate."""
    with pytest.raises(InputError, match="supported"):
        Plant(reduced, eras()[:2])
