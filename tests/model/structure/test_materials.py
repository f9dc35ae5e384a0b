"""Named materials, point masses and rigs made without a file."""

import math
from dataclasses import replace

import pytest

from model.errors import InputError
from model.structure.actuator import Era
from model.structure.materials import KNOWN_MATERIALS, material
from model.structure.plate import Material, Plate
from model.structure.point_mass import PointMass
from paper_plate import make_paper_rig

# E [Pa], rho [kg/m³], nu as printed in the standard or data sheet that the material names.
PRINTED = {
    "aluminium": (70e9, 2700, 0.33),  # founding paper, section 3
    "steel": (210e9, 7850, 0.3),  # EN 1993-1-1, 3.2.6; EN 1991-1-1
    "soda-lime-glass": (70e9, 2500, 0.2),  # EN 572-1
    "chemically-strengthened-glass": (71.5e9, 2420, 0.21),  # Corning Gorilla Glass 2
    "acrylic": (3.3e9, 1190, 0.37),  # Plexiglas GS
    "polycarbonate": (2.4e9, 1200, 0.38),  # Makrolon
}


@pytest.mark.parametrize("name", PRINTED)
def test_a_named_material_has_the_printed_numbers(name):
    """E, rho and nu are those of the source, in SI units."""
    known = material(name)
    assert (known.E, known.rho, known.nu) == PRINTED[name]


def test_every_material_says_where_its_numbers_come_from():
    """All that are known are checked above, and each has its source and its spread."""
    assert KNOWN_MATERIALS.keys() == PRINTED.keys()
    assert all(known.source and known.spread for known in KNOWN_MATERIALS.values())


@pytest.mark.parametrize(
    ("name", "modulus_of_rigidity"),
    [
        ("aluminium", 26.3e9),  # ASM handbook, wrought aluminium: 26 GPa
        ("steel", 81e9),  # EN 1993-1-1, 3.2.6: G = 81 000 N/mm²
        ("chemically-strengthened-glass", 29.6e9),  # Corning Gorilla Glass 2, shear modulus
    ],
)
def test_the_shear_modulus_is_the_one_printed_beside(name, modulus_of_rigidity):
    """E / 2 (1 + nu) is the shear modulus that sources print of their own."""
    assert material(name).shear_modulus == pytest.approx(modulus_of_rigidity, rel=0.005)


@pytest.mark.parametrize("written", ["Soda-lime glass", "soda_lime_glass", " SODA-LIME-GLASS "])
def test_a_name_may_be_written_in_several_ways(written):
    """Case and what joins the words do not matter."""
    assert material(written) is material("soda-lime-glass")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("aluminum", "did you mean aluminium"),
        ("polycarbonat", "did you mean polycarbonate"),
        ("strengthened glass", "did you mean chemically-strengthened-glass"),
        ("", "known are aluminium, steel"),
        ("x" * 500, "unknown material 'x{40}'; known are"),
    ],
)
def test_an_unknown_name_is_refused_with_what_is_known(name, message):
    """The error says what may have been meant, and what there is."""
    with pytest.raises(InputError, match=message):
        material(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"E": 0.0}, "E is 0.0"),
        ({"E": math.nan}, "E is nan"),
        ({"rho": -1.0}, "rho is -1.0"),
        ({"nu": 0.5}, "nu is 0.5"),
        ({"nu": math.nan}, "nu is nan"),
    ],
)
def test_what_no_solid_can_be_is_no_material(change, message):
    """Zero and NaN moduli or densities, and nu outside -1 to 0.5, are refused."""
    with pytest.raises(InputError, match=message):
        replace(material("steel"), **change)


@pytest.mark.parametrize("key", ["length", "width", "thickness"])
@pytest.mark.parametrize("size", [0.0, -0.1, math.nan, math.inf])
def test_a_plate_without_size_is_refused(key, size):
    """Zero, negative, NaN and infinite sizes are none."""
    plate = Plate(0.3, 0.2, 0.002, Material("glass", 70e9, 2500.0, 0.2))
    with pytest.raises(InputError, match=f"plate: {key} is .* must be above zero"):
        replace(plate, **{key: size})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((math.nan, 0.1, 0.01), "x is nan"),
        ((0.1, math.inf, 0.01), "y is inf"),
        ((0.1, 0.1, math.nan), "mass is nan"),
        ((0.1, 0.1, -0.01), "below zero"),
    ],
)
def test_what_is_no_point_mass_is_refused(values, message):
    """A place or weight that is no number, and negative mass, are bad input."""
    with pytest.raises(InputError, match=message):
        PointMass(*values)


def test_a_rig_with_an_era_or_a_mass_off_its_plate_is_refused():
    """Not only a rig file is checked: a rig put together by a program is, too."""
    rig = make_paper_rig(12, 9)
    outside = Era("out", 0.31, 0.1, 17000.0, 0.0, 0.0, 1e-4)
    with pytest.raises(InputError, match=r"ERA out at \(0.31, 0.1\) m is off the plate"):
        replace(rig, eras=(*rig.eras, outside))
    with pytest.raises(InputError, match=r"point mass at \(0.1, -0.01\) m is off the plate"):
        replace(rig, masses=(PointMass(0.1, -0.01, 0.005),))


def test_a_rig_with_two_eras_at_one_point_or_of_one_name_is_refused():
    """Two bolts cannot share a hole, and a name means one ERA."""
    rig = make_paper_rig(12, 9)
    with pytest.raises(InputError, match="ERAs SW and again are both at"):
        replace(rig, eras=(*rig.eras, replace(rig.era("SW"), name="again")))
    with pytest.raises(InputError, match="two ERAs have the name SW"):
        replace(rig, eras=(*rig.eras, replace(rig.era("SW"), x=0.1)))
