"""Added mass of the air around a plate: published coefficients, closed forms, and panels."""

from dataclasses import replace

import numpy as np
import pytest

from cases import shortly
from kit.plates import make_paper_rig
from model.arrays import FloatArray
from model.rig.rig_mesh import mesh_of
from model.spectral.surrounding_air import added_mass, heave_mass
from model.structure.plate import AIR_DENSITY, SurroundingAir
from model.vibration import natural_modes

SIDES = (0.3, 0.225)  # m
DEGREES = (8, 8)
CLASSES = ((1, 1), (1, -1), (-1, 1), (-1, -1))


@pytest.mark.parametrize(
    ("ratio", "coefficient"), [(1.0, 0.579), (1.25, 0.642), (1.59, 0.704), (2.0, 0.757), (4, 0.872)]
)
def test_open_plate_carries_the_published_added_mass(ratio: float, coefficient: float) -> None:
    """Mass of water around rectangular plates, DNV-RP-C205, table of added mass coefficients.

    Relative to rho pi / 4 a² b, for the shorter side a.
    """
    width, length = 0.2, 0.2 * ratio

    mass = added_mass(SurroundingAir.BOTH, (length, width), DEGREES, (1, 1))[0, 0] * length * width

    expected = coefficient * AIR_DENSITY * np.pi / 4 * width**2 * length
    assert mass == pytest.approx(expected, rel=0.015)


def test_flush_square_carries_the_mass_of_rayleighs_integral() -> None:
    """The mean of 1 / r over a unit square is 4 ln(1 + sqrt 2) - 4 (sqrt 2 - 1) / 3."""
    side = 0.2

    mass = added_mass(SurroundingAir.FRONT, (side, side), DEGREES, (1, 1))[0, 0] * side**2

    mean = 4 * np.log(1 + np.sqrt(2)) - 4 * (np.sqrt(2) - 1) / 3
    assert mass == pytest.approx(AIR_DENSITY * side**3 * mean / (2 * np.pi), rel=1e-3)


