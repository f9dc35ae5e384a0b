"""Plates in Legendre polynomials and in finite elements: modes, meshes and harmonic responses.

The references are independent solvers, elasticity, finite differences of the air pressure, and
published squeeze films. The plates include stiff mounts and laminates.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, sparse, special
from scipy.integrate import trapezoid
from scipy.sparse.linalg import spsolve

from cases import in_turn
from kit.plates import make_paper_rig
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem import Q5, Mesh, assemble
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.reduction.supported_plate import supported_modes
from model.rig.rig_file import load_rig, parse_rig
from model.rig.rig_mesh import mesh_of, parse_mesh
from model.spectral.direct_solution import dynamic_stiffness
from model.spectral.modes import MaterialBand, SpectralPlate
from model.spectral.plate_mesh import SpectralMesh
from model.spectral.polynomials import air_motion
from model.structure.attachments import footprints_of
from model.structure.laminate_bending import equivalent_plate
from model.structure.material import Material
from model.structure.plate import (
    HEAT_RATIO,
    PRESSURE,
    VISCOSITY,
    AirGap,
    Laminate,
    LaminateLayer,
    Plate,
)
from model.structure.sources import Era
from model.vibration import natural_modes
from tests.model.layered_strips import strip_frequencies

RIG = make_paper_rig(12, 9)
PAPER = RIG.plate
SIDES = (PAPER.length, PAPER.width)


def test_discs_dent_the_plate_like_an_infinite_plate():
    """Receptances of discs of 2, 5 and 10 mm in the middle of the plate, within 2 %.

    In a sum of weights w with sum w = 0 and sum w a² = 0 all waves longer than the discs drop out.
    Uniform pressure on a disc and the mean deflection there, by Hankel's transform of the static
    Mindlin plate: the integral of (2 J1(ka) / ka)² (1 / D k⁴ + 1 / S k²) k / 2 pi.
    """
    middle = [PAPER.length / 2, PAPER.width / 2]
    radii = np.array([2e-3, 5e-3, 10e-3])
    discs = np.array([[*middle, radius] for radius in radii])
    free = solve_free_plate(PAPER, SpectralMesh(36, 28, *SIDES), frequency_max=200.0)

    receptances, _ = free.receptances(discs, np.array([middle]), np.array([60.0]))

    weights = np.ones(3)
    weights[1:] = np.linalg.solve([[1, 1], radii[1:] ** 2], [-1, -(radii[0] ** 2)])
    k = np.exp(np.linspace(math.log(1e-1), math.log(1e6), 100_000))
    ka = np.outer(radii, k)
    shapes = weights @ (2 * special.j1(ka) / ka) ** 2
    material = PAPER.material
    shear_modulus = material.E / (2 * (1 + material.nu))
    shear = 5 / 6 * shear_modulus * PAPER.thickness
    bending_compliance = 1 / (PAPER.flexural_rigidity * k**4)
    compliance = bending_compliance + 1 / (shear * k**2)
    integrand = shapes * compliance * k / (2 * math.pi)
    expected = trapezoid(integrand * k, np.log(k))  # k d ln k = dk
    dents = np.diagonal(receptances[0]).real
    assert weights @ dents == pytest.approx(expected, rel=0.02)


# Air gaps

PANE = Plate(0.375, 0.225, 2.5e-3, Material("glass", E=70e9, rho=2500.0, nu=0.2))
CLASSES = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def air_force(plate, parity, degrees, frequency, bulk_modulus):
    """Matrix of the air's dynamic stiffness [N/m per m²] in the polynomials of a class."""
    functions = SpectralPlate(plate, degrees, 150.0).functions(parity)
    air, m = air_motion(functions, plate.air_gap), functions.deflections
    omega = 2 * np.pi * frequency
    full = bulk_modulus * air.stiffness.astype(complex)
    full -= omega**2 * plate.air_gap.inertia(frequency) * np.diag(air.inertia)
    motion = np.linalg.solve(full[m:, m:], full[m:, :m])
    condensed = full[:m, :m] - full[:m, m:] @ motion
    return functions, condensed


