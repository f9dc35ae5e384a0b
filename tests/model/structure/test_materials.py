"""Named materials, point masses and rigs made without a file."""

import math
from dataclasses import replace

import pytest

from model.errors import InputError
from model.structure.attachments import Era, Fingertip, PointLoad
from model.structure.exciter import Exciter
from model.structure.materials import material
from model.structure.plate import AirGap, Bond, Laminate, LaminateLayer, Material, Orthotropy, Plate
from plates import make_paper_rig

GLASS = Material("glass", 70e9, 2500.0, 0.2)
PLATE = Plate(0.3, 0.2, 0.002, GLASS)

# E [Pa], rho [kg/m³], nu as printed in the standard or data sheet that the material names.
PRINTED = {
    "aluminium": (70e9, 2700, 0.33),  # founding paper, section 3
    "steel": (210e9, 7850, 0.3),  # EN 1993-1-1, 3.2.6; EN 1991-1-1
    "soda-lime-glass": (70e9, 2500, 0.2),  # EN 572-1
    "chemically-strengthened-glass": (71.5e9, 2420, 0.21),  # Corning Gorilla Glass 2
    "float-glass": (70e9, 2500, 0.2),  # EN 572-1
    "polycarbonate": (2.4e9, 1200, 0.38),  # Makrolon
}


@pytest.mark.parametrize("name", PRINTED)
def test_material_has_the_printed_numbers(name):
    """E, rho and nu are those of the source, in SI units."""
    known = material(name)
    assert (known.E, known.rho, known.nu) == PRINTED[name]


@pytest.mark.parametrize("written", ["Soda-lime glass", "soda_lime_glass", " SODA-LIME-GLASS "])
def test_material_accepts_spellings_of_a_name(written):
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
def test_material_refuses_an_unknown_name_with_a_suggestion(name, message):
    """The error says what may have been meant, and what there is."""
    with pytest.raises(InputError, match=message):
        material(name)


@pytest.mark.parametrize(
    ("good", "values"),
    [
        (material("steel"), {"E": [0.0, math.nan], "rho": [-1.0], "nu": [0.5, -1.0, math.nan]}),
        (PLATE, {key: [0.0, -0.1, math.nan, math.inf] for key in ("length", "width", "thickness")}),
        (LaminateLayer(GLASS, 1e-3), {"thickness": [0.0, -1e-3, math.nan, math.inf]}),
        (
            PointLoad(0.1, 0.1),
            {
                "x": [math.nan],
                "y": [math.inf],
                "mass": [math.nan, -0.1],
                "stiffness": [-1.0],
                "damping": [math.inf],
                "foot": [-1e-3, math.nan],
            },
        ),
        (Era("A", 0.1, 0.1, 1e4, 1.0, 0.0, 1e-4), {"stroke": [0.0], "foot": [-1e-3, math.nan]}),
        (
            Exciter("SW", 0.1, 0.1, 3e3, 0.8, 0.1, 2e-3, 3.6, 4.3, 3.0),
            {key: [0.0] for key in ("stiffness", "magnet_mass", "force_factor", "resistance")},
        ),
        (Orthotropy(0.4, 0.1, 0.1, 0.1), {"e2": [math.nan, 0.0], "g13": [-1.0]}),
        (replace(GLASS, orthotropy=Orthotropy(0.4, 0.1, 0.1, 0.1)), {"E": [0.0]}),
        (Fingertip(), {"damping": [0.0], "stiffness": [-1.0], "phalanx_mass": [math.nan, 0.0]}),
        (AirGap(1e-3), {"depth": [0.0, -1e-3, math.nan]}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_value_refuses_numbers_out_of_range(good, values):
    """The error names the key and the number."""
    for key, numbers in values.items():
        for number in numbers:
            with pytest.raises(InputError, match=rf"{key} .*got {number}"):
                replace(good, **{key: number})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda rig: {"eras": (*rig.eras, Era("out", 0.31, 0.1, 17000.0, 0.0, 0.0, 1e-4))},
            r"ERA out .*\(0.31, 0.1\)",
        ),
        (lambda _: {"masses": (PointLoad(0.1, -0.01, mass=0.005),)}, r"mass.*\(0.1, -0.01\)"),
        (lambda rig: {"eras": (*rig.eras, replace(rig.era("SW"), name="again"))}, "SW and again"),
        (lambda rig: {"eras": (*rig.eras, replace(rig.era("SW"), x=0.1))}, r"name.*SW|SW.*name"),
    ],
    ids=["ERA off the plate", "mass off the plate", "one place", "one name"],
)
def test_rig_of_a_program_is_checked(change, said):
    """Not only a rig file is: two bolts cannot share a hole, and a name means one ERA."""
    rig = make_paper_rig(12, 9)
    with pytest.raises(InputError, match=said):
        replace(rig, **change(rig))


GRAINED = LaminateLayer(replace(GLASS, orthotropy=Orthotropy(0.4, 0.1, 0.1, 0.1)), 1e-3)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Laminate(()), r"^laminate: .*layer"),
        (
            lambda: Laminate((replace(GRAINED, material=GLASS, loss_factor=0.1),) * 2, Bond.NONE),
            r"^laminate: .*bond none",
        ),
        (lambda: Laminate((GRAINED, GRAINED)), "isotropic"),
        # 1 / sqrt(0.4) = 1.58
        (lambda: replace(GRAINED.material, nu=1.6), "nu12 must be less than .*1.58"),
    ],
    ids=["no layers", "losses of layers that slide", "layers with a grain", "no elastic energy"],
)
def test_plates_of_no_meaning_are_refused(made, said):
    """Bounds and waves of a laminate are those of isotropic layers."""
    with pytest.raises(InputError, match=said):
        made()
