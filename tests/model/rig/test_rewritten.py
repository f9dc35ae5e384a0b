"""Rig files written again with other values."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.config.document import parse_document
from model.errors import InputError
from model.rig import rig_writing
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import rig_of
from model.rig.rig_writing import rewritten_text
from model.structure.attachments import PointLoad

RIG = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"


FLOW = """\
# my panel
plate: {length: 0.3, width: 0.2, thickness: 2 mm, material: steel}  # from stock
mesh: 12x9
limits: {frequency: [40, 200]}
eras:
  A: {at: [0, 0], stiffness: 9 kN/m, damping_ratio: 0.1, amplifier: m, channel: 0}
  B: {at: [0.3, 0], stiffness: 9000, amplifier: m, channel: 1, }
  C: {at: [0, 0.2], stiffness: 9000, damping: 2, bolt_mass: 3 g, amplifier: m, channel: 2}
amplifiers: {m: {url: "sim://"}}
"""

BLOCK = """\
plate:
  length: 0.3
  width: 0.2
  layers:   # glass on glass
    - material: soda-lime-glass
      thickness: 2 mm
    - material: {E: 60 GPa, rho: 2500, nu: 0.2}
      thickness: 1 mm   # the touch side
  bond: none
  loss_factor: 2 %   # bonded
mesh: 12x9
limits: {frequency: [40, 200]}
eras:
  A:   # "ä" in a comment: µ
    at:
      - 0
      - 0
    stiffness: 9000   # maker's
    amplifier: m
    channel: 0
    gains:
      - [50, 1, 0]
      - [60, 1, 0]
  B:
    at: [0.3, 0]
    bolt_mass: 1 g
    stiffness: 9000
    amplifier: m
    channel: 1
  C: {at: [0, 0.2], stiffness: 9000, amplifier: m, channel: 2}
amplifiers: {m: {url: "sim://"}}
"""

BOARD = (
    FLOW.replace("thickness: 2 mm, material: steel", "thickness: 6 mm, material: plywood")
    .replace("width: 0.2,", "width: 0.2, grain: width,")
    .replace("mesh: 12x9", "supports: {foot: {at: [0.1, 0.1], kind: foam}}  # of foam")
)

BY_NUMBERS = BOARD.replace(
    "plywood", "{E1: 12 GPa, E2: 4.8 GPa, G12: 0.7 GPa, G13: 350 MPa, G23: 250 MPa, nu12: 0.05, "
    "rho: 680}",
)  # fmt: skip

ACRYLIC = BOARD.replace("plywood", "acrylic")

BONDED = BLOCK.replace("bond: none", "bond: full").replace("12x9", "auto")


def other_values(rig: Rig) -> Rig:
    """Other values everywhere, gains for all but the last ERA."""
    plate = replace(rig.plate.scaled(modulus=1.2345678), loss_factor=0.0234)
    eras = tuple(
        replace(
            era,
            stiffness=era.stiffness * 1.1 + number,
            damping=era.damping + 1.5,
            bolt_mass=era.bolt_mass + 0.0123456,
            x=0.00123 if number == 0 else era.x,
            gains=((50.0, 0.91234, -0.2), (60.5, 1.1, 3.0)) if number < 2 else (),
        )
        for number, era in enumerate(rig.eras)
    )
    return replace(
        rig,
        plate=plate,
        laminate=rig.laminate and rig.laminate.scaled(modulus=1.2345678),
        eras=eras,
        uncertainty=Uncertainty(0.004, 0.3, 0.002, 0.01, 1.02, 0.5),
    )


def test_gains_are_rewritten_wherever_yaml_wraps_the_line() -> None:
    """An ERA of several short lines becomes a long one; some lengths break it at its gains."""
    lines = RIG.read_text("utf-8").splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#"))
    text = text.replace("main", 32 * "m")
    for zeros in range(8, 29, 4):
        longer = text.replace(
            "0.05, bolt_mass: 0, stroke: 100 um", f"0.05,\n     stroke: 0.0001{zeros * '0'}"
        )
        document = parse_document("rig.yaml", longer)
        rig = rig_of(document)
        gains = ((50.0, 1.25, 0.5), (60.0, 1.5, 0.25))
        eras = tuple(
            replace(era, x=0.99 * era.x + 0.0005678, stiffness=1.0123 * era.stiffness, gains=gains)
            for era in rig.eras
        )
        after = rewritten_text(document, rig, replace(rig, eras=eras), comment="measured")
        read = rig_of(parse_document("new.yaml", after))
        assert [[row[0] for row in era.gains] for era in read.eras] == [[50.0, 60.0]] * 4


TEXTS = {
    **{"flow": FLOW, "block": BLOCK, "bonded": BONDED},
    **{"board": BOARD, "by numbers": BY_NUMBERS, "acrylic": ACRYLIC},
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_rewritten_text_keeps_comments_and_has_every_value(text: str) -> None:
    """Comments of any style stay, and values are those of the other rig, layers' moduli too."""
    document = parse_document("rig.yaml", text)
    rig = rig_of(document)
    other = other_values(rig)
    written = rewritten_text(document, rig, other, comment="new\nvalues")
    assert written.startswith("# new\n# values\n\n")
    for line in text.splitlines():
        if "#" in line:
            assert line[line.index("#") :] in written
    back = rig_of(parse_document("new.yaml", written))
    if back.plate.laminate is None or "layers" not in document.data["plate"]:
        before, after = (
            each.laminate.layers[0].material if each.laminate else each.plate.material
            for each in (rig, back)
        )
        expected = {key: 1.2345678 * each for key, each in before.moduli.items()}
        assert after.moduli == pytest.approx(expected, rel=1e-6)
    else:
        moduli = [layer.material.E for layer in back.plate.laminate.layers]
        assert moduli == pytest.approx([1.2345678 * 70e9, 1.2345678 * 60e9], rel=1e-6)
    assert back.plate.loss_factor == 0.0234
    for era, expected in zip(back.eras, other.eras, strict=True):
        assert era.stiffness == pytest.approx(expected.stiffness, rel=1e-5)
        assert era.damping == pytest.approx(expected.damping, rel=1e-5)
        assert era.bolt_mass == pytest.approx(expected.bolt_mass, rel=1e-5)
        np.testing.assert_allclose(era.gains, expected.gains, rtol=1e-5)
    assert back.wiring == rig.wiring
    assert back.plate.mass == pytest.approx(rig.plate.mass, rel=1e-9)