def pane_force(gap, frequency, parity):
    """The force of air behind the pane of glass."""
    plate = replace(PANE, air_gap=gap)
    return air_force(plate, parity, (12, 10), frequency, gap.bulk_modulus(frequency))


def polynomial(degree, x, side):
    """Legendre polynomial of norm 1 over a side."""
    coefficients = np.zeros(degree + 1)
    coefficients[degree] = np.sqrt((2 * degree + 1) / side)
    return np.polynomial.legendre.legval(2 * x / side - 1, coefficients)


def second_difference(count: int, step: float, closed: bool) -> sparse.csr_array:
    """Second difference [1/m²] between the middles of cells."""
    diagonal = np.full(count, -2.0)
    diagonal[[0, -1]] = -1.0 if closed else -3.0  # the edge is half a cell away
    off_diagonal = np.ones(count - 1)
    differences = sparse.diags_array([off_diagonal, diagonal, off_diagonal], offsets=[-1, 0, 1])
    return sparse.csr_array(differences) / step**2


def air_pressure(gap: AirGap, deflection: FloatArray, frequency: float) -> ComplexArray:
    """Pressure (nx, ny) [Pa] against a deflection (nx, ny) [m] of the pane away from the gap.

    Finite differences of lap p + omega² rho b / B p = -omega² rho b w / d, on cells with the
    pressure in their middles: p = 0 at open edges, no slope across sealed ones.
    """
    nx, ny = deflection.shape
    inertia = (2 * np.pi * frequency) ** 2 * gap.inertia(frequency)
    x_difference = second_difference(nx, PANE.length / nx, gap.closed)
    y_difference = second_difference(ny, PANE.width / ny, gap.closed)
    along_x = sparse.kron(x_difference, sparse.eye_array(ny))
    along_y = sparse.kron(sparse.eye_array(nx), y_difference)
    compression = inertia / gap.bulk_modulus(frequency) * sparse.eye_array(nx * ny)
    system = sparse.csc_array(along_x + along_y + compression)
    source = -inertia / gap.depth * deflection.ravel()
    return spsolve(system, source.astype(complex)).reshape(nx, ny)


@pytest.mark.parametrize(("parity", "closed"), in_turn(CLASSES, [False, True]))
@pytest.mark.parametrize(("depth", "frequency"), [(0.5e-3, 60.0), (5e-3, 300.0)])
def test_air_equals_finite_differences(closed, parity, depth, frequency):
    """Its force on the first two deflections of each symmetry, to 1.5 %, far from any resonance."""
    gap = AirGap(depth, closed=closed)
    x = (np.arange(100) + 0.5) / 100 * PANE.length
    y = (np.arange(60) + 0.5) / 60 * PANE.width
    cell_area = PANE.length * PANE.width / 6000
    x_parity, y_parity = parity
    first_degree = (1 - x_parity) // 2
    y_degree = (1 - y_parity) // 2
    along_y = polynomial(y_degree, y, PANE.width)
    shapes = [
        np.outer(polynomial(x_degree, x, PANE.length), along_y)
        for x_degree in (first_degree, first_degree + 2)
    ]

    functions, force = pane_force(gap, frequency, parity)

    rows = [0, functions.of_w[1]]
    for row, shape in zip(rows, shapes, strict=True):
        pressure = air_pressure(gap, shape, frequency)
        # p pushes towards larger w; the dynamic stiffness resists it.
        expected = [-(weights * pressure).sum() * cell_area for weights in shapes]
        tolerance = 0.015 * abs(force[row, row])
        np.testing.assert_allclose(force[rows, row], expected, atol=tolerance)


