"""Laminates: bounds by hand, shear between them against elasticity solved through the thickness."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.modal import modes
from model.rig.file import load_rig
from model.structure.laminate import (
    Bond,
    Laminate,
    Layer,
    bending,
    equivalent_plate,
    freely_sliding,
    perfectly_bonded,
)
from model.structure.plate import Material

GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
STEEL = Material("steel", E=210e9, rho=7850.0, nu=0.3)
FOAM = Material("foam", E=70e6, rho=100.0, nu=0.33)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
PANEL = (Layer(GLASS, 1.8e-3), Layer(ADHESIVE, 0.2e-3), Layer(GLASS, 0.7e-3))


def of_plate(laminate, **changes):
    """The equivalent plate of some size."""
    return equivalent_plate(laminate, length=0.4, width=0.25, **changes)


def wave_rigidity(layers, frequency):
    """D = m'' omega² / k⁴ of the bending wave of a frequency [Hz], by plane-strain elasticity.

    Elements of the second order through the thickness, exp(i k x) along it; nothing of a plate is
    assumed. Displacements u (imaginary part, along x) and w per node.
    """
    gauss = [(-math.sqrt(0.6), 5 / 9), (0.0, 8 / 9), (math.sqrt(0.6), 5 / 9)]
    density = sum(layer.material.rho * layer.thickness for layer in layers)
    pieces = [(layer.material, layer.thickness / 4) for layer in layers for _ in range(4)]

    def lowest(k):
        size = 2 * (2 * len(pieces) + 1)
        K, M = np.zeros((size, size)), np.zeros((size, size))
        for number, (material, h) in enumerate(pieces):
            nu, factor = material.nu, material.E / ((1 + material.nu) * (1 - 2 * material.nu))
            C = factor * np.array([[1 - nu, nu, 0], [nu, 1 - nu, 0], [0, 0, (1 - 2 * nu) / 2]])
            dofs = slice(4 * number, 4 * number + 6)
            for xi, weight in gauss:
                N = np.array([xi * (xi - 1) / 2, 1 - xi**2, xi * (xi + 1) / 2])
                dN = np.array([xi - 0.5, -2 * xi, xi + 0.5]) * 2 / h
                B = np.zeros((3, 6))  # u = i U exp(ikx): strains -kU, dw/dz, i (dU/dz + k w)
                B[0, 0::2] = -k * N
                B[1, 1::2] = dN
                B[2, 0::2] = dN
                B[2, 1::2] = k * N
                fields = np.kron(N, np.eye(2))
                K[dofs, dofs] += weight * h / 2 * B.T @ C @ B
                M[dofs, dofs] += weight * h / 2 * material.rho * fields.T @ fields
        return linalg.eigh(K, M, eigvals_only=True, subset_by_index=[0, 0])[0]

    target = (2 * math.pi * frequency) ** 2
    low, high = 1.0, 500.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if lowest(middle) < target else (low, middle)
    return density * target / low**4


def test_bonded_layers_equal_laminate_theory():
    """D* = D - B A⁻¹ B with the full 3x3 matrices, from any reference plane."""
    layers = [Layer(STEEL, 0.5e-3), Layer(GLASS, 2e-3), Layer(FOAM, 1e-3)]
    A, B, D = (np.zeros((3, 3)) for _ in range(3))
    z = -0.7e-3
    for layer in layers:
        nu, h = layer.material.nu, layer.thickness
        Q = (
            layer.material.E
            / (1 - nu**2)
            * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
        )
        A += Q * h
        B += Q * ((z + h) ** 2 - z**2) / 2
        D += Q * ((z + h) ** 3 - z**3) / 3
        z += h
    whole = D - B @ np.linalg.solve(A, B)
    bent = perfectly_bonded(layers)
    expected = bent.rigidity * np.array(
        [[1, bent.nu, 0], [bent.nu, 1, 0], [0, 0, (1 - bent.nu) / 2]]
    )
    np.testing.assert_allclose(whole, expected, rtol=1e-9, atol=1e-9 * bent.rigidity)


@pytest.mark.parametrize(("bond", "frequency"), [("full", None), ("none", None), ("shear", 150.0)])
def test_equivalent_plate_keeps_rigidity_nu_and_mass(bond, frequency):
    """What the solver is given carries D*, nu and the surface density, by hand 6.45 kg/m²."""
    laminate = Laminate(PANEL, Bond(bond), frequency)
    plate = of_plate(laminate, loss_factor=0.02)
    bent = bending(laminate)
    assert plate.flexural_rigidity == pytest.approx(bent.rigidity, rel=1e-8)
    assert plate.material.nu == pytest.approx(bent.nu, rel=1e-8)
    assert plate.mass == pytest.approx(6.45 * 0.4 * 0.25, rel=1e-8)
    assert (plate.length, plate.width, plate.loss_factor) == (0.4, 0.25, 0.02)


def test_equivalent_plate_keeps_rotary_inertia():
    """Bonded glass: rho H³ / 12 of the whole; sliding: of each; a sandwich: faces at their arms."""
    three = (Layer(GLASS, 1e-3),) * 3
    assert of_plate(Laminate(three)).thickness == pytest.approx(3e-3, rel=1e-9)
    assert of_plate(Laminate(three, Bond.NONE)).thickness == pytest.approx(1e-3, rel=1e-9)
    sandwich = Laminate((Layer(ALUMINIUM, 1e-3), Layer(FOAM, 10e-3), Layer(ALUMINIUM, 1e-3)))
    inertia = 2 * (2.7 * 1e-6 / 12 + 2.7 * 5.5e-3**2) + 1.0 * 1e-4 / 12
    plate = of_plate(sandwich)
    assert plate.material.rho * plate.thickness**3 / 12 == pytest.approx(inertia, rel=1e-8)


@pytest.mark.parametrize("modulus", [0.1e6, 1e6, 10e6, 1e9])
@pytest.mark.parametrize("frequency", [40.0, 150.0, 500.0])
def test_shear_bond_equals_elasticity(modulus, frequency):
    """Within 0.2 % for adhesives from gel to epoxy; the bounds are a factor of 3 apart."""
    adhesive = Material("adhesive", E=modulus, rho=1000.0, nu=0.49)
    layers = (PANEL[0], Layer(adhesive, 0.2e-3), PANEL[2])
    bent = bending(Laminate(layers, Bond.SHEAR, frequency))
    assert bent.rigidity == pytest.approx(wave_rigidity(layers, frequency), rel=0.002)


def test_shear_bond_of_two_adhesives_equals_elasticity():
    """Cover, sensor and display glass on two different adhesives, within 0.2 %."""
    other = Material("other", E=3e6, rho=1000.0, nu=0.49)
    layers = (*PANEL, Layer(other, 0.1e-3), Layer(GLASS, 1.1e-3))
    bent = bending(Laminate(layers, Bond.SHEAR, 150.0))
    assert bent.rigidity == pytest.approx(wave_rigidity(layers, 150.0), rel=0.002)


def test_example_panel_equals_thin_plate():
    """Simply supported, its lowest modes are those of a thin plate of the stack's own rigidity.

    f = pi/2 (m²/a² + n²/b²) sqrt(D / m''), D by elasticity through the thickness and m'' = 6.306
    kg/m² by hand; finite elements come out up to 1 % lower, for they shear and turn.
    """
    rig = load_rig(Path(__file__).parents[3] / "examples" / "glass_panel.yaml", mesh="60x36")
    cover = Material("cover", E=71.5e9, rho=2420.0, nu=0.21)
    layers = (Layer(cover, 1.8e-3), PANEL[1], PANEL[2])
    speed = math.sqrt(wave_rigidity(layers, 150.0) / 6.306)
    orders = [(1, 1), (2, 1), (3, 1), (1, 2)]
    thin = [math.pi / 2 * (m**2 / 0.375**2 + n**2 / 0.225**2) * speed for m, n in orders]
    solved = modes(assemble(rig.plate, rig.mesh), 4, support="simply-supported")
    np.testing.assert_allclose(solved.natural_frequencies, sorted(thin), rtol=0.01)
    assert len(rig.eras) == 6
    assert sum(mass.mass for mass in rig.masses) == pytest.approx(0.013)


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        (((),), "layer"),
        ((PANEL, Bond.SHEAR), "bond_frequency"),
        ((PANEL, Bond.SHEAR, 0.0), "bond_frequency"),
        ((PANEL, Bond.SHEAR, math.nan), "bond_frequency"),
        ((PANEL[:2], Bond.SHEAR, 100.0), "layers .*got"),
        ((PANEL[:1], Bond.SHEAR, 100.0), "layers .*got"),
        ((PANEL, Bond.FULL, 100.0), "bond_frequency"),
    ],
)
def test_laminate_refuses_layers_and_frequencies_that_do_not_fit_its_bond(arguments, place):
    """Missing layers, and frequencies that are missing, out of range or not allowed."""
    with pytest.raises(InputError, match=rf"^laminate: .*{place}"):
        Laminate(*arguments)


def test_sliding_layers_add_their_rigidities():
    """Two equal layers are twice one, a quarter of the bonded pair; others add up by hand."""
    two = [Layer(GLASS, 1e-3), Layer(GLASS, 1e-3)]
    assert freely_sliding(two).rigidity == pytest.approx(2 * 70 / (12 * 0.96), rel=1e-12)
    assert perfectly_bonded(two).rigidity / freely_sliding(two).rigidity == pytest.approx(4)
    mixed = freely_sliding([Layer(STEEL, 1e-3), Layer(GLASS, 2e-3)])
    steel, glass = 210 / (12 * 0.91), 560 / (12 * 0.96)
    assert mixed.rigidity == pytest.approx(steel + glass, rel=1e-12)
    assert mixed.nu == pytest.approx((0.3 * steel + 0.2 * glass) / (steel + glass), rel=1e-12)
