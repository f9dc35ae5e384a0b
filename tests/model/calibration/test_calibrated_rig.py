"""Calibrated values in rig files of any style."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.calibration.calibrated_rig import calibrated_text, check_reads_back
from model.calibration.calibration_result import Calibration
from model.config.document import read_document
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty

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

BONDED = BLOCK.replace("bond: none", "bond: full").replace("12x9", "auto")


def calibration(rig: Rig) -> Calibration:
    """Other values everywhere, gains for all but the last ERA."""
    plate = replace(rig.plate.scaled(modulus=1.2345678), loss_factor=0.0234)
    laminate = rig.laminate and rig.laminate.scaled(modulus=1.2345678)
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
    known = Uncertainty(0.004, 0.3, 0.002, 0.01, 1.02, 0.5)
    new = replace(rig, plate=plate, laminate=laminate, eras=eras, uncertainty=known)
    none = np.zeros((0, 3, 0), dtype=complex)
    return Calibration(
        rig=new,
        parameters=(),
        moved=(),
        gains_error=np.zeros((0, 3)),
        dead_sensors=(),
        dead_eras=(),
        scales=(),
        outlier_count=0,
        value_count=0,
        error=0.0,
        chi2=1.0,
        held_out=None,
        sensors=(),
        frequencies=np.zeros(0),
        measured=none,
        before=none,
        after=none,
    )


@pytest.mark.parametrize("text", [FLOW, BLOCK, BONDED], ids=["flow", "block", "bonded"])
def test_calibrated_text_keeps_comments_and_reads_back(tmp_path: Path, text: str) -> None:
    """Every value is read back, and every comment is kept."""
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    rig = load_rig(path)
    found = calibration(rig)
    written = calibrated_text(read_document(path), rig, found, comment="new\nvalues")
    assert written.startswith("# new\n# values\n\n")
    for line in text.splitlines():
        if "#" in line:
            assert line[line.index("#") :] in written
    path.write_text(written, encoding="utf-8")
    back = load_rig(path)
    check_reads_back(back, found, path)
    if back.plate.laminate is None:
        assert pytest.approx(found.rig.plate.material.E, rel=1e-6) == back.plate.material.E
    else:
        moduli = [layer.material.E for layer in back.plate.laminate.layers]
        assert moduli == pytest.approx([1.2345678 * 70e9, 1.2345678 * 60e9], rel=1e-6)
    assert back.plate.loss_factor == 0.0234
    for era, wanted in zip(back.eras, found.rig.eras, strict=True):
        assert era.stiffness == pytest.approx(wanted.stiffness, rel=1e-5)
        assert era.damping == pytest.approx(wanted.damping, rel=1e-5)
        assert era.bolt_mass == pytest.approx(wanted.bolt_mass, rel=1e-5)
        np.testing.assert_allclose(era.gains, wanted.gains, rtol=1e-5)
    assert back.wiring == rig.wiring
    assert back.plate.mass == pytest.approx(rig.plate.mass, rel=1e-9)


def test_check_reads_back_refuses_other_values(tmp_path: Path) -> None:
    """A file with other values than the fitted ones is not taken for the new rig."""
    path = tmp_path / "rig.yaml"
    path.write_text(FLOW)
    rig = load_rig(path)
    with pytest.raises(InputError):
        check_reads_back(rig, calibration(rig), path)