def test_slow_square_squeezes_according_to_reynolds_equation():
    """Damping of a rigid square in an open film, 0.4217 mu L⁴ / d³ (Bao and Yang 2007, Eq. 21)."""
    side, depth, frequency = 0.02, 0.1e-3, 1.0
    plate = Plate(side, side, 1e-3, PANE.material, air_gap=AirGap(depth))

    _, force = air_force(plate, (1, 1), (24, 24), frequency, 1e12)  # hardly compressible

    squeeze = force[0, 0].imag * side**2  # the first polynomial is 1 / side everywhere
    damping = squeeze / (2 * np.pi * frequency)
    assert damping == pytest.approx(0.4217 * VISCOSITY * side**4 / depth**3, rel=0.01)


def test_stiff_plate_heaves_on_its_sealed_gap():
    """At sqrt(gamma p0 / (d m'')) / 2 pi = 39.1 Hz, far below its bending."""
    text = (
        "plate: {length: 0.3, width: 0.2, thickness: 3 mm, material: steel,"
        " air_gap: {depth: 100 mm, closed: true}}\n"
        "eras: {A: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}}\n"
        'amplifiers: {main: {url: "sim://"}}\n'
    )

    heave, bending = natural_modes(parse_rig("rig.yaml", text), 2, support="free").frequencies

    air_spring, surface_density = HEAT_RATIO * PRESSURE / 0.1, 7850 * 3e-3
    expected = np.sqrt(air_spring / surface_density) / (2 * np.pi)
    assert heave == pytest.approx(expected, rel=0.01)
    assert bending > 4 * expected


# Laminates

EXAMPLE = Path(__file__).parents[3] / "examples" / "glass_panel.yaml"
COVER = LaminateLayer(Material("cover", E=71.5e9, rho=2420.0, nu=0.21), 1.8e-3)
ADHESIVE = LaminateLayer(Material("adhesive", E=1e6, rho=1000.0, nu=0.49), 0.2e-3)
GLASS = LaminateLayer(PANE.material, 0.7e-3)
PANEL = (COVER, ADHESIVE, GLASS)
THIN_PANEL = (GLASS, replace(ADHESIVE, thickness=0.1e-3), GLASS)
DEGREES, PANEL_MESH = (10, 8), SpectralMesh(10, 8, 0.375, 0.225)


def lossy_panel(core_loss):
    """Layers with a loss factor of the adhesive."""
    return (COVER, replace(ADHESIVE, loss_factor=core_loss), GLASS)


def panel(layers, length=0.375, width=0.225, **changes):
    """The plate of some layers."""
    laminate = Laminate(layers)
    return equivalent_plate(laminate, length=length, width=width, frequency=500.0, **changes)


def class_modes(plate, degrees, parity, cut):
    """The modes of a symmetry up to a frequency [Hz]."""
    return SpectralPlate(plate, degrees, 150.0).modes(
        parity,
        shift=(2 * np.pi * 30) ** 2,
        cut=(2 * np.pi * cut) ** 2,
        band=MaterialBand(30.0, cut),
    )


def elastic_frequencies(squares):
    """Natural frequencies [Hz] without those of rigid-body modes, ascending."""
    return np.sqrt(np.sort(squares[squares > 1])) / (2 * np.pi)


@pytest.mark.parametrize("layers", [PANEL, THIN_PANEL])
def test_free_strip_equals_elasticity(layers):
    """Six modes of a free strip of 375 mm within 0.5 % of plane-strain finite elements.

    One rigidity for all of them is off by -16 to +9 % and by -31 to +16 %.
    """
    plate = panel(layers, width=1.0)

    even = class_modes(plate, (16, 0), (1, 1), 1500.0)
    odd = class_modes(plate, (16, 0), (-1, 1), 1500.0)
    frequencies = elastic_frequencies(np.concatenate([even.eigenvalues, odd.eigenvalues]))

    expected = strip_frequencies(layers, 0.375, 6)
    np.testing.assert_allclose(frequencies[:6], expected, rtol=5e-3)


