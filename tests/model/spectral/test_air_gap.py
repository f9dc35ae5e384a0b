"""Air behind a plate against finite differences of its pressure and published squeeze films."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_responder
from benchmarks.layers.gap import air_pressure, cell_middles
from long_form import in_turn
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import parse_rig
from model.spectral.modes import SpectralMesh, SpectralPlate
from model.spectral.polynomials import air_motion
from model.structure.attachments import Era
from model.structure.plate import HEAT_RATIO, PRESSURE, VISCOSITY, AirGap, Material, Plate
from model.vibration import natural_modes

GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
PLATE = Plate(0.375, 0.225, 2.5e-3, GLASS)
CLASSES = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def force_of(gap, frequency, parity, degrees=(12, 10)):
    """Matrix of the air's dynamic stiffness [N/m per m²] in the polynomials of a class."""
    plate = replace(PLATE, air_gap=gap)
    of = SpectralPlate(plate, degrees, 150.0).functions(parity)
    air, m = air_motion(of, gap), of.deflections
    full = gap.bulk_modulus(frequency) * air.stiffness.astype(complex)
    full -= (2 * np.pi * frequency) ** 2 * gap.inertia(frequency) * np.diag(air.inertia)
    return of, full[:m, :m] - full[:m, m:] @ np.linalg.solve(full[m:, m:], full[m:, :m])


def polynomial(degree, x, side):
    """Legendre polynomial of norm 1 over a side."""
    coefficients = np.zeros(degree + 1)
    coefficients[degree] = np.sqrt((2 * degree + 1) / side)
    return np.polynomial.legendre.legval(2 * x / side - 1, coefficients)


@pytest.mark.parametrize(("parity", "closed"), in_turn(CLASSES, [False, True]))
@pytest.mark.parametrize(("depth", "frequency"), [(0.5e-3, 60.0), (5e-3, 300.0)])
def test_air_equals_finite_differences(closed, parity, depth, frequency):
    """Its force on the first two deflections of each symmetry, to 1.5 %, far from any resonance."""
    gap = AirGap(depth, closed=closed)
    of, found = force_of(gap, frequency, parity)
    x, y = cell_middles(PLATE.length, PLATE.width, (100, 60))
    area = PLATE.length * PLATE.width / x.size
    first = [(1 - each) // 2 for each in parity]
    shapes = [
        polynomial(first[0] + 2 * i, x, PLATE.length) * polynomial(first[1], y, PLATE.width)
        for i in range(2)
    ]
    numbers = [i * of.of_w[1] for i in range(2)]
    for shape, number in zip(shapes, numbers, strict=True):
        pressure = air_pressure(gap, shape, frequency, length=PLATE.length, width=PLATE.width)
        # p pushes towards larger w; the dynamic stiffness resists it.
        expected = [-(other * pressure).sum() * area for other in shapes]
        scale = abs(found[number, number])
        np.testing.assert_allclose(found[numbers, number], expected, atol=0.015 * scale)


def test_a_slow_square_squeezes_as_reynolds_equation_says():
    """Damping of a rigid square in an open film, 0.4217 mu L⁴ / d³ (Bao and Yang 2007, Eq. 21)."""
    side, depth, frequency = 0.02, 0.1e-3, 1.0
    plate = Plate(side, side, 1e-3, GLASS, air_gap=AirGap(depth))
    of = SpectralPlate(plate, (24, 24), 150.0).functions((1, 1))
    air, m, gap = air_motion(of, plate.air_gap), of.deflections, plate.air_gap
    omega = 2 * np.pi * frequency
    full = 1e12 * air.stiffness.astype(complex)  # incompressible
    full -= omega**2 * gap.inertia(frequency) * np.diag(air.inertia)
    force = full[0, 0] - full[0, m:] @ np.linalg.solve(full[m:, m:], full[m:, 0])
    damping = force.imag / omega * side**2  # the first polynomial is 1 / side everywhere
    assert damping == pytest.approx(0.4217 * VISCOSITY * side**4 / depth**3, rel=0.01)


def test_a_sealed_gap_is_a_spring_of_gas():
    """gamma p0 / d of fast and p0 / d of slow even motion; an open gap has no stiffness."""
    for depth, frequency, modulus in ((20e-3, 400.0, HEAT_RATIO * PRESSURE), (5e-5, 1.0, PRESSURE)):
        of, force = force_of(AirGap(depth, closed=True), frequency, (1, 1))
        assert of.of_w[0] > 1
        assert force[0, 0].real == pytest.approx(modulus / depth, rel=0.02)


def test_a_free_plate_over_a_sealed_gap_moves_up_and_down_on_its_air():
    """Its lowest elastic mode, of a stiff plate, is at sqrt(gamma p0 / (d m'')) / 2 pi: 39.1 Hz."""
    text = (
        "plate: {length: 0.3, width: 0.2, thickness: 3 mm, material: steel,"
        " air_gap: {depth: 100 mm, closed: true}}\n"
        "eras: {A: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}}\n"
        'amplifiers: {main: {url: "sim://"}}\n'
    )
    expected = np.sqrt(HEAT_RATIO * PRESSURE / (0.1 * 7850 * 3e-3)) / (2 * np.pi)
    modes = natural_modes(parse_rig("rig.yaml", text), 2, support="free")
    assert modes.frequencies[0] == pytest.approx(expected, rel=0.01)
    assert modes.frequencies[1] > 4 * expected


@pytest.mark.parametrize("closed", [False, True])
def test_modes_over_air_answer_as_the_direct_solution(closed):
    """Response over 5 mm of air within 1 % of the one at each frequency, relative L2."""
    plate = replace(PLATE, air_gap=AirGap(5e-3, closed=closed), loss_factor=0.02)
    mesh = SpectralMesh(10, 8, PLATE.length, PLATE.width)
    eras = [
        Era(name, x, y, stiffness=17e3, damping=1.0, bolt_mass=0.0, stroke=1e-4)
        for name, x, y in (("a", 0, 0), ("b", 0.375, 0), ("c", 0, 0.225), ("d", 0.375, 0.225))
    ]
    frequencies = np.array([150.0, 250.0, 400.0])
    points = np.array([[0.05, 0.04], [0.2, 0.1], [0.3, 0.2], [0.375, 0.1]])
    free = solve_free_plate(plate, mesh, frequency_max=500.0)
    found = free.acceleration(eras, frequencies, points)
    exact = direct_responder(plate, mesh)(eras, frequencies, points)
    error = np.linalg.norm(found - exact, axis=2) / np.linalg.norm(exact, axis=2)
    assert error.max() < 0.01
