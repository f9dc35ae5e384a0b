"""Interpolation of fields on a raster."""

import numpy as np
import pytest

from model.errors import InputError
from model.finger.fingertip import fingertip_points
from model.reduction.free_plate import solve_free_plate
from model.structure.plate import Material, Plate
from model.table.raster import Raster
from paper_table import FREQUENCIES, smooth_rig

CROSS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
CONTACTS = [(0.15, 0.11), (0.0, 0.0), (0.3048, 0.1), (0.2, 0.225), (0.006, 0.0031)]


def test_fingertips_reads_the_points_of_the_disc():
    """Reading x and y themselves gives back the points, the centre and four of the rim as well."""
    plate = smooth_rig().plate
    raster = Raster.for_plate(plate, frequency_max=500.0)
    places = raster.points.astype(np.float32)
    few, fine = raster.fingertips(np.array(CONTACTS)).read(places)
    expected = [fingertip_points(x, y, plate) for x, y in CONTACTS]
    np.testing.assert_allclose(fine, expected, atol=1e-7)
    assert few.shape == (5, 5, 2)
    np.testing.assert_allclose(few[:, 0], CONTACTS, atol=1e-7)
    np.testing.assert_allclose(few[0, 1:] - few[0, :1], 0.013 * CROSS, atol=1e-7)


def test_fingertips_interpolates_fields_of_the_plate():
    """At 500 Hz as well the interpolation is within 1e-4 of the field, beside an ERA as inside."""
    rig = smooth_rig()
    raster = Raster.for_plate(rig.plate, frequency_max=500.0)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    kept = free.acceleration(rig.eras, FREQUENCIES, raster.points).transpose(2, 0, 1)
    values = np.ascontiguousarray(kept.astype(np.complex64)).reshape(len(kept), -1)
    _, fine = raster.fingertips(np.array(CONTACTS)).read(values.view(np.float32))
    found = fine.reshape(-1, fine.shape[-1])
    points = np.concatenate([fingertip_points(x, y, rig.plate) for x, y in CONTACTS])
    solved = free.acceleration(rig.eras, FREQUENCIES, points).transpose(2, 0, 1)
    size = np.sqrt((np.abs(kept) ** 2).mean(axis=0))
    error = np.abs(found.view(np.complex64).reshape(solved.shape) - solved) / size
    assert error.max() < 1e-4


@pytest.mark.parametrize("thickness", [0.0001, 0.01])
def test_for_plate_handles_thin_and_small_plates(thickness):
    """A foil of short waves, and a plate barely larger than a fingertip."""
    plate = Plate(0.02, 0.03, thickness, Material("any", E=70e9, rho=2700.0, nu=0.33))
    raster = Raster.for_plate(plate, frequency_max=500.0)
    heights = (3 * raster.points[:, :1] - raster.points[:, 1:]).astype(np.float32)
    np.testing.assert_allclose(raster.at(heights, np.array([[0.011, 0.004]])), [[0.029]], rtol=1e-5)


def test_raster_refuses_too_few_points():
    """Five points do not carry a quintic."""
    with pytest.raises(InputError, match="6 to"):
        Raster(5, 9, 0.1, 0.1)