def test_complex_modes_equal_a_complex_eigenproblem():
    """With a loss factor of 1 in the core, frequency within 0.1 % and loss within 1 %.

    The eigenvalue of the dynamic stiffness, solved at its own frequency without a modal space.
    """
    plate = panel(lossy_panel(1.0), loss_factor=0.0)
    layered = SpectralPlate(plate, DEGREES, 150.0)
    inertia = plate.material.rho * plate.thickness

    modes = class_modes(plate, DEGREES, (1, 1), 500.0)

    for square, loss in zip(modes.eigenvalues[1:4], modes.losses[1:4], strict=True):
        frequency = np.sqrt(square) / (2 * np.pi)
        stiffness = dynamic_stiffness(layered, (1, 1), frequency) / inertia
        values = linalg.eigvals(stiffness + square * np.eye(len(stiffness)))
        distances = np.abs(values - (square + 1j * loss))
        nearest = values[np.argmin(distances)]
        assert square == pytest.approx(nearest.real, rel=2e-3)
        assert loss == pytest.approx(nearest.imag, rel=1e-2)


def test_complex_mode_that_does_not_converge_is_rejected(monkeypatch):
    """In two steps the mode of a lossy core is still on its way."""
    monkeypatch.setattr("model.spectral.modes._STEPS", 2)

    with pytest.raises(InputError, match=r"^plate: its mode near .* must converge in 2 steps"):
        solve_free_plate(panel(lossy_panel(1.0)), PANEL_MESH, frequency_max=300.0)


def test_lossy_layers_damp_in_time_as_at_each_frequency():
    """On soft mounts a mode decays with half its loss factor, that of the free plate's mode."""
    plate = panel(lossy_panel(0.3), loss_factor=0.01)
    corners = [(0, 0), (0.375, 0), (0, 0.225), (0.375, 0.225)]
    eras = [
        Era(f"E{number}", x, y, stiffness=50.0, damping=0.0, bolt_mass=0.0, stroke=1e-4)
        for number, (x, y) in enumerate(corners)
    ]
    free = solve_free_plate(plate, PANEL_MESH, frequency_max=300.0)

    reduced = reduce_free_plate(free, footprints_of(eras, ()))
    modes = supported_modes(reduced, eras, frequency_max=250.0)

    lowest = np.argsort(free.modes.eigenvalues)[3:7]
    loss_factors = 0.01 + free.modes.losses[lowest] / free.modes.eigenvalues[lowest]
    np.testing.assert_allclose(modes.damping_ratios[3:7], loss_factors / 2, rtol=0.02)


def test_finite_elements_reject_layers():
    """They would solve another plate, also for a simple support."""
    with pytest.raises(InputError, match=r"^support must be free or eras"):
        natural_modes(load_rig(EXAMPLE), 3, support="simply-supported")
    with pytest.raises(InputError, match=r"^mesh: must be of polynomials"):
        assemble(panel(PANEL), Mesh(12, 9, 0.375, 0.225))


# Independent solvers and finer solutions

# Converged Reissner-Mindlin frequencies [Hz] of the paper's plate: NGSolve 6.2, order 5 with edge
# layers resolved; scikit-fem of order 4 agrees to 0.0013 %.
CONVERGED = {
    "simply-supported": [
        *(109.437, 227.636, 319.858, 424.842, 437.58, 634.244),
        *(670.462, 700.874, 787.866, 909.82, 983.929, 1055.56),
    ],
    "free": [
        *(70.0349, 84.4211, 158.307, 166.542, 203.446, 249.124),
        *(319.32, 340.186, 431.064, 477.535, 482.927, 524.087),
    ],
    "eras": [
        *(31.6186, 67.9034, 75.4567, 106.449, 156.821, 211.972),
        *(214.733, 248.396, 330.943, 357.949, 388.062, 444.871),
    ],
}
POLYNOMIALS = mesh_of("auto", PAPER, frequency_max=500.0, stiffness=17e3)
ACCURATE = Mesh.accurate(PAPER, frequency_max=500.0)