@pytest.mark.parametrize(("key", "off"), [("material", 0.2), ("loss_factor", 5e-5)])
def test_text_that_reads_back_otherwise_is_refused(
    monkeypatch: pytest.MonkeyPatch, key: str, off: float
) -> None:
    """A file whose plate cannot be changed, also by a quarter of a percent, is not the other's."""
    document = parse_document("rig.yaml", FLOW)
    rig, put = rig_of(document), rig_writing._put
    plate = replace(rig.plate, loss_factor=rig.plate.loss_factor + off)
    other = replace(rig, plate=plate if key == "loss_factor" else plate.scaled(modulus=1 + off))
    monkeypatch.setattr(
        rig_writing, "_put", lambda data, path, *more: path[-1] == key or put(data, path, *more)
    )
    with pytest.raises(InputError, match="read back"):
        rewritten_text(document, rig, other, comment="")


def test_a_mass_that_is_found_comes_beside_supports() -> None:
    """Supports stay, and the mass is read back where it was found."""
    document = parse_document("rig.yaml", BOARD)
    rig = rig_of(document)
    found = PointLoad(0.05, 0.15, mass=0.004)
    text = rewritten_text(document, rig, replace(rig, masses=(*rig.masses, found)), comment="")
    back = rig_of(parse_document("rig.yaml", text)).masses
    assert sorted(each.stiffness for each in back) == [0.0, 2000.0]
    assert found in back


def test_feet_are_read_back_whichever_is_stiffer_by_a_hair() -> None:
    """Two that differ by less than is written: the order of their stiffness says nothing."""
    feet = "supports: {a: {at: [0.1, 0.1], kind: foam}, b: {at: [0.2, 0.1], kind: foam}}"
    document = parse_document("rig.yaml", FLOW.replace("mesh: 12x9", f"{feet}\nmesh: 12x9"))
    rig = rig_of(document)
    one, other = rig.masses
    masses = (replace(one, stiffness=345.67800001), replace(other, stiffness=345.678))
    known = replace(rig.uncertainty, supports=0.05)
    found = replace(rig, masses=masses, uncertainty=known)
    text = rewritten_text(document, rig, found, comment="")
    back = rig_of(parse_document("rig.yaml", text)).masses
    assert [each.x for each in back] == [0.1, 0.2]
    assert [each.stiffness for each in back] == pytest.approx([345.678, 345.678])


def test_rewritten_text_keeps_how_uncertain_feet_are_that_it_states() -> None:
    """A foot of foam, uncertain by its kind, gets a stiffness and stays as uncertain: by 0.3."""
    document = parse_document("rig.yaml", BOARD)
    rig = rig_of(document)
    (foot,) = rig.masses
    softer = replace(rig, masses=(replace(foot, stiffness=0.8 * foot.stiffness),))
    back = rig_of(parse_document("b.yaml", rewritten_text(document, rig, softer, comment="")))
    assert back.uncertainty.supports == 0.3
    assert back.masses[0].stiffness == pytest.approx(0.8 * foot.stiffness)
