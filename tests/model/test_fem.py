"""Meshes, modes and harmonic responses of finite elements."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from long_form import shortly
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import ELEMENTS, Element, Mesh, PlateMatrices, assemble, lowest_modes, rigidities
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import parse_mesh
from model.structure.attachments import Era
from model.structure.plate import Plate
from model.vibration import natural_modes
from plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

# Converged Reissner-Mindlin frequencies [Hz] of the same plate: NGSolve 6.2, order 5; scikit-fem of
# order 4 agrees to 0.0013 %.
CONVERGED = {
    "simply-supported": [
        109.437, 227.636, 319.858, 424.842, 437.58, 634.244,
        670.462, 700.874, 787.866, 909.82, 983.929, 1055.56,
    ],
    "free": [
        70.0349, 84.4211, 158.307, 166.542, 203.446, 249.124,
        319.32, 340.186, 431.064, 477.535, 482.927, 524.087,
    ],
    "eras": [
        31.6186, 67.9034, 75.4567, 106.449, 156.821, 211.972,
        214.733, 248.396, 330.943, 357.949, 388.062, 444.871,
    ],
}  # fmt: skip


@pytest.mark.parametrize("support", shortly(CONVERGED, ["simply-supported"]))
def test_modes_of_the_auto_mesh_are_converged(support):
    """Twelve modes of its 10x8 elements of order 5 are within 0.02 %, for each support."""
    rig = make_paper_rig(12, 9)
    mesh = Mesh.accurate(rig.plate, frequency_max=500.0)
    solved = natural_modes(rig, 12, support=support, mesh=mesh)
    np.testing.assert_allclose(solved.frequencies, CONVERGED[support], rtol=2e-4)


def test_acceleration_of_a_rigid_plate_equals_mass_on_springs(coarse_rig):
    """Driven evenly, a plate 20 mm thick follows the one-mass transmissibility by hand."""
    plate = replace(coarse_rig.plate, thickness=0.020)
    soft = tuple(Era(e.name, e.x, e.y, 500.0, 2.0, 0.003, 1e-4) for e in coarse_rig.eras)
    omega = 2 * np.pi * 8.0
    free = solve_free_plate(plate, coarse_rig.mesh, frequency_max=500.0)
    response = free.acceleration(soft, np.array([8.0]), coarse_rig.mesh.nodes)
    mass = plate.mass + 4 * 0.003
    spring = 4 * (500.0 + 1j * omega * 2.0)
    by_hand = -(omega**2) * 1e-4 * spring / (spring - omega**2 * mass)
    np.testing.assert_allclose(response[0].sum(axis=0), by_hand, rtol=2e-3)


MESHES = [Mesh(12, 9, LENGTH, WIDTH), Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["MITC4"], 0.002)] + [
    Mesh(3, 2, LENGTH, WIDTH, element, 0.003) for element in ELEMENTS.values()
]


@pytest.mark.parametrize("mesh", MESHES, ids=str)
def test_interpolation_is_exact_for_polynomials_of_the_element(mesh):
    """Every polynomial up to the element's order, along both sides, comes out at any point."""
    points = np.random.default_rng(0).uniform(0, [LENGTH, WIDTH], (60, 2))
    points[0] = [LENGTH, WIDTH]
    order = mesh.element.order

    def carried(at):
        return (1 + at[:, 0] / LENGTH) ** order * (2 - at[:, 1] / WIDTH) ** order

    np.testing.assert_allclose(
        mesh.interpolation(points) @ carried(mesh.nodes), carried(points), rtol=1e-12
    )


def test_mesh_strips_lie_along_every_edge():
    """Strips of 3 mm are the first and last elements; those between share the rest evenly.

    Neither no elements nor strips that fill the plate make a mesh.
    """
    mesh = Mesh(4, 3, 0.3, 0.2, ELEMENTS["Q5"], 0.003)
    x, y = (line.ends for line in mesh.along)
    np.testing.assert_allclose(x, [0, 0.003, 0.0765, 0.15, 0.2235, 0.297, 0.3])
    np.testing.assert_allclose(y, [0, 0.003, 0.003 + 0.194 / 3, 0.003 + 2 * 0.194 / 3, 0.197, 0.2])
    for change in ({"nx": 0}, {"strip": 0.1}, {"strip": -0.001}, {"strip": float("nan")}):
        with pytest.raises(InputError, match=r"^mesh: "):
            replace(mesh, **change)