@pytest.mark.parametrize(
    ("support", "mesh", "tolerance"),
    [
        ("free", POLYNOMIALS, 3e-5),
        ("eras", POLYNOMIALS, 2e-4),
        ("simply-supported", ACCURATE, 2e-4),
        pytest.param("free", ACCURATE, 2e-4, marks=pytest.mark.long),
        pytest.param("eras", ACCURATE, 2e-4, marks=pytest.mark.long),
    ],
)
def test_natural_frequencies_are_those_of_an_independent_solver(support, mesh, tolerance):
    """Twelve frequencies of NGSolve, free, on springs at the corners, and on simple supports.

    Springs are points there. The accurate mesh has 10x8 elements of order 5.
    """
    modes = natural_modes(RIG, 12, support=support, mesh=mesh)

    np.testing.assert_allclose(modes.frequencies, CONVERGED[support], rtol=tolerance)


@cache
def solved_once(plate, mesh, frequency_max):
    """The free plate, shared by the cases that follow."""
    return solve_free_plate(plate, mesh, frequency_max=frequency_max)


LAYOUTS = {
    "corners": [(0, 0), (1, 0), (0, 1), (1, 1)],
    "edges": [(0.3, 0), (0.61, 1), (0, 0.44), (1, 0.72)],
    "inside": [(0.21, 0.3), (0.63, 0.11), (0.47, 0.83), (0.9, 0.6)],
}


@pytest.mark.parametrize(("layout", "foot"), in_turn([*LAYOUTS], [0.002, 0.005, 0.01]))
def test_response_on_feet_is_that_of_fine_elements(layout, foot):
    """At degrees 12x9 within 0.5 %, at 24x18 within 0.1 %, also of feet that an edge cuts."""
    positions = SIDES * np.array(LAYOUTS[layout])
    eras = [Era("E", *position, 17e3, 3.5, 0.0, 1e-4, foot=foot) for position in positions]
    frequencies = np.linspace(60.0, 320.0, 14)
    points = np.random.default_rng(3).uniform(0.03, 0.97, (30, 2)) * SIDES

    def response(mesh):
        return solved_once(PAPER, mesh, 320.0).acceleration(eras, frequencies, points)

    exact = response(Mesh(16, 12, *SIDES, Q5, 0.002))
    coarse_error = np.linalg.norm(response(SpectralMesh(12, 9, *SIDES)) - exact)
    fine_error = np.linalg.norm(response(SpectralMesh(24, 18, *SIDES)) - exact)

    size = np.linalg.norm(exact)
    assert coarse_error / size < 0.005
    assert fine_error / size < 0.001


def test_more_accuracy_and_stiffer_eras_take_higher_degrees():
    """A stiffer spring dents the plate more, one on a foot less; auto means 1 %."""

    def degrees(text: str, stiffness: float, foot: float = 0.0) -> int:
        mesh = mesh_of(text, PAPER, frequency_max=320.0, stiffness=stiffness, foot=foot)
        return mesh.nx

    assert degrees("auto 5 %", 0.0) <= degrees("auto 1 %", 0.0) < degrees("auto 0.1 %", 0.0)
    assert degrees("auto 2 %", 17e3) < degrees("auto 1 %", 17e3) < degrees("auto 1 %", 500e3)
    assert degrees("auto 0.1 %", 17e3, foot=0.005) < degrees("auto 0.1 %", 17e3)
    assert degrees("auto", 500e3) == degrees("auto 1 %", 500e3)
    assert degrees("auto", 1e9) < 80


@pytest.mark.parametrize(
    "text", ["12x9", "12x9 Q3", "10x8 Q5 with strips of 3 mm", "14x12 Legendre"]
)
def test_mesh_is_read_as_it_is_printed(text):
    """By elements, with strips, and by degrees, as commands and pages name meshes."""
    assert str(parse_mesh(text, PAPER)) == text


@pytest.mark.parametrize(
    "text", ["14x12 Legendre with strips of 3 mm", "12x9 Q5 with strips of 3 kg", "12x9 with"]
)
def test_mesh_of_no_meaning_is_rejected(text):
    """Polynomials have no strips, and a strip has a width."""
    with pytest.raises(InputError):
        parse_mesh(text, PAPER)
