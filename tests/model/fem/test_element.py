"""Elements against what their matrices must keep, and against plates that are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from model.arrays import FloatArray
from model.fem.mesh import ELEMENTS, Element, Mesh
from model.fem.plate import PlateMatrices, assemble, lowest_modes, rigidities
from model.structure.plate import Plate
from paper_plate import ALUMINIUM

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
    expected = {"bending": 52.3697, "coupled": 17.2820, "twist": 17.5439, "shear": 43.8596e6}
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
SHEAR = 5 / 6 * PLATE.material.shear_modulus * PLATE.thickness


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
    S = rigidities(THIN)["shear"]
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
    equal by being thin alone.
    """
    # With 8 elements a side Q4 errs by 7e-9 of a thin plate's frequency, no more than by rounding.
    coarse, fine = (abs(frequency_error(ELEMENTS[name], count)) for count in (3, 6))
    assert np.log2(coarse / fine) == pytest.approx(expected, abs=0.15)


def test_q5_is_exact_to_rounding():
    """With 8 elements a side."""
    assert abs(frequency_error(ELEMENTS["Q5"], 8)) < 1e-7