def test_mesh_is_read_as_it_is_printed():
    """By elements, with strips, and by degrees, as commands and pages name meshes."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    for text in ("12x9", "12x9 Q3", "10x8 Q5 with strips of 3 mm", "14x12 Legendre"):
        assert str(parse_mesh(text, plate)) == text
    assert parse_mesh("10x8 Q5 with strips of 3 mm", plate) == Mesh.accurate(
        plate, frequency_max=500.0
    )
    for text in ("14x12 Legendre with strips of 3 mm", "12x9 Q5 with strips of 3 kg", "12x9 with"):
        with pytest.raises(InputError):
            parse_mesh(text, plate)


@pytest.mark.parametrize("sides", [(LENGTH, WIDTH), (0.7, 0.1), (0.05, 0.06)])
def test_coarsest_mesh_is_the_coarsest_that_resolves_its_frequency(sides):
    """Its elements are short enough along both sides; one fewer along either is too long.

    The highest frequency has six nodes to a wavelength: nodes an inch apart carry waves of 152.4
    mm, which are those of 631.85 Hz.
    """
    plate = Plate(*sides, 0.0015, ALUMINIUM)
    for frequency in (40.0, 500.0, 1637.0):
        mesh = Mesh(1, 1, *sides).resolving(plate, frequency)
        assert mesh.highest_frequency(plate) >= frequency
        for fewer in ((mesh.nx - 1, mesh.ny), (mesh.nx, mesh.ny - 1)):
            if min(fewer):
                assert Mesh(*fewer, *sides).highest_frequency(plate) < frequency
    paper = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    for mesh in (Mesh(12, 9, LENGTH, WIDTH), Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q3"])):
        # 2 pi / wavelength² * sqrt(D / rho h), with D = 22.0935 N m and rho h = 4.05 kg/m²
        highest = mesh.highest_frequency(paper)
        assert highest == pytest.approx(631.85, abs=0.01)
        again = mesh.resolving(paper, highest * (1 - 1e-8))
        assert (again.nx, again.ny) == (mesh.nx, mesh.ny)


DX, DY = 0.03, 0.02  # m; not square, so that a swap of x and y shows
PLATE = Plate(0.3, 0.24, 0.002, ALUMINIUM)
THIN = Plate(0.3, 0.24, 0.3e-3, ALUMINIUM)  # so thin that locking shows


@pytest.fixture(params=ELEMENTS.values(), ids=ELEMENTS)
def element(request: pytest.FixtureRequest) -> Element:
    """Each element in turn."""
    return request.param


def nodal(element: Element, w: object, beta_x: object, beta_y: object) -> FloatArray:
    """Degrees of freedom of the element for fields of x and y [m] from its lower left."""
    side = (1 + np.array(element.side)) / 2
    x, y = np.tile(DX * side, len(side)), np.repeat(DY * side, len(side))
    fields = [np.broadcast_to(field(x, y), x.shape) for field in (w, beta_x, beta_y)]
    return np.stack(fields, axis=1).ravel()


def of_one(element: Element) -> PlateMatrices:
    """Stiffness and mass of a rectangle that is one element."""
    return assemble(replace(PLATE, length=DX, width=DY), Mesh(1, 1, DX, DY, element))


def test_rigidities_equal_hand_calculation():
    """2 mm of E = 70 GPa, nu = 0.33; the tests of elements stand on these.

    D = E h³ / (12 (1 - nu²)) = 560 / 10.6932 = 52.3697 N m, kappa G h = 5/6 of 70 GPa / 2.66 times
    2 mm = 43.8596 MN/m.
    """
    expected = {"coupled": 17.2820, "twist": 17.5439}
    expected |= {f"bending_{side}": 52.3697 for side in "xy"}
    expected |= {f"shear_{side}": 43.8596e6 for side in "xy"}
    assert rigidities(PLATE) == pytest.approx(expected, rel=1e-5)


def test_three_motions_take_no_force(element):
    """Up and down, and both tilts; there are no spurious modes."""
    stiffness = of_one(element).stiffness.toarray()
    for fields in (
        (lambda x, y: 1, lambda x, y: 0, lambda x, y: 0),
        (lambda x, y: x, lambda x, y: 1, lambda x, y: 0),
        (lambda x, y: y, lambda x, y: 0, lambda x, y: 1),
    ):
        force = stiffness @ nodal(element, *fields)
        assert np.abs(force).max() < 1e-9 * np.abs(stiffness).max()
    energies = np.linalg.eigvalsh(stiffness)
    assert (energies <= 1e-9 * energies[-1]).sum() == 3


D, NU = PLATE.flexural_rigidity, PLATE.material.nu
SHEAR = 5 / 6 * PLATE.material.E / (2 * (1 + NU)) * PLATE.thickness


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ((lambda x, y: x**2 / 2, lambda x, y: x, lambda x, y: 0), D / 2),
        ((lambda x, y: y**2 / 2, lambda x, y: 0, lambda x, y: y), D / 2),
        ((lambda x, y: (x**2 - y**2) / 2, lambda x, y: x, lambda x, y: -y), D * (1 - NU)),
        ((lambda x, y: x * y, lambda x, y: y, lambda x, y: x), D * (1 - NU)),
        ((lambda x, y: x, lambda x, y: 0, lambda x, y: 0), SHEAR / 2),
        ((lambda x, y: y, lambda x, y: 0, lambda x, y: 0), SHEAR / 2),
    ],
    ids=["along x", "along y", "saddle", "twist", "shear x", "shear y"],
)
def test_constant_strain_has_the_energy_of_plate_theory(element, fields, expected):
    """Per area D/2 of a unit curvature, D (1 - nu) of a saddle and a twist, kappa G h / 2."""
    motion = nodal(element, *fields)
    energy = motion @ of_one(element).stiffness @ motion / 2 / (DX * DY)
    assert energy == pytest.approx(expected, rel=1e-9)


def frequency_error(element: Element, count: int) -> float:
    """Relative error of a thin plate's lowest natural frequency with count by count elements.

    On hard simple supports, w and the rotation along the edge fixed, w = sin(pi x / L) sin(pi y /
    W) with rotations alike solves the Reissner-Mindlin plate exactly.
    """
    mesh = Mesh(count, count, THIN.length, THIN.width, element)
    assembled = assemble(THIN, mesh)
    node = np.arange(mesh.node_count).reshape(mesh.rows, mesh.columns)
    sides, ends = node[:, [0, -1]].ravel(), node[[0, -1]].ravel()
    fixed = np.concatenate([3 * sides, 3 * sides + 2, 3 * ends, 3 * ends + 1])
    free = np.setdiff1d(np.arange(mesh.dof), fixed)
    a, b = np.pi / THIN.length, np.pi / THIN.width
    S = rigidities(THIN)["shear_x"]
    D, nu = THIN.flexural_rigidity, THIN.material.nu
    density = THIN.material.rho * THIN.thickness
    moving = density * np.diag([1, THIN.thickness**2 / 12, THIN.thickness**2 / 12])
    coupled = D * a * b * (1 + nu) / 2
    stiffness = np.array(
        [
            [S * (a**2 + b**2), -S * a, -S * b],
            [-S * a, D * (a**2 + (1 - nu) / 2 * b**2) + S, coupled],
            [-S * b, coupled, D * (b**2 + (1 - nu) / 2 * a**2) + S],
        ]
    )
    exact = float(eigh(stiffness, moving, eigvals_only=True)[0])
    eigenvalues, _ = lowest_modes(
        assembled.stiffness[free][:, free], assembled.mass[free][:, free], 1, shift=exact
    )
    return float(np.sqrt(max(eigenvalues[0], 0.0) / exact) - 1)


@pytest.mark.parametrize(("name", "expected"), [("MITC4", 2.0), ("Q3", 4.0), ("Q4", 6.0)])
def test_elements_converge_with_theoretical_rates(name, expected):
    """A frequency errs as the energy does (Strang and Fix, ch. 6).

    By h² where rotations are linear; by h^2(p - 1) where slopes and rotations of order p are made
    equal by being thin alone. Q5 is exact to rounding with 8 elements a side.
    """
    # With 8 elements a side Q4 errs by 7e-9 of a thin plate's frequency, no more than by rounding.
    coarse, fine = (abs(frequency_error(ELEMENTS[name], count)) for count in (3, 6))
    assert np.log2(coarse / fine) == pytest.approx(expected, abs=0.15)
    assert abs(frequency_error(ELEMENTS["Q5"], 8)) < 1e-7