def panels(counts: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Middles (n,) along x and y of equal panels of the plate."""
    along_x, along_y = (
        (np.arange(count) + 0.5) * side / count for count, side in zip(counts, SIDES, strict=True)
    )
    return along_x, along_y


def shape(parity: tuple[int, int], x: FloatArray, y: FloatArray) -> FloatArray:
    """The first bending of a symmetry class, in orthonormal polynomials."""
    degrees = [3 if of_side < 0 else 2 for of_side in parity]
    along = []
    for degree, points, side in zip(degrees, (x, y), SIDES, strict=True):
        coefficients = np.zeros(degree + 1)
        coefficients[degree] = np.sqrt((2 * degree + 1) / side)
        along.append(np.polynomial.legendre.legval(2 * points / side - 1, coefficients))
    return np.multiply.outer(*along).ravel()


def mass_of_bending(air: SurroundingAir, parity: tuple[int, int]) -> float:
    """Added mass [kg/m²] of this shape, the second along x and along y of its class."""
    along_y = len(range((1 - parity[1]) // 2, DEGREES[1] + 1, 2))
    return float(np.diagonal(added_mass(air, SIDES, DEGREES, parity))[along_y + 1])


def jump_by_vortex_rings(deflection: FloatArray, counts: tuple[int, int]) -> FloatArray:
    """Jump (n,) of the potential that moves panels (n,) by a deflection, by a ring on each panel.

    A ring of unit strength induces, at a distance (u, v) from a corner, sqrt(u² + v²) / (4 pi u v),
    with alternating signs of the corners (lifting-surface theory of a flat wing at rest).
    """
    x, y = panels(counts)
    half = [side / count / 2 for side, count in zip(SIDES, counts, strict=True)]
    induced = np.zeros(2 * (len(x) * len(y),))  # by each ring at each middle
    dx = np.subtract.outer(x, x)[:, None, :, None]
    dy = np.subtract.outer(y, y)[None, :, None, :]
    for sign_x in (1, -1):
        for sign_y in (1, -1):
            u, v = dx + sign_x * half[0], dy + sign_y * half[1]
            induced += (sign_x * sign_y * np.hypot(u, v) / (u * v)).reshape(induced.shape)
    return np.asarray(np.linalg.solve(induced / (4 * np.pi), deflection), dtype=float)


@pytest.mark.parametrize("parity", shortly(CLASSES, [CLASSES[0], CLASSES[-1]]))
def test_open_air_of_bending_equals_vortex_rings(parity: tuple[int, int]) -> None:
    """A second method for the same flow, extrapolated to small panels; to 1 %."""
    mass = mass_of_bending(SurroundingAir.BOTH, parity)

    by_panels = []
    sizes = []
    for counts in ((24, 18), (32, 24), (48, 36)):
        sizes.append(1 / counts[0])
        deflection = shape(parity, *panels(counts))
        jump = jump_by_vortex_rings(deflection, counts)
        by_panels.append(AIR_DENSITY * deflection @ jump * np.prod(SIDES) / np.prod(counts))

    *_, limit = np.polyfit(sizes, by_panels, 2)
    assert mass == pytest.approx(limit, rel=0.01)


@pytest.mark.parametrize("parity", CLASSES)
def test_air_in_front_of_bending_equals_a_sum_over_panels(parity: tuple[int, int]) -> None:
    """Rayleigh's integral over square panels; to 1 %.

    The integral of 1 / r over a square lattice exceeds the sum at the other points by -4 zeta(1/2)
    beta(1/2) = 3.90026 panel sides.
    """
    counts = (48, 36)
    x, y = panels(counts)
    area = np.prod(SIDES) / np.prod(counts)
    grid_x, grid_y = (part.ravel() for part in np.meshgrid(x, y, indexing="ij"))
    distance = np.hypot(np.subtract.outer(grid_x, grid_x), np.subtract.outer(grid_y, grid_y))
    np.fill_diagonal(distance, np.sqrt(area) / 3.90026)
    deflection = shape(parity, x, y)
    expected = AIR_DENSITY / (2 * np.pi) * area**2 * deflection @ (1 / distance) @ deflection

    assert mass_of_bending(SurroundingAir.FRONT, parity) == pytest.approx(expected, rel=0.01)


def test_short_waves_carry_rho_over_their_wavenumber_on_each_side() -> None:
    """Both kinds of air tend to the mass of an infinite plate, to 7 % at eight waves per side."""
    degree, side = 40, 0.3
    mass = added_mass(SurroundingAir.BOTH, (side, side), (degree, degree), (1, 1))
    in_front = added_mass(SurroundingAir.FRONT, (side, side), (degree, degree), (1, 1))
    points, weights = np.polynomial.legendre.leggauss(90)
    basis = np.polynomial.legendre.legvander(points, degree)[:, ::2]
    basis *= np.sqrt((2 * np.arange(0, degree + 1, 2) + 1) / side)
    wave = basis.T @ (weights * side / 2 * np.cos(8 * np.pi * points))
    wave = np.kron(wave, wave) / (wave @ wave)
    wavenumber = np.sqrt(2) * 8 * np.pi / (side / 2)

    for both_sides in (wave @ mass @ wave, 2 * wave @ in_front @ wave):
        assert both_sides == pytest.approx(2 * AIR_DENSITY / wavenumber, rel=0.07)


def test_air_lowers_natural_frequencies_by_its_share_of_the_mass() -> None:
    """A rigid plate heaves on soft springs with the mass of its air; all modes become lower."""
    rig = make_paper_rig(12, 9)
    rig = replace(rig, mesh=mesh_of("auto", rig.plate, frequency_max=500.0))
    soft = replace(rig, eras=tuple(replace(era, stiffness=10.0) for era in rig.eras))
    in_air = replace(soft, plate=replace(soft.plate, air=SurroundingAir.BOTH))

    frequencies = natural_modes(soft, 9, support="eras").frequencies
    lower = natural_modes(in_air, 9, support="eras").frequencies

    heave = np.sqrt(1 + heave_mass(in_air.plate) / rig.plate.mass)
    ratios = frequencies / lower
    # Heave moves most air, and is the lowest of four rigid motions on the springs.
    assert ratios[:3].max() == pytest.approx(heave, rel=1e-3)
    assert ((ratios > 1.003) & (ratios <= heave * 1.001)).all()
