"""Calibration and complex fields from Python."""

from pathlib import Path

import numpy as np
import pytest

import era_haptics as era

MEASURED = Path(__file__).parents[2] / "examples" / "measured.csv"


def test_map_has_complex_fields_whose_magnitudes_are_the_peak() -> None:
    """Of two frequencies; a drive of another phase turns its own field by that phase."""
    plate = era.SolvedPlate(era.load_rig(era.example_rig_path()))
    drive = {"SW": era.Drive(110, level=0.5), "NE": era.Drive(150, level=0.2)}
    found = plate.map(drive, raster=(7, 5))
    assert found.frequencies.tolist() == [110, 150]
    assert found.field.shape == (2, 5, 7)
    np.testing.assert_allclose(np.abs(found.field).sum(axis=0), found.peak)
    turned = plate.map({"SW": era.Drive(110, level=0.5, phase_deg=90)}, raster=(7, 5))
    np.testing.assert_allclose(turned.field[0], 1j * found.field[0], rtol=1e-9)


@pytest.mark.long
def test_calibrate_finds_the_values_of_the_example() -> None:
    """Loss factor 0.013 and SW at 19.04 kN/m, as examples/make_measured.py has them."""
    found = era.calibrate(era.load_rig(era.example_rig_path()), MEASURED)
    assert found.is_good
    assert found.rig.plate.loss_factor == pytest.approx(0.013, rel=0.01)
    assert found.rig.era("SW").stiffness == pytest.approx(19040, rel=0.02)
    assert found.rig.uncertainty.thickness < 0.005
