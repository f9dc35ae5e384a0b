"""Laminates: bounds by hand, waves against elasticity and published sandwich plates."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.layers.elasticity import wave_number
from long_form import in_turn
from model.structure.plate import (
    Bond,
    Laminate,
    LaminateLayer,
    Material,
    bending,
    equivalent_plate,
    freely_sliding,
    perfectly_bonded,
    shear_corrections,
    wave_rigidity,
    wavenumber_of,
)

GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
STEEL = Material("steel", E=210e9, rho=7850.0, nu=0.3)
FOAM = Material("foam", E=70e6, rho=100.0, nu=0.33)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
PANEL = (
    LaminateLayer(GLASS, 1.8e-3),
    LaminateLayer(ADHESIVE, 0.2e-3),
    LaminateLayer(GLASS, 0.7e-3),
)


def of_plate(laminate, **changes):
    """The plate of a laminate, of some size."""
    return equivalent_plate(laminate, length=0.4, width=0.25, frequency=150.0, **changes)


def test_bonded_layers_equal_laminate_theory():
    """D* = D - B A⁻¹ B with the full 3x3 matrices, from any reference plane."""
    layers = [LaminateLayer(STEEL, 0.5e-3), LaminateLayer(GLASS, 2e-3), LaminateLayer(FOAM, 1e-3)]
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


@pytest.mark.parametrize("bond", ["full", "none"])
def test_equivalent_plate_keeps_rigidity_nu_and_mass(bond):
    """What is like the laminate carries D, nu and the surface density, by hand 6.45 kg/m²."""
    laminate = Laminate(PANEL, Bond(bond))
    plate = of_plate(laminate, loss_factor=0.02)
    bent = bending(laminate, 150.0)
    assert plate.flexural_rigidity == pytest.approx(bent.rigidity, rel=1e-8)
    assert plate.material.nu == pytest.approx(bent.nu, rel=1e-8)
    assert plate.mass == pytest.approx(6.45 * 0.4 * 0.25, rel=1e-8)
    assert (plate.length, plate.width, plate.loss_factor) == (0.4, 0.25, 0.02)
    assert plate.laminate == (laminate if bond == "full" else None)


def test_equivalent_plate_keeps_rotary_inertia():
    """Bonded glass: rho H³ / 12 of the whole; sliding: of each; a sandwich: faces at their arms."""
    three = (LaminateLayer(GLASS, 1e-3),) * 3
    assert of_plate(Laminate(three)).thickness == pytest.approx(3e-3, rel=1e-3)
    assert of_plate(Laminate(three, Bond.NONE)).thickness == pytest.approx(1e-3, rel=1e-9)
    stiff = replace(FOAM, E=7e9)
    sandwich = Laminate(
        (
            LaminateLayer(ALUMINIUM, 1e-3),
            LaminateLayer(stiff, 10e-3),
            LaminateLayer(ALUMINIUM, 1e-3),
        )
    )
    inertia = 2 * (2.7 * 1e-6 / 12 + 2.7 * 5.5e-3**2) + 1.0 * 1e-4 / 12
    plate = of_plate(sandwich)
    assert plate.material.rho * plate.thickness**3 / 12 == pytest.approx(inertia, rel=0.02)


@pytest.mark.parametrize(
    ("modulus", "frequency"), in_turn([0.1e6, 1e6, 10e6, 1e9], [40.0, 150.0, 500.0, 2000.0])
)
def test_waves_equal_elasticity(modulus, frequency):
    """Frequency of a wave within 0.5 % for adhesives from gel to epoxy, over the limits of a rig.

    At one wavenumber the frequency differs twice as much as the wavenumber at one frequency.
    """
    adhesive = Material("adhesive", E=modulus, rho=1000.0, nu=0.49)
    layers = (PANEL[0], LaminateLayer(adhesive, 0.2e-3), PANEL[2])
    expected = wave_number(layers, frequency)
    assert wavenumber_of(Laminate(layers), frequency).real == pytest.approx(expected, rel=0.0025)


def test_waves_on_two_adhesives_equal_elasticity():
    """Cover, sensor and display glass on two different adhesives, frequency within 0.1 %."""
    other = Material("other", E=3e6, rho=1000.0, nu=0.49)
    layers = (*PANEL, LaminateLayer(other, 0.1e-3), LaminateLayer(GLASS, 1.1e-3))
    k = wavenumber_of(Laminate(layers), 150.0).real
    assert k == pytest.approx(wave_number(layers, 150.0), rel=5e-4)


def test_simply_supported_sandwich_equals_published_frequencies_and_losses():
    """Five modes of a damped sandwich plate within 0.3 %, losses within 0.001.

    Analytical values after Abdulhadi, as in Johnson and Kienholz, AIAA J. 20 (1982) 1284, table 3.
    The modes of a simply supported plate are standing waves of its wavenumbers.
    """
    face = LaminateLayer(Material("face", E=68.9e9, rho=2740.0, nu=0.3), 0.762e-3)
    core = Material("core", E=0.896e6 * 2 * 1.49, rho=999.0, nu=0.49)
    laminate = Laminate((face, LaminateLayer(core, 0.254e-3, loss_factor=0.5), face))
    published = {
        (1, 1): (60.3, 0.190),
        (2, 1): (115.4, 0.203),
        (1, 2): (130.6, 0.199),
        (2, 2): (178.7, 0.181),
        (3, 1): (195.7, 0.174),
    }
    for (m, n), (frequency, loss) in published.items():
        k = math.pi * math.hypot(m / 0.348, n / 0.3048)
        square = wave_rigidity(laminate, k, 100.0) * k**4 / laminate.surface_density
        assert math.sqrt(square.real) / (2 * math.pi) == pytest.approx(frequency, rel=3e-3)
        assert square.imag / square.real == pytest.approx(loss, abs=1e-3)


def test_shear_corrections_are_those_of_one_layer_and_of_a_soft_core():
    """5/6 of a single layer (Reissner), 1 where shear is uniform, 3/4 where it grows from zero."""
    assert shear_corrections(PANEL[:1]) == pytest.approx([5 / 6])
    face = LaminateLayer(ALUMINIUM, 1e-5)
    corrections = shear_corrections((face, LaminateLayer(FOAM, 1e-2), face))
    assert corrections == pytest.approx([0.75, 1.0, 0.75], abs=5e-3)


def test_modulus_by_frequency_is_a_power_law_between_rows():
    """Half way in the logarithm of frequency E is the geometric mean; outside it is constant."""
    layer = LaminateLayer(FOAM, 1e-3, by_frequency=((10.0, 0.25, 0.2), (1000.0, 4.0, 0.6)))
    assert layer.modulus(100.0) == pytest.approx(70e6 * (1 + 0.4j))
    assert layer.modulus(1.0) == pytest.approx(0.25 * 70e6 * (1 + 0.2j))
    assert layer.modulus(5e3) == pytest.approx(4 * 70e6 * (1 + 0.6j))


def test_sliding_layers_add_their_rigidities():
    """Two equal layers are twice one, a quarter of the bonded pair; others add up by hand."""
    two = [LaminateLayer(GLASS, 1e-3), LaminateLayer(GLASS, 1e-3)]
    assert freely_sliding(two).rigidity == pytest.approx(2 * 70 / (12 * 0.96), rel=1e-12)
    assert perfectly_bonded(two).rigidity / freely_sliding(two).rigidity == pytest.approx(4)
    mixed = freely_sliding([LaminateLayer(STEEL, 1e-3), LaminateLayer(GLASS, 2e-3)])
    steel, glass = 210 / (12 * 0.91), 560 / (12 * 0.96)
    assert mixed.rigidity == pytest.approx(steel + glass, rel=1e-12)
    assert mixed.nu == pytest.approx((0.3 * steel + 0.2 * glass) / (steel + glass), rel=1e-12)
