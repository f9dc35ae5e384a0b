"""Meshes: nodes, interpolation, choice for a frequency and refused values."""

import numpy as np
import pytest

from model.errors import InputError
from model.fem.mesh import ELEMENTS, Mesh
from model.rig.meshes import mesh_from_dict, parse_mesh
from model.structure.plate import Plate
from paper_plate import ALUMINIUM, LENGTH, WIDTH

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
    """Strips of 3 mm are the first and last elements; those between share the rest evenly."""
    mesh = Mesh(4, 3, 0.3, 0.2, ELEMENTS["Q5"], 0.003)
    x, y = mesh.lines
    np.testing.assert_allclose(x, [0, 0.003, 0.0765, 0.15, 0.2235, 0.297, 0.3])
    np.testing.assert_allclose(y, [0, 0.003, 0.003 + 0.194 / 3, 0.003 + 2 * 0.194 / 3, 0.197, 0.2])


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


def test_accurate_mesh_follows_the_bending_wavelength():
    """At twice the frequency the wave is 1.41 times shorter, at four times half as long."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    low, high = (Mesh.accurate(plate, frequency_max=f) for f in (500.0, 2000.0))
    # 0.3048 m and 0.2286 m of waves 0.1704 m and 0.0852 m long, 5.5 elements each
    assert [(mesh.nx, mesh.ny) for mesh in (low, high)] == [(10, 8), (20, 15)]
    assert low.strip == high.strip == 0.003


def test_accurate_mesh_has_no_strips_when_plate_is_thick():
    """Where the edge's layer is as wide as an element, the element follows it already."""
    assert Mesh.accurate(Plate(0.2, 0.1, 0.02, ALUMINIUM), frequency_max=500.0).strip == 0


@pytest.mark.parametrize("kind", [("MITC4", 12, 9), ("Q3", 4, 3)])
def test_highest_frequency_has_six_nodes_to_a_wavelength(kind):
    """Nodes an inch apart carry waves of 152.4 mm, which are those of 631.85 Hz."""
    element, nx, ny = kind
    mesh = Mesh(nx, ny, LENGTH, WIDTH, ELEMENTS[element])
    # 2 pi / wavelength² * sqrt(D / rho h), with D = 22.0935 N m and rho h = 4.05 kg/m²
    highest = mesh.highest_frequency(Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM))
    assert highest == pytest.approx(631.85, abs=0.01)


@pytest.mark.parametrize("sides", [(0.3048, 0.2286), (0.7, 0.1), (0.05, 0.06)])
def test_coarsest_mesh_is_the_coarsest_that_resolves_its_frequency(sides):
    """Its elements are short enough along both sides; one fewer along either is too long."""
    plate = Plate(*sides, 0.0015, ALUMINIUM)
    for frequency in (40.0, 500.0, 1637.0):
        mesh = Mesh.coarsest(plate, frequency=frequency)
        assert mesh.highest_frequency(plate) >= frequency
        for fewer in ((mesh.nx - 1, mesh.ny), (mesh.nx, mesh.ny - 1)):
            if min(fewer):
                assert Mesh(*fewer, *sides).highest_frequency(plate) < frequency
    exact = Mesh(12, 9, LENGTH, WIDTH)
    paper = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    again = Mesh.coarsest(paper, frequency=exact.highest_frequency(paper) * (1 - 1e-8))
    assert (again.nx, again.ny) == (12, 9)


@pytest.mark.parametrize(
    "arguments",
    [
        (0, 9, 0.3, 0.2),
        (4, 4, 0.3, 0.2, ELEMENTS["Q5"], 0.1),
        (4, 4, 0.3, 0.2, ELEMENTS["Q5"], -0.001),
        (4, 4, 0.3, 0.2, ELEMENTS["Q5"], float("nan")),
    ],
)
def test_mesh_refuses_no_elements_and_wide_strips(arguments):
    """No elements, or strips that fill the plate."""
    with pytest.raises(InputError, match=r"^mesh: "):
        Mesh(*arguments)


def test_mesh_refuses_an_unknown_element():
    """The error names the element."""
    with pytest.raises(InputError, match="'MITC9'"):
        mesh_from_dict(Mesh(4, 4, 0.3, 0.2).to_dict() | {"element": "MITC9"})
